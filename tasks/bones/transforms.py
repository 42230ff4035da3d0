"""Bone transforms from sums over points (Le & Deng 2012, section 4.2), at a cost that does not grow with the points.

A bone is held as its offset D = [R - I | t] in aligned coordinates (:mod:`tasks.bones.trajectories`), laid out
(B, 4, 3, F): column of D, coordinate, frame, so that all frames of one number stand together. With weights w and
homogeneous rest points h the error of bones is

    E = sum_n |sum_b w_nb D_b h_n - u_n|^2 = sum |u|^2 - 2 <D, Y> + <D K, D>,
    K_bc = sum_n w_nb w_nc h_n h_n^T  (4, 4),   Y_b = sum_n w_nb h_n u_n^T  (4, 3F).
"""

from __future__ import annotations

import numpy as np
from numba import njit

from tasks.bones.products import product
from tasks.bones.rotation import nearest_rotation
from tasks.bones.trajectories import Trajectories
from tasks.geometry.parallel import for_chunks

_POINTS = 1024  # points whose sums are taken together
_FRAMES = 32  # frames solved together: enough for long inner loops, and their offsets fit the second-level cache
_WORTH = 2048  # rotations below which a thread is not worth its start
_HOLD = 1e-7  # how firmly a rotation that the points do not determine keeps its last value


def sums(paths: Trajectories, index: np.ndarray, value: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """K (B, B, 4, 4) and Y (B, 4, 3, F) of sparse weights.

    index: (N, S) int32 bones of each point, -1 for none; value: (N, S) their weights.
    """
    width = paths.path.shape[1]

    def work(start: int, stop: int) -> tuple[np.ndarray, np.ndarray]:
        k, y = np.zeros((count, count, 4, 4)), np.zeros((count, 4, width))
        _add_sums(paths.rest, paths.path, index, value, k, y, start, stop)
        return k, y

    pieces = for_chunks(work, len(index), _POINTS)
    k, y = sum(p[0] for p in pieces), sum(p[1] for p in pieces)
    full = product(y.reshape(count * 4, width), paths.basis.T)
    return k, full.reshape(count, 4, 3, paths.frames)


def sweep(k: np.ndarray, y: np.ndarray, offsets: np.ndarray, sweeps: int) -> float:
    """Gauss-Seidel: each bone in turn takes its best rigid transform, the others held. Changes offsets in place.

    k, y: see :func:`sums`; offsets: (B, 4, 3, F) -> E - sum |u|^2 afterwards.
    """

    def work(start: int, stop: int) -> float:
        return _sweep(k, y, offsets, start, stop, sweeps)

    return sum(for_chunks(work, offsets.shape[3], _FRAMES))


def extrapolate(now: np.ndarray, before: np.ndarray, step: float) -> np.ndarray:
    """now + step (now - before), rotations projected back to SO(3). now, before: (B, 4, 3, F)."""
    out = now + step * (now - before)
    for_chunks(lambda start, stop: _make_rotations(out, now, start, stop), out.shape[3], _FRAMES)
    return out


def rigid_fit(k: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The best rigid transform of groups of points that share none. k: (B, 4, 4); y: (B, 4, 3, F)
    -> offsets (B, 4, 3, F) and, for each group, E - sum |u|^2."""
    offsets, gain = np.zeros_like(y), np.zeros(len(k))
    groups = max(4, _WORTH // y.shape[3])
    for_chunks(lambda start, stop: _rigid_fit(k, y, offsets, gain, start, stop), len(k), groups)
    return offsets, gain


@njit(cache=True, nogil=True)
def add_moments(rest, index, value, k):
    """k (B, B, 4, 4) += K of the given points."""
    slots = index.shape[1]
    for n in range(len(rest)):
        h = rest[n]
        for s in range(slots):
            b = index[n, s]
            if b < 0:
                continue
            for r in range(slots):
                c = index[n, r]
                if c < 0:
                    continue
                both = value[n, s] * value[n, r]
                for i in range(4):
                    for j in range(4):
                        k[b, c, i, j] += both * h[i] * h[j]


@njit(cache=True, nogil=True)
def _add_sums(rest, path, index, value, k, y, start, stop):
    add_moments(rest[start:stop], index[start:stop], value[start:stop], k)
    for n in range(start, stop):
        for s in range(index.shape[1]):
            b = index[n, s]
            if b < 0:
                continue
            for i in range(4):
                factor = value[n, s] * rest[n, i]
                for p in range(path.shape[1]):
                    y[b, i, p] += factor * path[n, p]


@njit(cache=True, nogil=True)
def _target(k, y, offsets, b, start, stop, skip, out):
    """out (4, 3, stop - start) = Y_b - sum_c K_bc D_c, without c = b if skip."""
    for i in range(4):
        for d in range(3):
            for f in range(start, stop):
                out[i, d, f - start] = y[b, i, d, f]
    for c in range(len(k)):
        if k[b, c, 3, 3] == 0.0 or (skip and c == b):
            continue
        m = k[b, c]
        for d in range(3):
            d0, d1, d2, d3 = offsets[c, 0, d], offsets[c, 1, d], offsets[c, 2, d], offsets[c, 3, d]
            o0, o1, o2, o3 = out[0, d], out[1, d], out[2, d], out[3, d]
            for f in range(stop - start):
                x0, x1, x2, x3 = d0[start + f], d1[start + f], d2[start + f], d3[start + f]
                o0[f] -= m[0, 0] * x0 + m[0, 1] * x1 + m[0, 2] * x2 + m[0, 3] * x3
                o1[f] -= m[1, 0] * x0 + m[1, 1] * x1 + m[1, 2] * x2 + m[1, 3] * x3
                o2[f] -= m[2, 0] * x0 + m[2, 1] * x1 + m[2, 2] * x2 + m[2, 3] * x3
                o3[f] -= m[3, 0] * x0 + m[3, 1] * x1 + m[3, 2] * x2 + m[3, 3] * x3


@njit(cache=True, nogil=True)
def _sweep(k, y, offsets, start, stop, sweeps):
    target = np.empty((4, 3, stop - start))
    for _ in range(sweeps):
        for b in range(len(k)):
            if k[b, b, 3, 3] > 0.0:
                _target(k, y, offsets, b, start, stop, True, target)
                _procrustes(k[b, b], target, offsets[b], start, stop)
    change = 0.0
    for b in range(len(k)):
        _target(k, y, offsets, b, start, stop, False, target)
        for i in range(4):
            for d in range(3):
                for f in range(start, stop):
                    change -= offsets[b, i, d, f] * (y[b, i, d, f] + target[i, d, f - start])
    return change


@njit(cache=True, nogil=True)
def _procrustes(k, target, offset, start, stop):
    """Weighted Procrustes of one bone: k (4, 4), target (4, 3, frames) -> offset (4, 3, F) in place.

    Moments about the weighted centroid; a weak pull to the last rotation decides what the points leave open.
    """
    total = k[3, 3]
    spread = 0.0
    centred = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            centred[i, j] = k[i, j] - k[i, 3] * k[3, j] / total
        spread += centred[i, i]
    hold = _HOLD * spread + 1e-14 * total
    m, r = np.empty((3, 3)), np.empty((3, 3))
    for f in range(start, stop):
        for d in range(3):
            for i in range(3):
                last = offset[i, d, f] + (1.0 if i == d else 0.0)
                moved = target[i, d, f - start] - target[3, d, f - start] * k[i, 3] / total
                m[d, i] = centred[d, i] + moved + hold * last
        nearest_rotation(m, r)
        for d in range(3):
            shift = target[3, d, f - start]
            for i in range(3):
                offset[i, d, f] = r[d, i] - (1.0 if i == d else 0.0)
                shift -= offset[i, d, f] * k[i, 3]
            offset[3, d, f] = shift / total


@njit(cache=True, nogil=True)
def _rigid_fit(k, y, offsets, gain, start, stop):
    frames = y.shape[3]
    for b in range(start, stop):
        if k[b, 3, 3] <= 0.0:
            continue
        _procrustes(k[b], y[b], offsets[b], 0, frames)
        for i in range(4):
            for d in range(3):
                for f in range(frames):
                    moved = 0.0
                    for j in range(4):
                        moved += k[b, i, j] * offsets[b, j, d, f]
                    gain[b] += offsets[b, i, d, f] * (moved - 2.0 * y[b, i, d, f])


@njit(cache=True, nogil=True)
def _make_rotations(offsets, fallback, start, stop):
    m, r = np.empty((3, 3)), np.empty((3, 3))
    for b in range(len(offsets)):
        for f in range(start, stop):
            for d in range(3):
                for i in range(3):
                    one = 1.0 if i == d else 0.0
                    m[d, i] = offsets[b, i, d, f] + one + 1e-9 * (fallback[b, i, d, f] + one)
            nearest_rotation(m, r)
            for d in range(3):
                for i in range(3):
                    offsets[b, i, d, f] = r[d, i] - (1.0 if i == d else 0.0)
