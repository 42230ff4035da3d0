"""What is checked about a capture before a stage sees it: each fault ends here in one clear line.

Errors are what nothing can be reconstructed from; :func:`notes` lists what is merely odd, for the report.
"""

from __future__ import annotations

import numpy as np

from tasks.captures.cameras import eyes
from tasks.errors import InputError
from tasks.values import About, Capture

RIGID = 1e-3  # a rotation's largest deviation from orthonormal
SAME_CAMERA = 1e-5  # of the scene's size
NEAR_TIMES = 0.1  # of the usual step between times
BORDER = 0.9  # of the border's pixels: alpha that covers more is inverted, or the camera is in the subject
NARROW = 0.05  # of the image's width: a focal length below it, 170 degrees, was not given in pixels
FAINT = 8  # alpha below it is no subject


def check(where: str, capture: Capture, *, training: bool) -> Capture:
    """The capture, once all of it has been checked. where: the folder, for messages; training: something is to be
    reconstructed from it, for which one camera that stands still is not enough.

    Raises InputError for images without alpha and no background given, times out of 0..1 or not rising, a camera or
    frame number out of range, matrices that are no cameras, focal lengths not in pixels, cameras that look away from
    what the others see or stand in the subject, inverted and empty masks, and one standing camera with a time of its
    own for each image.
    """
    _numbers(where, capture)
    _times(where, capture.times)
    _cameras(where, capture)
    if capture.has_alpha:
        _borders(where, capture)
    if training:
        shows = not capture.has_alpha or bool((capture.images[..., 3] >= FAINT).any())
        _check(shows, f"{where}: alpha", "images of a subject", "none that shows anything", "check the masks")
        _still_camera(where, capture)
    _inside(where, capture)
    return capture


def background(where: str, name: str, has_alpha: bool) -> np.ndarray:
    """The colour behind the subject: as named, white for images with alpha where it is none. (3,)"""
    if name == "none" and not has_alpha:
        raise InputError(
            where,
            expected="images with alpha, or a known background",
            found="no alpha and no background given",
            do="set dataset.background to white or black, or add masks",
        )
    return np.full(3, 0.0 if name == "black" else 1.0, np.float32)


def times_in_range(where: str, times: np.ndarray) -> np.ndarray:
    """The times of images as float64. Raises InputError unless all are in 0..1."""
    times = np.asarray(times, np.float64)
    bad = np.flatnonzero(~((times >= 0) & (times <= 1)))
    if len(bad):
        raise InputError(
            f"{where}: time",
            expected="0 to 1",
            found=f"{times[bad[0]]:g} for image {bad[0]} ({len(bad)} such images)",
            do="divide by the last time",
        )
    return times


def about(capture: Capture) -> About:
    """The capture's name and :func:`notes`, for the report."""
    return About(capture.name, tuple(notes(capture)))


def notes(capture: Capture) -> list[str]:
    """What is unusual about the capture, one line each."""
    found = []
    if not capture.has_alpha:
        found.append("no alpha: the subject is told from its background by colour alone")
    else:
        empty = ~(capture.images[..., 3] >= FAINT).any((1, 2))
        if empty.any():
            found.append(f"{int(empty.sum())} of {len(empty)} images show nothing")
    if len(capture.times) > 2:
        step = np.diff(capture.times.astype(np.float64))
        near = np.flatnonzero(step < NEAR_TIMES * np.median(step))
        if len(near):
            pair = f"{capture.times[near[0]]:.5g} and {capture.times[near[0] + 1]:.5g}"
            found.append(f"{len(near)} times nearly equal the next, first {pair}: they count as frames of their own")
    return found


def _numbers(where: str, capture: Capture) -> None:
    count = len(capture.images)
    _check(count > 0, where, "images", "none", "check dataset.path")
    for name, values, most in (("frame", capture.frame, len(capture.times)), ("camera", capture.camera, None)):
        good = len(values) == count and values.min() >= 0 and (most is None or values.max() < most)
        _check(good, f"{where}: {name}", f"{count} numbers from 0" + (f" to {most - 1}" if most else ""), values)
    _check(np.isfinite(capture.fps) and capture.fps > 0, f"{where}: fps", "a rate above zero", capture.fps)


def _times(where: str, times: np.ndarray) -> None:
    times_in_range(where, times)
    _check(bool((np.diff(times) > 0).all()), f"{where}: time", "rising times", times)
    _check(len(times) > 1, f"{where}: time", "two different times or more", "one", "give images of a motion")


def _cameras(where: str, capture: Capture) -> None:
    for i, (view, k) in enumerate(zip(capture.view.astype(np.float64), capture.intrinsics, strict=True)):
        turn = view[:3, :3]
        rigid = np.isfinite(view).all() and np.abs(turn @ turn.T - np.eye(3)).max() < RIGID and np.linalg.det(turn) > 0
        do = "give matrices without scale or mirroring"
        _check(rigid, f"{where}: camera of image {i}", "a rotation and a shift", turn.round(3).tolist(), do)
        good = np.isfinite(k).all() and min(k[0, 0], k[1, 1]) > NARROW * capture.size[1]
        expected = f"focal lengths in pixels, over {NARROW * capture.size[1]:.3g}"
        _check(good, f"{where}: intrinsics of image {i}", expected, np.asarray(k).round(3).tolist())


def _borders(where: str, capture: Capture) -> None:
    a = capture.images[..., 3] >= FAINT
    around = np.concatenate([a[:, 0], a[:, -1], a[:, :, 0], a[:, :, -1]], axis=1).mean(1)
    bad = np.flatnonzero(around > BORDER)
    if 2 * len(bad) > len(a):
        found = f"alpha that covers the borders of {len(bad)} of {len(a)} images"
        raise InputError(
            f"{where}: alpha", expected="a subject before a background", found=found, do="invert the masks"
        )


def _still_camera(where: str, capture: Capture) -> None:
    """One view for all times determines no depth."""
    if len(capture.images) < 2 or len(np.unique(capture.frame)) < 2:
        return
    apart = np.abs(capture.view - capture.view[0]).max()
    size = max(1e-9, float(np.abs(capture.view[:, :3, 3]).max()))
    _check(
        apart > SAME_CAMERA * size,
        f"{where}: cameras",
        "views from several sides",
        f"one camera that stands still for all {len(capture.images)} images: depth is then undetermined (ill-posed)",
        "move the camera round the subject, or use several",
    )


def _inside(where: str, capture: Capture) -> None:
    """Cameras against the sphere round the point that they look at."""
    eye, axis = eyes(capture.view), capture.view[:, 2, :3].astype(np.float64)
    middle = convergence(eye, axis)
    if middle is None:
        return
    ahead = ((middle - eye) * axis).sum(1)
    behind = np.flatnonzero(ahead < 0)
    if 2 * len(behind) > len(eye):
        raise InputError(
            f"{where}: cameras",
            expected="cameras that look at the subject",
            found=f"{len(behind)} of {len(eye)} that look away from where all their axes meet",
            do="check the convention: transforms_*.json hold OpenGL's camera-to-world, cameras.json OpenCV's inverse",
        )
    if not capture.has_alpha:
        return
    radius = float(np.median([_reach(capture, i, middle, eye[i]) for i in range(len(eye))]))
    distance = np.linalg.norm(eye - middle, axis=1)
    inside = np.flatnonzero(distance < radius)
    if len(inside):
        i = int(inside[0])
        raise InputError(
            f"{where}: camera of image {i}",
            expected="a camera outside the subject",
            found=f"one {distance[i]:.3g} from its middle, whose radius is {radius:.3g} ({len(inside)} such cameras)",
            do="check the cameras' unit",
        )


def convergence(eye: np.ndarray, axis: np.ndarray) -> np.ndarray | None:
    """The point nearest to all optical axes, None where they are parallel. eye, axis: (I, 3) -> (3,)"""
    across = np.eye(3) - axis[:, :, None] * axis[:, None, :]
    total = across.sum(0)
    if np.linalg.eigvalsh(total)[0] < 1e-6 * len(eye):
        return None
    return np.linalg.solve(total, (across @ eye[:, :, None]).sum(0)[:, 0])


def _reach(capture: Capture, i: int, middle: np.ndarray, eye: np.ndarray) -> float:
    """The largest distance of `middle` from a ray through the subject in image i."""
    rows, columns = np.nonzero(capture.images[i, ..., 3] >= FAINT)
    if not len(rows):
        return 0.0
    corners = np.stack([columns + 0.5, rows + 0.5, np.ones(len(rows))], axis=1)
    ray = corners @ np.linalg.inv(capture.intrinsics[i].astype(np.float64)).T @ capture.view[i, :3, :3]
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    away = middle - eye
    return float(np.sqrt(np.maximum(away @ away - (ray @ away) ** 2, 0.0).max()))


def _check(ok: bool, where: str, expected: str, found: object, do: str = "") -> None:
    if not ok:
        text = str(found)
        raise InputError(where, expected=expected, found=text if len(text) <= 200 else text[:200] + "...", do=do)
