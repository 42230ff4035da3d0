"""Rigid (and affine) transforms as (..., 3, 4) matrices [A | t], x -> A x + t."""

from __future__ import annotations

import numpy as np

from tasks.geometry.rotations import project_so3


def make(rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """(..., 3, 3) and (..., 3) -> (..., 3, 4)."""
    return np.concatenate([rotation, translation[..., None]], axis=-1)


def identity(*shape: int, dtype: type = np.float32) -> np.ndarray:
    """(*shape, 3, 4) identities."""
    out = np.zeros((*shape, 3, 4), dtype)
    out[..., :3] = np.eye(3)
    return out


def apply(transforms: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(..., 3, 4) on (..., 3), broadcast -> (..., 3)."""
    return (transforms[..., :3] @ points[..., None])[..., 0] + transforms[..., 3]


def compose(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """a after b: (..., 3, 4), broadcast."""
    return make(a[..., :3] @ b[..., :3], apply(a, b[..., 3]))


def inverse(transforms: np.ndarray) -> np.ndarray:
    """Inverse of rigid transforms (the linear part must be a rotation)."""
    r = np.swapaxes(transforms[..., :3], -1, -2)
    return make(r, -(r @ transforms[..., 3:])[..., 0])


def procrustes(source: np.ndarray, target: np.ndarray, weights: np.ndarray | None = None) -> np.ndarray:
    """Rigid transforms that bring source onto target in the least-squares sense (Kabsch 1976).

    source: (..., N, 3), target: (..., N, 3), broadcast; weights: (N,) or (..., N) -> (..., 3, 4), float64.
    """
    source, target = np.asarray(source, np.float64), np.asarray(target, np.float64)
    w = np.ones(source.shape[-2]) if weights is None else np.asarray(weights, np.float64)
    w = (w / w.sum(-1, keepdims=True))[..., None]
    a, b = (w * source).sum(-2), (w * target).sum(-2)
    h = np.swapaxes(target - b[..., None, :], -1, -2) @ (w * (source - a[..., None, :]))
    r = project_so3(h)
    return make(r, b - (r @ a[..., None])[..., 0])
