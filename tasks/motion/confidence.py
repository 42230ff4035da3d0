"""How far a pose lies from the database, and what error that has meant among the training clips."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated

import numpy as np

from tasks.geometry.measure import diagonal
from tasks.motion.matching import one_clip
from tasks.motion.posed import Posed
from tasks.motion.query import check_poses
from tasks.motion.regression import shape_units, to_numbers
from tasks.motion.search import nearest_windows
from tasks.values import Confidence, Poses, Training

LEAST = 5  # frames that a line is fitted to
TINY = 1e-4  # radians, and diagonals of the body, below which differences mean nothing


def confidence(
    training: Training,
    query: Poses,
    *,
    k: Annotated[int, "[1, inf)"],
    patch: Annotated[int, "[1, inf)"],
    dynamics: Annotated[float, "[0, inf)"],
) -> Confidence:
    """What to think of any method's answer to the query, from the poses alone.

    k, patch, dynamics: of the windows that are compared, as in matching. A frame's distance is the mean over parts and
    their k nearest windows. It is calibrated on the training clips, each matched against the others: than how many of
    their frames it is farther, and by a power law what error matching made there. (Of distances, differences between
    matches and motion, the mean distance alone ranked the errors of left-out training clips best.)
    Raises InputError for bad poses.
    """
    check_poses(query, training.skeleton, "query")
    known = Posed(training, training.database.poses)

    def look(poses: Poses, clip: int, skip: int | None = None) -> tuple[np.ndarray, np.ndarray]:
        return _look(known, poses, clip, k, patch, dynamics, skip)

    windows, distance = map(
        np.concatenate, zip(*(look(query, c) for c in range(len(query.clip_start) - 1)), strict=True)
    )
    far = distance.mean((1, 2), dtype=np.float64)
    expected, outside = _calibrated(training, known, far, patch, lambda clip: look(known.poses, clip, clip))
    return Confidence(windows, distance, expected.astype(np.float32), outside.astype(np.float32), training.parts.names)


def _calibrated(
    training: Training, known: Posed, far: np.ndarray, patch: int, left_out: Callable[[int], tuple]
) -> tuple[np.ndarray, np.ndarray]:
    """Expected errors and shares of nearer training frames for distances (F,); zeros where too few training frames have
    a window of another clip beside them. left_out: a training clip matched against the others."""
    start = known.poses.clip_start
    long = np.diff(start) >= patch
    judged = [c for c in range(len(long)) if np.delete(long, c).any()]
    frames = np.concatenate([np.zeros(0, int), *(np.arange(start[c], start[c + 1]) for c in judged)])
    if len(frames) < LEAST:
        return np.zeros(len(far)), np.zeros(len(far))
    others, apart = map(np.concatenate, zip(*map(left_out, judged), strict=True))
    seen = apart.mean((1, 2), dtype=np.float64)
    outside = np.searchsorted(np.sort(seen), far) / len(seen)
    least = TINY * diagonal(training.canonical.points)
    slope, level = np.polyfit(np.log(seen + TINY), np.log(_errors(training, known, others, frames) + least), 1)
    return np.exp(level + max(slope, 0.0) * np.log(far + TINY)), outside


def _errors(training: Training, known: Posed, windows: np.ndarray, frames: np.ndarray) -> np.ndarray:
    """Error of some training frames as the mean of their matches predicts them, about the RMSE of their points.
    windows: (F, P, k) training frames for each of the frames (F,) -> (F,)."""
    residual = to_numbers(known.encode(training.database.bones, "residual")) * shape_units(training)
    predicted = np.zeros_like(residual[frames])
    for part, affinity in enumerate(training.parts.affinity):
        follows = np.flatnonzero(affinity > 0)
        for nearest in windows[:, part].T:
            predicted[:, follows] += affinity[follows, None] * residual[nearest][:, follows] / windows.shape[2]
    return np.sqrt(((predicted - residual[frames]) ** 2).sum((1, 2)))


def _look(
    known: Posed, poses: Poses, clip: int, k: int, patch: int, dynamics: float, skip: int | None
) -> tuple[np.ndarray, np.ndarray]:
    """One clip against the database: for each frame and part the training frames that the nearest windows have in its
    place, (F, P, k) int32, and their distance, (F, P, k) float32. skip: a training clip left out."""
    length = int(poses.clip_start[clip + 1] - poses.clip_start[clip])
    asked = Posed(known.training, one_clip(poses, clip, patch), known)
    at = np.clip(np.arange(length) - patch // 2, 0, len(asked.world) - patch)  # the window with the frame in its middle
    windows, distance = [], []
    for part in range(len(known.training.parts.names)):
        keys = asked.keys(part, dynamics), known.keys(part, dynamics)
        found = nearest_windows(*keys, k=k, patch=patch, strides=[1], skip=() if skip is None else (skip,))
        near, first = found.distance[0][at], found.start[0][at]
        few = first < 0  # a small database has fewer windows: the nearest stands for those that it lacks
        distance.append(np.where(few, near[:, :1], near))
        windows.append(np.where(few, first[:, :1], first) + (np.arange(length) - at)[:, None])
    return np.stack(windows, 1).astype(np.int32), np.stack(distance, 1).astype(np.float32)
