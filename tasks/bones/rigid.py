"""Rigid clusters as bones: the ablation without skinning decomposition (paper, fig. 8)."""

from __future__ import annotations

import numpy as np

from tasks.geometry.measure import vertex_rmse
from tasks.geometry.skinning import skin
from tasks.values import Canonical, Clusters, Motion, Skinning


def rigid_skinning(train: Motion, canonical: Canonical, clusters: Clusters) -> Skinning:
    """One bone for every cluster, one bone for every point. Weights (N, B) are zeros and ones."""
    weights = np.zeros((len(clusters.labels), clusters.transforms.shape[1]), np.float32)
    weights[np.arange(len(weights)), clusters.labels] = 1.0
    error = vertex_rmse(skin(canonical.points, weights, clusters.transforms), train.points)
    return Skinning(canonical.points.astype(np.float32), weights, clusters.transforms, np.array([error]))
