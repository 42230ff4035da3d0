"""The figures of a report as values, so that they are cached like any other result."""

from __future__ import annotations

import numpy as np

from tasks.drawing import figures, render, video
from tasks.drawing.views import contact_sheet, views_figure
from tasks.geometry import kinematics, measure
from tasks.geometry.skinning import skin
from tasks.values import Animation, Canonical, Capture, Clusters, Motion, Parts, Picture, Poses, Skeleton, Skinning


def error_picture(test: Motion, canonical: Canonical, animations: dict[str, Animation], *, focus: str) -> Picture:
    """Truth and methods side by side, coloured by vertex error, in the median and the worst frame of ``focus``."""
    shown = {label: animation.points for label, animation in animations.items()}
    diagonal = measure.diagonal(canonical.points)
    pixels = figures.error_figure(test, shown, diagonal, focus=focus, azimuth=figures.azimuth_of(test))
    caption = f"{test.name}: vertex error on unseen clips, median and worst frame of {focus}"
    return Picture("errors", caption, _png(pixels))


def clip_picture(test: Motion, canonical: Canonical, animations: dict[str, Animation], *, focus: str) -> Picture:
    """Truth and methods side by side in an unseen clip, as a looping video."""
    shown = {label: animation.points for label, animation in animations.items()}
    azimuth, diagonal = figures.azimuth_of(test), measure.diagonal(canonical.points)
    data, caption = video.clip_video(test, shown, diagonal, focus=focus, azimuth=azimuth)
    return Picture("video", caption, webp=np.frombuffer(data, np.uint8))


def skeleton_picture(train: Motion, canonical: Canonical, skeleton: Skeleton, parts: Parts) -> Picture:
    """The skeleton inside the canonical shape, joints in the colour of their part."""
    pixels = figures.skeleton_figure(canonical, skeleton, parts, azimuth=figures.azimuth_of(train))
    return Picture("skeleton", f"{train.name}: inner skeleton, joints in the colour of their part", _png(pixels))


def parts_picture(train: Motion, canonical: Canonical, skinning: Skinning, parts: Parts) -> Picture:
    """How much each point follows each part."""
    pixels = figures.parts_figure(canonical, skinning, parts, azimuth=figures.azimuth_of(train))
    return Picture("parts", f"{train.name}: overlapping parts, matched on their own", _png(pixels))


def bones_picture(train: Motion, canonical: Canonical, skinning: Skinning) -> Picture:
    """The free-form bones' weights."""
    pixels = figures.bones_figure(canonical, skinning, azimuth=figures.azimuth_of(train))
    return Picture("bones", f"{train.name}: skin weights of the free-form bones", _png(pixels))


def count_picture(train: Motion, canonical: Canonical, clusters: Clusters) -> Picture:
    """Error against the number of clusters, with the chosen number and what the most that were tried would gain."""
    drawing = figures.count_figure(clusters, measure.diagonal(canonical.points))
    caption = f"{train.name}: error of rigid clusters against their number"
    chosen, most = clusters.transforms.shape[1], int(np.max(clusters.curve_count, initial=0))
    if most > chosen:
        error = np.interp([chosen, most], clusters.curve_count, clusters.curve_error)
        before, after = 100.0 * error / measure.diagonal(canonical.points)
        caption += f"; B = {chosen} was chosen, all {most} would take it from {before:.3f} to {after:.3f} % only"
    return Picture("count", caption, None, drawing)


def garment_picture(body: Motion, poses: dict[str, Poses], cloth: dict[str, Motion], *, clips: list[str]) -> Picture:
    """The cloth on the body in the middle of every clip. poses: of the body, whose last clip is the cloth's frames."""
    rig, panels = body.rig, {}
    for clip in clips:
        frame = cloth[clip].frames // 2
        at = slice(int(poses[clip].clip_start[-2]) + frame, int(poses[clip].clip_start[-2]) + frame + 1)
        turned = kinematics.forward(rig.parents, rig.joints, poses[clip].rotations[at], poses[clip].translations[at])
        panels[f"{clip}, frame {frame}"] = (skin(body.rest, rig.weights, turned)[0], cloth[clip].points[frame])
    first = cloth[clips[0]]
    pixels = figures.worn_figure(panels, body.faces, first.faces)
    return Picture("frames", f"{first.name}: the middle frame of every clip", _png(pixels))


def views_picture(truth: Capture, rendered: dict[str, Capture]) -> Picture:
    """What test cameras saw and what is rendered for them."""
    return Picture("views", f"{truth.name}: held-out views and their renderings", _png(views_figure(truth, rendered)))


def scene_picture(capture: Capture, views: Capture) -> Picture:
    """A rendered scene: training images over time, and held-out views."""
    return Picture("scene", f"{capture.name}: training images, and views held out", _png(contact_sheet(capture, views)))


def driven_picture(canonical: Canonical, motion: Motion, animation: Animation) -> Picture:
    """The character at even steps of a motion for which there is no truth. motion: its joints, for the names."""
    frames = np.unique(np.linspace(0, len(animation.points) - 1, 8).astype(int))
    panels = {f"frame {f}": animation.points[f] for f in frames}
    pixels = figures.frames_figure(panels, canonical.faces, azimuth=0.5)
    return Picture("driven", f"driven by {motion.name}, at even steps", _png(pixels))


def driven_clip(canonical: Canonical, motion: Motion, animation: Animation) -> Picture:
    """The same as a looping video."""
    data = video.driven_video(animation.points, canonical.faces, motion.fps, azimuth=0.5)
    return Picture("driven_video", f"driven by {motion.name}, its beginning", webp=np.frombuffer(data, np.uint8))


def _png(pixels: np.ndarray) -> np.ndarray:
    return np.frombuffer(render.png(pixels), np.uint8)
