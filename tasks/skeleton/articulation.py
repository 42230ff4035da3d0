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


def off_hinges(
    parents: np.ndarray,
    joints: np.ndarray,
    world: np.ndarray,
    meet: np.ndarray,
    *,
    share: float,
    far: float,
    gap: float,
) -> np.ndarray:
    """Joints moved along the directions that their turns leave open, towards where the skins of both bones meet.

    A hinge is the same wherever on its axis it lies, so that fitting drifts along it. With D_f = R_parent - R_joint,
    an eigenvector of mean_f D^T D is open when its eigenvalue is under ``share`` of their sum. joints, meet: (J, 3);
    world: (F, J, 3, 3); far: joints whose skins meet farther away stay, as do those that never turn; gap: RMS distance
    that a move along one axis may put between both bones' ideas of the joint.
    """
    apart = world[:, np.where(parents < 0, 0, parents)] - world
    turned = np.einsum("fjka,fjkb->jab", apart, apart, optimize=True) / len(world)
    value, axes = np.linalg.eigh(turned)  # axes in columns
    total = value.sum(axis=1, keepdims=True)
    offset = meet - joints
    near = (np.linalg.norm(offset, axis=1, keepdims=True) < far) & (total > 1e-9)
    most = gap / np.sqrt(np.maximum(value, 1e-12))
    along = np.clip(np.einsum("jak,ja->jk", axes, offset), -most, most)
    return joints + np.einsum("jak,jk->ja", axes, np.where(near & (value < share * total), along, 0.0))
