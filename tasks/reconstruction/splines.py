"""Uniform cubic B-splines over the frames of clips, which never share a knot."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np


@dataclass(frozen=True)
class Spline:
    """first: (F,) int64, the first of the four knots that a frame blends; weights: (F, 4) float32, rows sum to one;
    clip_knots: (C+1,) int64, clip c has the knots clip_knots[c]:clip_knots[c+1]."""

    first: np.ndarray
    weights: np.ndarray
    clip_knots: np.ndarray

    @property
    def knots(self) -> int:
        """Number of knots of all clips."""
        return int(self.clip_knots[-1])


def spline(clip_start: np.ndarray, spacing: float) -> Spline:
    """Knots at most ``spacing`` frames apart for every clip. clip_start: (C+1,) rising frame numbers from 0.

    A clip of m segments has m + 3 knots; its first and last frame lie on the ends of the first and the last segment.
    """
    first, place, start = [], [], [0]
    for a, b in pairwise(clip_start.tolist()):
        segments = max(1, math.ceil((b - a - 1) / spacing))
        along = np.arange(b - a) * (segments / max(b - a - 1, 1))
        segment = np.minimum(along.astype(np.int64), segments - 1)
        first.append(start[-1] + segment)
        place.append(along - segment)
        start.append(start[-1] + segments + 3)
    return Spline(np.concatenate(first), _cubic(np.concatenate(place)), np.array(start, np.int64))


def _cubic(u: np.ndarray) -> np.ndarray:
    """The four weights of a uniform cubic B-spline at u in 0..1. (F,) -> (F, 4)."""
    parts = [(1 - u) ** 3, 3 * u**3 - 6 * u**2 + 4, -3 * u**3 + 3 * u**2 + 3 * u + 1, u**3]
    return (np.stack(parts, axis=1) / 6.0).astype(np.float32)
