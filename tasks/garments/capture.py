"""DeepMimic motion clips (pybullet's wheel): read, resampled, looped and bent, still on DeepMimic's own skeleton.

A clip is a text file of JSON: frames of [seconds, root position, root rotation, joint rotations], w x y z quaternions,
knees and elbows as one angle about the joint's z axis; +X is ahead, +Y up, +Z to the right. Here it becomes world
rotations in the project's axes: +Z ahead, +Y up, -X to the right.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from tasks.errors import InputError
from tasks.geometry.rotations import from_quaternion, from_rotation_vector, to_rotation_vector

# name, its parent, first column in a frame, number of columns (4 a quaternion, 1 a hinge)
LINKS = (
    ("root", -1, 4, 4),
    ("chest", 0, 8, 4),
    ("neck", 1, 12, 4),
    ("right_hip", 0, 16, 4),
    ("right_knee", 3, 20, 1),
    ("right_ankle", 4, 21, 4),
    ("right_shoulder", 1, 25, 4),
    ("right_elbow", 6, 29, 1),
    ("left_hip", 0, 30, 4),
    ("left_knee", 8, 34, 1),
    ("left_ankle", 9, 35, 4),
    ("left_shoulder", 1, 39, 4),
    ("left_elbow", 11, 43, 1),
)
COLUMNS = 44
AXES = np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])  # DeepMimic's axes to ours
SEAM = 0.35  # share of a cycle over which a loop is bent to end as it began


@dataclass(frozen=True)
class Capture:
    """A clip on DeepMimic's skeleton. local: (F, 13, 3, 3) rotations local to the parent link; root: (F, 3) position of
    the root in metres; fps: frames a second."""

    local: np.ndarray
    root: np.ndarray
    fps: float

    def world(self) -> np.ndarray:
        """Rotations of the links in the world, from the pose in which all limbs hang straight down. (F, 13, 3, 3)"""
        out = self.local.copy()
        for link, (_, parent, _, _) in enumerate(LINKS):
            if parent >= 0:
                out[:, link] = out[:, parent] @ self.local[:, link]
        return out


def read(*, clip: str, cycles: float, fps: float, turn: float, slow: float) -> Capture:
    """A clip of pybullet's wheel by name (`walk` is humanoid3d_walk.txt), resampled.

    cycles: how often it is played, the root going on where it was; turn: degrees a second by which the path is bent to
    the left; slow: 2 is half speed. Raises InputError when the clip is unknown or no DeepMimic clip.
    """
    import pybullet_data

    folder = Path(pybullet_data.getDataPath()) / "data" / "motions"
    path = folder / f"humanoid3d_{clip}.txt"
    if not path.is_file():
        known = sorted(p.stem.removeprefix("humanoid3d_") for p in folder.glob("humanoid3d_*.txt"))
        raise InputError("clip", expected=f"one of {', '.join(known)}", found=clip)
    times, local, root = parse(path.read_text(), where=str(path))
    capture = _sample(times * slow, local, root, cycles=cycles, fps=fps)
    return bend(capture, np.radians(turn)) if turn else capture


def parse(text: str, *, where: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The text of a clip -> times (F,) in seconds, local rotations (F, 13, 3, 3), root positions (F, 3)."""
    frames = np.array(json.loads(text)["Frames"], np.float64)
    if frames.ndim != 2 or frames.shape[1] != COLUMNS or len(frames) < 2:
        raise InputError(where, expected=f"frames of {COLUMNS} numbers", found=str(frames.shape))
    times = np.concatenate([[0.0], np.cumsum(frames[:-1, 0])])
    local = np.empty((len(frames), len(LINKS), 3, 3))
    for link, (_, _, first, width) in enumerate(LINKS):
        values = frames[:, first : first + width]
        if width == 4:
            local[:, link] = from_quaternion(values)
        else:
            local[:, link] = from_rotation_vector(values * np.array([0.0, 0.0, 1.0]))
    return times, AXES @ local @ AXES.T, frames[:, 1:4] @ AXES.T


def bend(capture: Capture, rate: float) -> Capture:
    """The same steps along a curved path: heading grows by `rate` radians a second."""
    heading = rate * np.arange(len(capture.root)) / capture.fps
    turned = from_rotation_vector(heading[:, None] * np.array([0.0, 1.0, 0.0]))
    steps = np.diff(capture.root, axis=0, prepend=capture.root[:1])
    local = capture.local.copy()
    local[:, 0] = turned @ local[:, 0]
    moved = (turned @ steps[..., None])[..., 0]
    return replace(capture, local=local, root=capture.root[:1] + np.cumsum(moved, axis=0))


def heading_of(rotation: np.ndarray) -> np.ndarray:
    """The turn about +Y nearest to a rotation. (3, 3) -> (3, 3)"""
    angle = np.arctan2(rotation[0, 2] - rotation[2, 0], rotation[0, 0] + rotation[2, 2])
    return from_rotation_vector(np.array([0.0, angle, 0.0]))


def _sample(times: np.ndarray, local: np.ndarray, root: np.ndarray, *, cycles: float, fps: float) -> Capture:
    """Poses at even times; from the second cycle on shifted and turned to where the one before ended."""
    length = times[-1]
    if cycles > 1:
        local, root = _close(times / length, local, root)
    count = int(np.floor(cycles * length * fps + 1e-6)) + 1
    at = np.arange(count) / fps
    cycle = np.minimum((at / length).astype(int), int(np.ceil(cycles)) - 1)
    pose, place = _interpolate(times, local, root, at - cycle * length)
    turn = heading_of(local[-1, 0] @ local[0, 0].T)
    travelled = root[-1] - root[0]
    turned, start = np.eye(3), np.zeros(3)
    for c in range(int(cycle.max()) + 1):
        here = cycle == c
        place[here] = start + (place[here] - root[0]) @ turned.T + root[0]
        pose[here, 0] = turned @ pose[here, 0]
        start, turned = start + turned @ travelled, turned @ turn
    return Capture(pose, place, fps)


def _close(phase: np.ndarray, local: np.ndarray, root: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Bends the last part of a cycle so that it ends in the pose it began with, heading and place aside."""
    ease = np.clip((phase - 1 + SEAM) / SEAM, 0, 1)
    ease = ease**2 * (3 - 2 * ease)
    first = local[0].copy()
    first[0] = heading_of(local[-1, 0] @ local[0, 0].T) @ first[0]
    missing = to_rotation_vector(first @ np.swapaxes(local[-1], -1, -2))
    rise = root.copy()
    rise[:, 1] += ease * (root[0, 1] - root[-1, 1])
    return from_rotation_vector(ease[:, None, None] * missing) @ local, rise


def _interpolate(times: np.ndarray, local: np.ndarray, root: np.ndarray, at: np.ndarray):
    i = np.clip(np.searchsorted(times, at, side="right") - 1, 0, len(times) - 2)
    t = np.clip((at - times[i]) / (times[i + 1] - times[i]), 0, 1)
    step = to_rotation_vector(local[i + 1] @ np.swapaxes(local[i], -1, -2))
    return from_rotation_vector(t[:, None, None] * step) @ local[i], root[i] + t[:, None] * (root[i + 1] - root[i])
