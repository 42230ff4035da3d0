"""Exact nearest windows on SO(3).

Chordal distance is one matrix product but ranks wrongly, and a short list of chordal candidates can miss the best ones.
The geodesic distance of two *windows* is a sum along a diagonal of the geodesic distances of *frames*, so those are
computed once per pair of frames and every window length and stride is read off them: exact, and with a polynomial
arcsine faster than chordal candidates with an exact second pass.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from numba import njit

from tasks.geometry.parallel import for_chunks

QUERY_BLOCK, DATABASE_BLOCK = 256, 2048  # frames of one tile; its distances (3 MB) stay in the processor's cache


@dataclass(frozen=True)
class Keys:
    """What frames are compared by. rotations: (F, J, 4) float32 unit quaternions of the joints of one part;
    extra: (F, E, 3) float32 vectors whose differences count like radians of every joint; clip_start: (C+1,)."""

    rotations: np.ndarray
    extra: np.ndarray
    clip_start: np.ndarray

    @property
    def scale(self) -> int:
        """Number of joints: distances are divided by it."""
        return self.rotations.shape[1]

    @cached_property
    def columns(self) -> tuple[np.ndarray, np.ndarray]:
        """(J, 4, F) and (E, 3, F): frames innermost, for vector units."""
        return tuple(np.ascontiguousarray(x.transpose(1, 2, 0)) for x in (self.rotations, self.extra))


@dataclass(frozen=True)
class Matches:
    """The k nearest windows of every query window, one row a pyramid level.

    distance: (L, T, k) float32, mean angle in radians over the window's joints and frames, inf where there are fewer
    than k; start: (L, T, k) int32 first database frame, -1 where there are fewer; count: (L,) query windows of a level.
    """

    distance: np.ndarray
    start: np.ndarray
    count: np.ndarray


def nearest_windows(
    query: Keys, database: Keys, *, k: int, patch: int, strides: list[int], skip: tuple[int, ...] = ()
) -> Matches:
    """K nearest windows of ``patch`` frames, ``stride`` apart, none of which crosses a clip (GaussiAnimate eq. 8).

    query: one clip; every stride must satisfy (patch - 1) stride < its frames. skip: clips of the database that are
    left out. Ties go to the earlier window.
    """
    frames = len(query.rotations)
    count = np.array([frames - (patch - 1) * s for s in strides], np.int64)
    distance = np.full((len(strides), count.max(), k), np.inf, np.float32)
    start = np.full((len(strides), count.max(), k), -1, np.int32)
    reach = (patch - 1) * max(strides)

    def block(first: int, last: int) -> None:
        rows = slice(first, min(last + reach, frames))
        for a, b in (ab for clip, ab in enumerate(pairwise(database.clip_start)) if clip not in skip):
            for c in range(int(a), int(b), DATABASE_BLOCK):
                columns = c, min(c + DATABASE_BLOCK + reach, int(b))
                tile = frame_distances(query.rotations[rows], query.extra[rows], database, *columns)
                for level, stride in enumerate(strides):
                    windows = slice(first, min(last, int(count[level])))
                    starts = min(c + DATABASE_BLOCK, int(b) - (patch - 1) * stride) - c
                    if windows.stop > windows.start and starts > 0:
                        _scan(tile, c, starts, patch, stride, distance[level, windows], start[level, windows])

    for_chunks(block, int(count.max()), QUERY_BLOCK)
    distance /= patch * query.scale
    return Matches(distance, start, count)


def frame_distances(rotations: np.ndarray, extra: np.ndarray, database: Keys, first: int, last: int) -> np.ndarray:
    """Sum over joints of the angle between the rotations of two frames, for all pairs of frames.

    rotations: (T, J, 4); extra: (T, E, 3), whose Euclidean distances are added J times, so that their share does not
    depend on the number of joints; against frames first:last of the database -> (T, last - first) float32, radians.
    """
    out = np.zeros((len(rotations), last - first), np.float32)
    keys, key_extra = database.columns
    _add_angles(np.ascontiguousarray(rotations), keys, first, out)
    if extra.shape[1]:
        _add_extra(np.ascontiguousarray(extra), key_extra, first, np.float32(rotations.shape[1]), out)
    return out


_FAST = {"contract", "nnan", "ninf", "nsz"}  # lets the loops over frames use vector units; sums keep their order


@njit(cache=True, nogil=True, fastmath=_FAST)
def _add_angles(rotations: np.ndarray, keys: np.ndarray, first: int, out: np.ndarray) -> None:
    """angle = 4 asin(|q -+ k| / 2): exact near zero, where the arccosine of a dot product is not.

    With w = |q -+ k|^2 / 4 in [0, 1/2] it is 4 sqrt(w) P(w), P a Chebyshev interpolant of asin(sqrt w) / sqrt w,
    right to 6e-8 radians.
    """
    quarter, four, last = np.float32(0.25), np.float32(4.0), first + out.shape[1]
    for t in range(len(rotations)):
        row = out[t]
        for j in range(rotations.shape[1]):
            a, b, c, d = rotations[t, j, 0], rotations[t, j, 1], rotations[t, j, 2], rotations[t, j, 3]
            ka, kb = keys[j, 0][first:last], keys[j, 1][first:last]
            kc, kd = keys[j, 2][first:last], keys[j, 3][first:last]
            for u in range(len(row)):
                minus = (a - ka[u]) ** 2 + (b - kb[u]) ** 2 + (c - kc[u]) ** 2 + (d - kd[u]) ** 2
                plus = (a + ka[u]) ** 2 + (b + kb[u]) ** 2 + (c + kc[u]) ** 2 + (d + kd[u]) ** 2
                w = quarter * min(minus, plus)
                p = np.float32(0.10967398)
                p = p * w + np.float32(-0.09008622)
                p = p * w + np.float32(0.07553975)
                p = p * w + np.float32(0.01673139)
                p = p * w + np.float32(0.04648085)
                p = p * w + np.float32(0.07488114)
                p = p * w + np.float32(0.16666955)
                p = p * w + np.float32(0.99999999)
                row[u] += four * np.sqrt(w) * p


@njit(cache=True, nogil=True, fastmath=_FAST)
def _add_extra(extra: np.ndarray, keys: np.ndarray, first: int, scale: np.float32, out: np.ndarray) -> None:
    last = first + out.shape[1]
    for t in range(len(extra)):
        row = out[t]
        for e in range(extra.shape[1]):
            a, b, c = extra[t, e, 0], extra[t, e, 1], extra[t, e, 2]
            ka, kb, kc = keys[e, 0][first:last], keys[e, 1][first:last], keys[e, 2][first:last]
            for u in range(len(row)):
                row[u] += scale * np.sqrt((a - ka[u]) ** 2 + (b - kb[u]) ** 2 + (c - kc[u]) ** 2)


@njit(cache=True, nogil=True)
def _scan(tile, offset, starts, patch, stride, distance, start):
    """Sums the tile along diagonals and keeps the smallest sums. distance, start: (windows, k), sorted, in and out."""
    k = distance.shape[1]
    total = np.empty(starts, np.float32)
    for t in range(len(distance)):
        total[:] = tile[t, :starts]
        for i in range(1, patch):
            total += tile[t + i * stride, i * stride : i * stride + starts]
        worst = distance[t, k - 1]
        for u in range(starts):
            if total[u] < worst:
                place = k - 1
                while place > 0 and distance[t, place - 1] > total[u]:
                    distance[t, place] = distance[t, place - 1]
                    start[t, place] = start[t, place - 1]
                    place -= 1
                distance[t, place] = total[u]
                start[t, place] = offset + u
                worst = distance[t, k - 1]
