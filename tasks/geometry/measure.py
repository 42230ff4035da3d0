"""Sizes and errors that several stages quote."""

from __future__ import annotations

import numpy as np


def diagonal(points: np.ndarray) -> float:
    """Length of the bounding box's diagonal. points: (N, 3)."""
    return float(np.linalg.norm(points.max(0).astype(np.float64) - points.min(0)))


def vertex_rmse(a: np.ndarray, b: np.ndarray) -> float:
    """sqrt(sum |a - b|^2 / (F N)), in float64. a, b: (F, N, 3). Per coordinate it is smaller by sqrt(3)."""
    total = sum(float(np.sum((x.astype(np.float64) - y) ** 2)) for x, y in zip(a, b, strict=True))
    return float(np.sqrt(total / (len(a) * a.shape[1])))
