"""Which points are neighbours that move together, for smoothing over the surface."""

from __future__ import annotations

import numpy as np
from numba import njit

from tasks.geometry import neighbours
from tasks.geometry.parallel import for_chunks

Graph = tuple[np.ndarray, np.ndarray, np.ndarray]  # indptr (N + 1,), indices, shares

_NEAREST = 8
_FRAMES = 24  # frames by which an edge is judged
_RIGID = 0.05  # change of length, relative to the length at rest, at which an edge counts half


def moving_together(points: np.ndarray, canonical: np.ndarray, faces: np.ndarray | None) -> Graph:
    """Neighbours over mesh edges, or over the nearest points where there are no faces.

    An edge counts the less the more its length changes over the frames, so that parts that only touch at rest are not
    tied together. points: (F, N, 3); canonical: (N, 3); faces: (T, 3) or None
    -> (indptr (N + 1,), indices, shares): point n's neighbours and their shares, which sum to one or there are none.
    """
    count = len(canonical)
    edges = neighbours.nearest_edges(canonical, _NEAREST) if faces is None else neighbours.mesh_edges(faces)
    a, b = edges[:, 0], edges[:, 1]
    rest = np.linalg.norm(canonical[a].astype(np.float64) - canonical[b], axis=1)
    change = unsteadiness(points, canonical, a, b[:, None], _FRAMES)[:, 0]
    shortest = max(1e-3 * rest.mean(), 1e-100) if len(rest) else 1.0  # neighbours may all lie in one place
    stretch = change / np.maximum(rest, shortest)
    strength = 1.0 / (1.0 + (stretch / _RIGID) ** 2)
    rows, columns = np.concatenate([a, b]), np.concatenate([b, a])
    order = np.lexsort((columns, rows))
    rows, columns, strength = rows[order], columns[order], np.concatenate([strength, strength])[order]
    indptr = np.concatenate([[0], np.cumsum(np.bincount(rows, minlength=count))]).astype(np.int64)
    shares = strength / np.maximum(np.bincount(rows, strength, minlength=count), 1e-300)[rows]
    return indptr, columns.astype(np.int64), shares


def alone(count: int) -> Graph:
    """The graph without edges."""
    return np.zeros(count + 1, np.int64), np.zeros(0, np.int64), np.zeros(0)


def unsteadiness(
    points: np.ndarray, canonical: np.ndarray, index: np.ndarray, near: np.ndarray, frames: int
) -> np.ndarray:
    """(M, K) root mean square, over up to `frames` frames, of the change of the distance from index[i] to near[i, k].

    points: (F, N, 3); canonical: (N, 3); index: (M,); near: (M, K).
    """
    chosen = np.unique(np.linspace(0, len(points) - 1, frames).round().astype(int))
    some, rest = np.ascontiguousarray(points[chosen], np.float64), canonical.astype(np.float64)
    change = np.empty(near.shape)
    for_chunks(lambda start, stop: _unsteadiness(some, rest, index, near, change, start, stop), len(index), 2048)
    return change


@njit(cache=True, nogil=True)
def _unsteadiness(points, rest, index, near, change, start, stop):
    for i in range(start, stop):
        n = index[i]
        for k in range(near.shape[1]):
            other = near[i, k]
            before = np.sqrt(np.sum((rest[n] - rest[other]) ** 2))
            total = 0.0
            for f in range(len(points)):
                squared = 0.0
                for d in range(3):
                    gap = points[f, n, d] - points[f, other, d]
                    squared += gap * gap
                total += (np.sqrt(squared) - before) ** 2
            change[i, k] = np.sqrt(total / len(points))
