"""Points that move like nothing around them: mistracked points, floaters. They must not get bones of their own."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from tasks.bones.graph import unsteadiness
from tasks.geometry.neighbours import mesh_edges

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
    rest, each = canonical.astype(np.float64), np.arange(total)
    change = unsteadiness(points, canonical, each, near, _FRAMES)
    change[near == each[:, None]] = np.nan
    own = np.sort(change, axis=1)[:, _STEADIEST]  # not-a-number comes last
    if faces is not None:
        a, b = mesh_edges(faces).T
        edge = unsteadiness(points, canonical, a, b[:, None], _FRAMES)
        np.minimum.at(own, a, edge[:, 0])
        np.minimum.at(own, b, edge[:, 0])
    around = np.minimum(
        np.median(own[near], axis=1), 2.0 * np.percentile(own, 95)
    )  # strays may have strays around them
    low, high = np.percentile(rest, [5, 95], axis=0)
    return (own <= _TIMES * around) | (own <= _LEAST * np.linalg.norm(high - low))
