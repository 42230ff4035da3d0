"""Weights and joints of a fixed tree refitted to the motion, in turn with the poses."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.spatial import cKDTree

from tasks.geometry.moments import Moments, skin_moments
from tasks.geometry.sparse_weights import fit_weights
from tasks.skeleton.inverse_kinematics import solve_poses, transforms_of, warm_start, world_moments

_STEPS = 2  # Gauss-Newton steps a round: the next round goes on from there
_FIRST_STEPS = 5
_SETTLED = 3
_DAMPING = 1e-4
_STIFFNESS = 0.01


def refit(
    points: np.ndarray,
    rest: np.ndarray,
    parents: np.ndarray,
    joints: np.ndarray,
    weights: np.ndarray,
    *,
    rounds: int,
    influences: int,
    reach: float,
    hold: float,
    settle: Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray] | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Alternates poses, weights and joint positions, each of which lowers the skinning error.

    points: (F, N, 3); rest: (N, 3); joints: (J, 3); weights: (N, J); reach: how far a joint may move from where it
    was found (nought: not at all); hold: pull to there, against the squared turn about the joint; settle: from joints,
    weights and world rotations (F, J, 3, 3) to the joints that the last ``_SETTLED`` rounds keep -> joints (J, 3)
    float64 and weights (N, J) float32. Joints without points keep none.
    """
    origin = rest.mean(axis=0, dtype=np.float64)
    points, rest = points - origin.astype(np.float32), rest - origin
    start = joints - origin
    joints, world, root = start, None, None
    empty = weights.sum(axis=0) <= 0
    for r in range(rounds):
        moments = skin_moments(rest, weights, points)
        if world is None:
            world, root = warm_start(parents, joints, moments, _STIFFNESS)
        if settle is not None and r == max(rounds - _SETTLED, 1):
            joints, reach = settle(joints + origin, weights, world) - origin, 0.0
        steps = _STEPS if r else _FIRST_STEPS
        world, root = solve_poses(parents, joints, moments, world, root, steps=steps, damping=_DAMPING)
        if reach > 0:
            joints, root = fit_joints(parents, joints, moments, world, root, anchor=start, reach=reach, hold=hold)
        transforms = transforms_of(parents, joints, world, root)
        weights = _fit(rest, points, transforms, weights, ~empty, influences)
    return joints + origin, weights


def spread_weights(
    points: np.ndarray,
    rest: np.ndarray,
    parents: np.ndarray,
    joints: np.ndarray,
    chosen: np.ndarray,
    weights: np.ndarray,
    influences: int,
) -> np.ndarray:
    """Weights of all points (N, J) for the poses that the chosen points and their weights (K, J) take."""
    origin = rest.mean(axis=0, dtype=np.float64)
    points, rest, joints = points - origin.astype(np.float32), rest - origin, joints - origin
    moments = skin_moments(rest[chosen], weights, points[:, chosen])
    transforms = posed(parents, joints, moments)
    start = weights[cKDTree(rest[chosen]).query(rest)[1]]
    return _fit(rest, points, transforms, start, weights.sum(axis=0) > 0, influences)


def posed(parents: np.ndarray, joints: np.ndarray, moments: Moments) -> np.ndarray:
    """Transforms (F, J, 3, 4) of the joints' best poses."""
    world, root = warm_start(parents, joints, moments, _STIFFNESS)
    world, root = solve_poses(parents, joints, moments, world, root, steps=_FIRST_STEPS, damping=_DAMPING)
    return transforms_of(parents, joints, world, root)


def _fit(rest, points, transforms, start, used, influences) -> np.ndarray:
    """Weights for the used joints only."""
    out = np.zeros((len(rest), transforms.shape[1]), np.float32)
    chosen = np.flatnonzero(used)
    out[:, chosen] = fit_weights(
        rest, points, transforms[:, chosen], influences=influences, exchanges=2, start=start[:, chosen]
    )
    return out


def fit_joints(
    parents: np.ndarray,
    joints: np.ndarray,
    moments: Moments,
    world: np.ndarray,
    root: np.ndarray,
    *,
    anchor: np.ndarray,
    reach: float,
    hold: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Joint positions of least skinning error for given rotations: linear least squares, the root's shift of every
    frame eliminated. Moving joint j by d moves its subtree by (R_parent - R_j) d. Each joint is drawn weakly to its
    anchor (a hinge leaves the place along its axis open) and stays within ``reach`` of it.
    """
    transforms = transforms_of(parents, joints, world, root)
    a, c = world_moments(parents, moments, transforms)
    count, n = len(parents), moments.count
    overlap = a[0, :, :, 3, 3]  # sum_n b_j b_i of the subtrees' summed weights: the same in every frame
    share = overlap[:, 0]  # sum_n b_j
    centred = overlap - np.outer(share, share) / n
    residual = c[:, :, 3] - share[:, None] * c[:, :1, 3] / n  # (F, J, 3)
    up = np.where(parents < 0, 0, parents)
    d = world[:, up] - world  # (F, J, 3, 3)
    normal = np.einsum("fjka,fikb->jaib", d, d, optimize=True) * centred[:, None, :, None]
    gradient = np.einsum("fjka,fjk->ja", d, residual)
    pull = hold * len(world) * np.maximum(np.diagonal(centred), 1e-6 * n)
    normal = normal.reshape(3 * count, 3 * count)
    normal[np.arange(3 * count), np.arange(3 * count)] += np.repeat(pull, 3)
    gradient += pull[:, None] * (joints - anchor)
    gradient[parents < 0] = 0.0
    move = -np.linalg.solve(normal, gradient.ravel()).reshape(count, 3)
    move[parents < 0] = 0.0
    offset = joints + move - anchor
    length = np.linalg.norm(offset, axis=1, keepdims=True)
    moved = anchor + offset * np.minimum(1.0, reach / np.maximum(length, 1e-12))
    shift = (c[:, 0, 3] + np.einsum("fjab,jb,j->fa", d, moved - joints, share)) / n
    return moved, root - shift
