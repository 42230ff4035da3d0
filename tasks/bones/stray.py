"""Points that move like nothing around them: mistracked points, floaters. They must not get bones of their own."""

from __future__ import annotations

import numpy as np
from numba import njit
from scipy.spatial import cKDTree

from tasks.geometry.neighbours import mesh_edges
from tasks.geometry.parallel import for_chunks

_REFERENCE = 8000  # points that others are compared with
_NEAREST = 8
_STEADIEST = 1  # a point is judged by its second steadiest neighbour: at a joint not all move with it
_FRAMES = 16
_TIMES = 8.0  # how much less steady a point's distances are than those of the points around it
_LEAST = 0.02  # and by how much they change at least, relative to the shape's extent


def trusted(points: np.ndarray, canonical: np.ndarray, faces: np.ndarray | None) -> np.ndarray:
    """(N,) bool, False for points whose distances to the points around them change far more than theirs do.

    points: (F, N, 3); canonical: (N, 3); faces: (T, 3) or None, whose edges count as neighbours too.
    A limb, a skirt, a part that comes off moves with its neighbours and is kept.
    """
    total = len(canonical)
    if total <= 2 * _NEAREST:
        return np.ones(total, bool)
    reference = np.unique(np.linspace(0, total - 1, min(total, _REFERENCE)).round().astype(int))
    _, near = cKDTree(canonical[reference]).query(canonical, k=_NEAREST + 1)
    near = reference[near]
    frames = np.unique(np.linspace(0, len(points) - 1, _FRAMES).round().astype(int))
    some = np.ascontiguousarray(points[frames], np.float64)
    change = np.empty((total, near.shape[1]))
    rest, each = canonical.astype(np.float64), np.arange(total)
    for_chunks(lambda start, stop: _unsteadiness(some, rest, each, near, change, start, stop), total, 2048)
    change[near == each[:, None]] = np.nan
    own = np.sort(change, axis=1)[:, _STEADIEST]  # not-a-number comes last
    if faces is not None:
        a, b = mesh_edges(faces).T
        edge = np.empty((len(a), 1))
        for_chunks(lambda start, stop: _unsteadiness(some, rest, a, b[:, None], edge, start, stop), len(a), 2048)
        np.minimum.at(own, a, edge[:, 0])
        np.minimum.at(own, b, edge[:, 0])
    around = np.minimum(
        np.median(own[near], axis=1), 2.0 * np.percentile(own, 95)
    )  # strays may have strays around them
    low, high = np.percentile(rest, [5, 95], axis=0)
    return (own <= _TIMES * around) | (own <= _LEAST * np.linalg.norm(high - low))


@njit(cache=True, nogil=True)
def _unsteadiness(points, rest, index, near, change, start, stop):
    """change[i, k]: root mean square, over frames, of the change of the distance from index[i] to near[i, k]."""
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
