"""Moving points in 16 bits: steps of fixed size, stored as what linear extrapolation in time leaves over.

The codes are small numbers whose high bytes are nearly all alike, which zlib packs well; decoding is exact integer
arithmetic, so the only error is the rounding to steps: at most half a step in each coordinate.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from tasks.errors import InputError

RANGE = 32767


def encode(points: np.ndarray, clip_start: np.ndarray, step: float) -> np.ndarray:
    """points: (F, N, 3) within +-32767 steps; clips are coded apart. -> (2, F, N, 3) uint8, low and high bytes."""
    counts = np.rint(points.astype(np.float64) / step)
    if not np.abs(counts).max() <= RANGE:
        raise InputError("points", expected=f"within {RANGE * step:g} of the origin", found=f"{np.abs(points).max():g}")
    codes = counts.astype(np.int64)
    for _ in range(2):
        codes = _within_clips(codes, clip_start, lambda c: np.diff(c, axis=0, prepend=0))
    # zigzag: small negative numbers become small positive ones; modulo 2^16, as sums wrap back on decoding
    codes = ((codes + 32768) % 65536 - 32768).astype(np.int16)
    folded = ((codes << 1) ^ (codes >> 15)).view(np.uint16)
    return np.stack([folded & 255, folded >> 8]).astype(np.uint8)


def decode(codes: np.ndarray, clip_start: np.ndarray, step: float) -> np.ndarray:
    """(2, F, N, 3) uint8 -> (F, N, 3) float64: the inverse of :func:`encode`, to within half a step."""
    folded = codes[0].astype(np.uint16) | (codes[1].astype(np.uint16) << 8)
    values = ((folded >> 1) ^ (~(folded & 1) + np.uint16(1))).view(np.int16).astype(np.int64)
    for _ in range(2):
        values = _within_clips(values, clip_start, lambda c: np.cumsum(c, axis=0))
    return ((values + 32768) % 65536 - 32768) * step


def _within_clips(values: np.ndarray, clip_start: np.ndarray, what) -> np.ndarray:
    return np.concatenate([what(values[a:b]) for a, b in pairwise(clip_start)])
