"""Bones as frames, [R | where the bone's centroid is], by the hundred thousands: numpy's small matrix products take ten
times as long. What they do stands in :mod:`tasks.geometry.rigid`; the tests tie them."""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def placed(transforms: np.ndarray, centres: np.ndarray, out: np.ndarray) -> None:
    """Transforms on canonical points (F, B, 3, 4), centroids (B, 3) -> frames, into out (F, B, 3, 4)."""
    for f in range(len(transforms)):
        for b in range(len(centres)):
            x, y, z = centres[b, 0], centres[b, 1], centres[b, 2]
            for r in range(3):
                row = transforms[f, b, r]
                out[f, b, r, 0], out[f, b, r, 1], out[f, b, r, 2] = row[0], row[1], row[2]
                out[f, b, r, 3] = row[0] * x + row[1] * y + row[2] * z + row[3]


@njit(cache=True, nogil=True)
def seen_from(base: np.ndarray, frames: np.ndarray, out: np.ndarray) -> None:
    """base^-1 frames, into out: base (F, B, 3, 4), or (F, 1, 3, 4) for all bones; frames, out (F, B, 3, 4), which may
    be the same array."""
    column = np.empty(3)
    for f in range(len(frames)):
        for b in range(frames.shape[1]):
            at = base[f, b if base.shape[1] > 1 else 0]
            for c in range(4):
                for r in range(3):
                    column[r] = frames[f, b, r, c] - (at[r, 3] if c == 3 else 0.0)
                for r in range(3):
                    out[f, b, r, c] = at[0, r] * column[0] + at[1, r] * column[1] + at[2, r] * column[2]
