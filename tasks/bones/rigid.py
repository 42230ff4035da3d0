"""Rigid clusters as bones: the ablation without skinning decomposition (paper, fig. 8)."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from scipy.sparse import diags

from tasks.geometry.measure import vertex_rmse
from tasks.geometry.neighbours import adjacency, mesh_edges, nearest_edges
from tasks.geometry.skinning import skin
from tasks.values import Canonical, Clusters, Motion, Skinning

INFLUENCES = 4  # most bones a point may have, as in the decomposition
NEIGHBOURS = 8  # of a bare point


def rigid_skinning(
    train: Motion, canonical: Canonical, clusters: Clusters, *, spread: Annotated[int, "[0, inf)"]
) -> Skinning:
    """One bone for every cluster. Weights (N, B) are zeros and ones, or after ``spread`` > 0 rounds of averaging with
    the neighbours' at most four shares a point."""
    weights = np.zeros((len(clusters.labels), clusters.transforms.shape[1]), np.float32)
    weights[np.arange(len(weights)), clusters.labels] = 1.0
    if spread:
        weights = _spread(weights, canonical, spread)
    error = vertex_rmse(skin(canonical.points, weights, clusters.transforms), train.points)
    return Skinning(canonical.points.astype(np.float32), weights, clusters.transforms, np.array([error]))


def _spread(weights: np.ndarray, canonical: Canonical, rounds: int) -> np.ndarray:
    points, faces = canonical.points, canonical.faces
    edges = nearest_edges(points, NEIGHBOURS) if faces is None else mesh_edges(faces)
    near = adjacency(edges, len(points)).astype(np.float64)
    mean = diags(1.0 / np.maximum(np.asarray(near.sum(1)).ravel(), 1.0)) @ near
    alone = np.asarray(near.sum(1)).ravel() == 0  # a point without neighbours keeps its own
    wide = weights.astype(np.float64)
    for _ in range(rounds):
        wide = 0.5 * (wide + np.where(alone[:, None], wide, mean @ wide))
    least = np.sort(wide, axis=1)[:, -min(INFLUENCES, wide.shape[1])]
    kept = np.where(wide >= least[:, None], wide, 0.0)
    return (kept / kept.sum(1, keepdims=True)).astype(np.float32)
