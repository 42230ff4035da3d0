"""The rest shape that a decomposition deforms, refined from all frames.

A few rigid bones cannot show every frame exactly. Held to the canonical points the canonical frame alone would be
exact, and all others would pay for it. With weights and bones given, the best rest point is a linear least squares
problem of three unknowns. (Le & Deng 2012 hold the rest shape; Kavan et al. 2010 refine it, too.)
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numba import njit

from tasks.bones.products import product
from tasks.bones.trajectories import Trajectories
from tasks.geometry.parallel import for_chunks

_POINTS = 256  # points a thread takes at a time


def refine(
    paths: Trajectories, offsets: np.ndarray, index: np.ndarray, value: np.ndarray, home: np.ndarray, firmness: float
) -> Trajectories:
    """Moves every rest point to the minimum of mean_f |sum_b w_b T_fb g - x_f|^2 + firmness |g - home|^2 / F.

    offsets: (B, 4, 3, F); index, value: (N, S) the weights; home: (N, 4) canonical points in aligned coordinates;
    firmness: how many frames the canonical point counts for, beside those that were seen.
    Returns paths from the new rest shape; the given ones are left as they are.
    """
    count, frames = len(offsets), paths.frames
    flat = offsets.reshape(count * 4, -1)
    rows = product(flat, paths.basis).reshape(count, 4, -1) / frames
    gram = product(flat, flat.T).reshape(count, 4, count, 4) / frames
    mean = offsets.mean(axis=3)
    shift = paths.basis.reshape(3, frames, -1).sum(axis=1)
    rest, path = paths.rest.copy(), paths.path.copy()

    def work(start: int, stop: int) -> None:
        _refine(rest, path, frames, rows, gram, mean, shift, index, value, home, firmness / frames, start, stop)

    for_chunks(work, len(rest), _POINTS)
    moved = replace(paths, rest=rest, path=path)
    return replace(moved, energy=moved.squared + max(paths.energy - paths.squared, 0.0))


@njit(cache=True, nogil=True)
def _refine(rest, path, frames, rows, gram, mean, shift, index, value, home, firmness, start, stop):
    slots, width = index.shape[1], path.shape[1]
    a, b = np.empty((3, 3)), np.empty(3)
    for n in range(start, stop):
        h = rest[n]
        a[:] = 0.0
        for i in range(3):
            a[i, i] = 1.0 + firmness
            total = 0.0
            for p in range(width):
                total += shift[i, p] * path[n, p]
            b[i] = total / frames + firmness * (home[n, i] - h[i])
        for s in range(slots):
            one = index[n, s]
            if one < 0:
                continue
            w = value[n, s]
            for i in range(3):
                total = 0.0
                for p in range(width):
                    total += rows[one, i, p] * path[n, p]
                for k in range(4):
                    total -= h[k] * mean[one, k, i]
                b[i] += w * total
                for j in range(3):
                    a[i, j] += w * (mean[one, j, i] + mean[one, i, j])
            for r in range(slots):
                other = index[n, r]
                if other < 0:
                    continue
                both = w * value[n, r]
                for i in range(3):
                    for j in range(3):
                        a[i, j] += both * gram[one, i, other, j]
                    for k in range(4):
                        b[i] -= both * gram[one, i, other, k] * h[k]
        _solve(a, b)
        for i in range(3):
            rest[n, i] += b[i]
        for p in range(width):
            path[n, p] -= b[0] * shift[0, p] + b[1] * shift[1, p] + b[2] * shift[2, p]


@njit(cache=True, nogil=True)
def _solve(a, b):
    """b becomes the solution x of a x = b. a: (3, 3) symmetric and positive."""
    c0 = a[1, 1] * a[2, 2] - a[1, 2] * a[2, 1]
    c1 = a[1, 2] * a[2, 0] - a[1, 0] * a[2, 2]
    c2 = a[1, 0] * a[2, 1] - a[1, 1] * a[2, 0]
    det = a[0, 0] * c0 + a[0, 1] * c1 + a[0, 2] * c2
    d1, d2 = a[0, 0] * a[2, 2] - a[0, 2] * a[2, 0], a[0, 0] * a[1, 1] - a[0, 1] * a[1, 0]
    d12 = a[0, 2] * a[1, 0] - a[0, 0] * a[1, 2]
    x = c0 * b[0] + c1 * b[1] + c2 * b[2]
    y = c1 * b[0] + d1 * b[1] + d12 * b[2]
    z = c2 * b[0] + d12 * b[1] + d2 * b[2]
    b[0], b[1], b[2] = x / det, y / det, z / det
