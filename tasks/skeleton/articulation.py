"""Where two bones turn about each other."""

from __future__ import annotations

import numpy as np


def centres(
    transforms: np.ndarray, pairs: np.ndarray, guess: np.ndarray, pull: np.ndarray, reach: float
) -> tuple[np.ndarray, np.ndarray]:
    """The point p that both bones of a pair carry along together:

        min mean_f |T_fa p - T_fb p|^2 + pull |p - guess|^2.

    A hinge leaves p free along its axis and two bones that move alike leave it free altogether, so that the pull
    towards the guess is needed; p stays within ``reach`` of it. transforms: (F, B, 3, 4); pairs: (P, 2); guess:
    (P, 3); pull: (P,) without unit -> points (P, 3) and residuals (P,), the root of the mean squared gap.
    """
    gap = transforms[:, pairs[:, 0]].astype(np.float64) - transforms[:, pairs[:, 1]]
    r, t = gap[..., :3], gap[..., 3]
    normal = np.einsum("fpki,fpkj->pij", r, r, optimize=True) / len(r) + pull[:, None, None] * np.eye(3)
    right = -np.einsum("fpki,fpk->pi", r, t, optimize=True) / len(r) + pull[:, None] * guess
    p = np.linalg.solve(normal, right[..., None])[..., 0]
    offset = p - guess
    length = np.linalg.norm(offset, axis=1, keepdims=True)
    p = guess + offset * np.minimum(1.0, reach / np.maximum(length, 1e-12))
    left = np.einsum("fpij,pj->fpi", r, p) + t
    return p, np.sqrt((left * left).sum(axis=2).mean(axis=0))
