"""Gaussian bones ("bag of bones", BoB): weights from ellipsoids instead of a decomposition, as DressRecon has them."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated

import numpy as np

from tasks.bones.refit import refit_bones
from tasks.geometry.measure import diagonal, vertex_rmse
from tasks.geometry.skinning import skin
from tasks.values import Canonical, Clusters, Motion, Skinning

THIN = 0.01  # of the diagonal: least half axis of an ellipsoid, so that a flat cluster keeps one


def gaussian_bones(
    train: Motion,
    canonical: Canonical,
    clusters: Clusters,
    *,
    sharpness: Annotated[float, "(0, inf)"],
    influences: Annotated[int, "[1, inf)"],
) -> Skinning:
    """One Gaussian for every motion cluster; W = softmax of -sharpness/2 times the squared Mahalanobis distance.

    The weights (N, B) follow from where a point rests and not from how it moves, kept at the ``influences`` largest;
    the transforms (F, B, 3, 4) are then the best ones for these weights. Tan et al. 2025 (DressRecon), the paper's
    SMPL+BoB in Table 4.
    """
    distance = _mahalanobis(canonical.points, clusters.labels, clusters.transforms.shape[1])
    weights = _softmax(-0.5 * sharpness * distance, influences)
    start = Skinning(canonical.points.astype(np.float32), weights, clusters.transforms, np.zeros(0))
    transforms = refit_bones(train, start)
    error = vertex_rmse(skin(start.rest, weights, transforms), train.points)
    return replace(start, transforms=transforms, history=np.array([error]))


def _mahalanobis(points: np.ndarray, labels: np.ndarray, count: int) -> np.ndarray:
    """Squared distances (N, B) to each cluster's mean in units of its covariance."""
    points = points.astype(np.float64)
    floor = (THIN * diagonal(points)) ** 2 * np.eye(3)
    out = np.empty((len(points), count))
    for b in range(count):
        own = points[labels == b]
        away = points - own.mean(0)
        spread = (own - own.mean(0)).T @ (own - own.mean(0)) / len(own) + floor
        out[:, b] = np.einsum("ni,ij,nj->n", away, np.linalg.inv(spread), away)
    return out


def _softmax(score: np.ndarray, influences: int) -> np.ndarray:
    least = np.sort(score, axis=1)[:, -min(influences, score.shape[1]), None]
    weights = np.where(score >= least, np.exp(score - score.max(1, keepdims=True)), 0.0)
    return (weights / weights.sum(1, keepdims=True)).astype(np.float32)
