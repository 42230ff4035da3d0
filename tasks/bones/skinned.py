"""How closely sparse weights and bones show the points, from the points as they came."""

from __future__ import annotations

import numpy as np
from numba import njit

from tasks.geometry.parallel import for_chunks

_FRAMES = 4  # frames a thread takes at a time


def skinned_rmse(
    rest: np.ndarray, index: np.ndarray, value: np.ndarray, bones: np.ndarray, points: np.ndarray
) -> float:
    """Vertex RMSE of sum_s value_ns T_f,index_ns v_n against the points, without the posed shapes in memory.

    rest: (N, 3); index, value: (N, S) bones of each point, -1 for none, and their weights; bones: (F, B, 3, 4);
    points: (F, N, 3).
    """
    rest, bones = np.asarray(rest, np.float64), np.ascontiguousarray(bones, np.float64)
    points = np.ascontiguousarray(points, np.float32)
    total = sum(for_chunks(lambda a, b: _squared(rest, index, value, bones, points, a, b), len(points), _FRAMES))
    return float(np.sqrt(total / (len(points) * len(rest))))


@njit(cache=True, nogil=True)
def _squared(rest, index, value, bones, points, start, stop):
    """Sum of squared distances; posed points are rounded to float32 as :func:`tasks.geometry.skinning.skin` does."""
    total = 0.0
    blend = np.empty((3, 4))
    for f in range(start, stop):
        for n in range(len(rest)):
            blend[:] = 0.0
            for s in range(index.shape[1]):
                b = index[n, s]
                if b >= 0:
                    w = value[n, s]
                    for i in range(3):
                        for j in range(4):
                            blend[i, j] += w * bones[f, b, i, j]
            for i in range(3):
                x = blend[i, 0] * rest[n, 0] + blend[i, 1] * rest[n, 1] + blend[i, 2] * rest[n, 2] + blend[i, 3]
                gap = np.float64(np.float32(x)) - points[f, n, i]
                total += gap * gap
    return total
