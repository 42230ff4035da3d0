"""Test scenes: moving meshes ray-cast into captures, so that every pixel has a true surface behind it."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, Literal

import numpy as np

from tasks.captures import cameras as cam
from tasks.captures.dnerf import dnerf_files
from tasks.captures.multiview import multiview_files
from tasks.captures.raycast import Caster
from tasks.errors import InputError
from tasks.geometry.measure import diagonal
from tasks.values import Capture, Files, Motion, Rig

PROBES = 40  # views that the framing is measured on
PROBE_SIZE = 64  # their pixels
ROUNDS = 6  # of getting nearer to the wanted share
RING = (8.0, 35.0)  # degrees of elevation of training cameras, by turns
BETWEEN = (20.0, 20.0)  # of the test cameras
CAMERAS_OF_TRAINING, CAMERAS_OF_TEST, CAMERAS_OF_FRAMING = 0, 1, 2  # streams of the seed


def scene_motion(
    motion: Motion,
    *,
    clip: str | None,
    frames: Annotated[int, "[2, inf)"] | None,
    choose: Literal["first", "even", "resample"],
) -> Motion:
    """The frames of a motion that a scene shows, and the truth that what is fitted to it is held against.

    clip: one clip by its name, null for all. frames: how many, null for all; first: the first ones; even: spread
    evenly, first and last among them, both all where there are fewer; resample: that many, also more than there are,
    each clip by cubic interpolation over time (only where no skeleton comes with the data). Raises InputError for an
    unknown clip.

    Where the data has no rest shape, its first frame becomes one: colours are painted on it, whichever frames are
    rendered later.
    """
    if motion.rest is None:
        motion = replace(motion, rest=motion.points[0])
    if clip is not None:
        if clip not in motion.clip_names:
            raise InputError("scene.clip", expected=f"one of {', '.join(motion.clip_names)}", found=repr(clip))
        motion = motion.take_clips([motion.clip_names.index(clip)])
    if frames is None:
        return motion
    if choose == "resample":
        return motion if frames == motion.frames else _resampled(motion, frames)
    if frames >= motion.frames:
        return motion
    if choose == "first":
        index = np.arange(frames)
    else:
        index = np.rint(np.linspace(0, motion.frames - 1, frames)).astype(np.int64)
    return _take(motion, index, motion.fps * _share(index, motion))


def render_scene(
    motion: Motion,
    *,
    size: Annotated[int, "[1, inf)"],
    layout: Literal["monocular", "multiview"],
    views: Annotated[int, "[1, inf)"],
    test_views: Annotated[int, "[1, inf)"],
    cameras: Annotated[int, "[1, inf)"],
    test_cameras: Annotated[int, "[1, inf)"],
    fill: Annotated[float, "(0, 1)"],
    follow: bool,
    field_of_view: Annotated[float, "(0, 170)"],
    samples: Annotated[int, "[1, inf)"],
    shading: Annotated[float, "[0, 1]"],
    seed: int,
) -> tuple[Capture, Capture]:
    """(train, test) captures of a moving mesh, rendered by rays.

    size: pixels along each side. layout: `monocular`, as D-NeRF: `views` training and `test_views` test images, each
    from a camera and at a time of its own, times evenly over the frames, cameras over the upper hemisphere;
    `multiview`: a ring of `cameras` that all see every frame, and `test_cameras` others between them.
    fill: share of an image that the subject covers in the mean; cameras that would cut it off stand further away.
    follow: monocular cameras look at where the subject is, not at the middle of where it ever is.
    field_of_view: degrees; samples: rays along each side of a pixel; shading: share of the light that has a direction,
    so that a point's colour changes as it turns. Colours are a pattern on the shape at rest, the same for every seed.

    The rig comes along without skin weights: what is fitted to images has other points than the mesh. Raises InputError
    for a motion without faces.
    """
    _check(motion)
    centre = (motion.points.min(1).astype(np.float64) + motion.points.max(1)) / 2
    middle = (centre.min(0) + centre.max(0)) / 2
    if layout == "monocular":
        train = _Shots.hemisphere(motion.frames, views, (seed, CAMERAS_OF_TRAINING))
        test = _Shots.hemisphere(motion.frames, test_views, (seed, CAMERAS_OF_TEST))
    else:
        train = _Shots.ring(motion.frames, cameras, RING, turn=0.0)
        test = _Shots.ring(motion.frames, test_cameras, BETWEEN, turn=0.5 * test_cameras / cameras)
    targets = centre if follow and layout == "monocular" else np.broadcast_to(middle, centre.shape)
    intrinsics = cam.pinhole(size, field_of_view)
    distances = _framing(motion, (train, test), targets, fill, field_of_view)
    views = [_views(s, targets, d) for s, d in zip((train, test), distances, strict=True)]
    pixels = {"size": size, "samples": samples, "shading": shading}
    return tuple(_capture(motion, s, v, intrinsics, pixels) for s, v in zip((train, test), views, strict=True))


def scene_files(capture: Capture, views: Capture, *, name: str) -> Files:
    """A scene as a folder that other programs read: in the layout of D-NeRF, or where cameras stand still in that of
    ``tasks/captures/multiview.py``. capture: to train on; views: held out."""
    standing = len(np.unique(capture.camera)) < len(capture.camera)
    files = multiview_files(capture, views) if standing else dnerf_files(capture, views)
    return Files.of({f"{name}/{path}": data for path, data in files.items()})


class _Shots:
    """Which camera sees which frame. direction: (I, 3) from the target to the camera; frame, camera: (I,)."""

    def __init__(self, direction: np.ndarray, frame: np.ndarray, camera: np.ndarray) -> None:
        self.direction, self.frame, self.camera = direction, frame.astype(np.int32), camera.astype(np.int32)

    @classmethod
    def hemisphere(cls, frames: int, count: int, seed: tuple[int, int]) -> _Shots:
        """A camera of its own for each of `count` times."""
        time = (np.arange(count) + 0.5) / count * frames - 0.5
        return cls(cam.hemisphere(count, seed), np.rint(time), np.arange(count))

    @classmethod
    def ring(cls, frames: int, count: int, elevation: tuple[float, float], turn: float) -> _Shots:
        """Standing cameras, each at all times."""
        direction = cam.ring(count, low=elevation[0], high=elevation[1], turn=turn)
        camera = np.tile(np.arange(count), frames)
        return cls(direction[camera], np.repeat(np.arange(frames), count), camera)


def _framing(motion: Motion, shots: tuple[_Shots, ...], targets, fill: float, field_of_view: float):
    """The distance of every camera from its target, for each of the shots (I,): the same for all but where the subject
    would be cut off, such that it fills its share in the mean of the first shots."""
    half = np.tan(np.deg2rad(field_of_view) / 2)
    uncut = [_uncut(motion, s, targets, half) for s in shots]
    probes = np.unique(np.linspace(0, len(shots[0].frame) - 1, PROBES).astype(int))
    casters = {f: _caster(motion, f) for f in np.unique(shots[0].frame[probes])}
    intrinsics = cam.pinhole(PROBE_SIZE, field_of_view)
    common = float(np.median(uncut[0]))
    for _ in range(ROUNDS):
        view = _views(shots[0], targets, np.maximum(common, uncut[0]))
        shares = [
            casters[f].coverage(view[i], intrinsics, PROBE_SIZE, 1).mean()
            for i, f in zip(probes, shots[0].frame[probes], strict=True)
        ]
        common = max(common * np.sqrt(max(np.mean(shares), 1e-6) / fill), float(uncut[0].min()))
    return [np.maximum(common, u) for u in uncut]


def _uncut(motion: Motion, shots: _Shots, targets, half: float) -> np.ndarray:
    """How far each camera must stand for the subject to be in its images, one that stands still in all of them. (I,)"""
    own = [
        cam.uncut_distance(motion.points[f], targets[f], d, half)
        for d, f in zip(shots.direction, shots.frame, strict=True)
    ]
    of_camera = np.full(shots.camera.max() + 1, -np.inf)
    np.maximum.at(of_camera, shots.camera, own)
    return of_camera[shots.camera]


def _views(shots: _Shots, targets, distance: np.ndarray) -> np.ndarray:
    seen = targets[shots.frame]
    return cam.look_at(seen + distance[:, None] * shots.direction, seen)


def _capture(motion: Motion, shots: _Shots, view: np.ndarray, intrinsics: np.ndarray, pixels: dict) -> Capture:
    images = np.empty((len(view), pixels["size"], pixels["size"], 4), np.uint8)
    for f in np.unique(shots.frame):
        caster = _caster(motion, f)
        for i in np.flatnonzero(shots.frame == f):
            images[i] = caster.image(view[i], intrinsics, **pixels)
    return Capture(
        name=motion.name,
        images=images,
        has_alpha=True,
        background=np.ones(3, np.float32),
        view=view.astype(np.float32),
        intrinsics=np.tile(intrinsics.astype(np.float32), (len(view), 1, 1)),
        camera=shots.camera,
        frame=shots.frame,
        times=np.linspace(0, 1, motion.frames).astype(np.float32),
        fps=motion.fps,
        clip_start=motion.clip_start,
        clip_names=motion.clip_names,
        unit=motion.unit,
        rig=_bare(motion.rig),
    )


def _caster(motion: Motion, frame: int) -> Caster:
    return Caster(motion.points[frame], motion.faces, motion.points[0] if motion.rest is None else motion.rest)


def _bare(rig: Rig | None) -> Rig | None:
    """The rig without skin weights."""
    return rig and replace(rig, weights=np.zeros((0, len(rig.names)), np.float32))


def _take(motion: Motion, index: np.ndarray, fps: float) -> Motion:
    """Chosen frames in their order; a clip that none are chosen of is gone."""
    clip = np.searchsorted(motion.clip_start, index, side="right") - 1
    kept, count = np.unique(clip, return_counts=True)
    rig = motion.rig
    if rig is not None:
        rig = replace(rig, rotations=rig.rotations[index], translations=rig.translations[index])
    return replace(
        motion,
        points=motion.points[index],
        clip_start=np.concatenate([[0], np.cumsum(count)]).astype(np.int64),
        clip_names=tuple(motion.clip_names[c] for c in kept),
        fps=fps,
        rig=rig,
    )


def _share(index: np.ndarray, motion: Motion) -> float:
    """Chosen frames a frame: what the rate is multiplied by."""
    return 1.0 if index[-1] == len(index) - 1 else (len(index) - 1) / (motion.frames - 1)


def _resampled(motion: Motion, frames: int) -> Motion:
    from scipy.interpolate import CubicSpline

    if motion.rig is not None:
        found = f"the skeleton of {motion.name}"
        do = "choose first or even"
        raise InputError("scene.choose=resample", expected="data without a skeleton", found=found, do=do)
    clips = motion.clips()
    if frames < 2 * len(clips) or min(c.stop - c.start for c in clips) < 2:
        expected = "at least two frames a clip"
        raise InputError("scene.frames", expected=expected, found=f"{frames} for {len(clips)} clips")
    edges = np.rint(np.linspace(0, frames, motion.frames + 1)[motion.clip_start]).astype(np.int64)
    points = []
    for c, start, stop in zip(clips, edges[:-1], edges[1:], strict=True):
        spline = CubicSpline(np.arange(c.stop - c.start), motion.points[c].astype(np.float64))
        points.append(spline(np.linspace(0, c.stop - c.start - 1, stop - start)).astype(np.float32))
    fps = motion.fps * (frames - 1) / (motion.frames - 1)
    return replace(motion, points=np.concatenate(points), clip_start=edges, fps=fps)


def _check(motion: Motion) -> None:
    if motion.faces is None:
        found, do = "bare points", "load it with dataset.faces=true"
        raise InputError(f"dataset {motion.name}", expected="a mesh to render", found=found, do=do)
    if not diagonal(motion.points[0]) > 0:
        raise InputError(f"dataset {motion.name}", expected="a shape", found="all points in one place")
