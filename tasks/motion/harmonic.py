"""Bounded biharmonic weights (Jacobson et al. 2011): skin weights from a skeleton and a shape, and nothing else."""

from __future__ import annotations

import numpy as np

from tasks.geometry.lattice import Lattice, lattice
from tasks.values import Canonical, Skeleton

NEAR = 0.75  # of a cell: vertices as near to a bone belong to it
ITERATIONS = 100  # of the active set, at most


def biharmonic_weights(canonical: Canonical, skeleton: Skeleton, *, cells: int) -> np.ndarray:
    """Weights (N, J) that minimise sum_j integral |Laplace w_j|^2 over the shape's inside, 0 <= w_j <= 1, w_j = 1 on
    the bones of joint j and 0 on the others'; rows are normalised, since each w_j is solved by itself.

    The inside is a lattice of at most so many cells, and the points take its weights by trilinear interpolation. (A
    mesh of fTetWild would follow the surface, but it is another at every call.) A joint's bones go to its children; a
    joint without children is a point. Joints that move no skin in the skeleton's own weights take no part.
    """
    import igl

    inside = lattice(canonical.points, canonical.faces, cells)
    joints = np.flatnonzero(skeleton.weights.sum(0) > 0)
    at, owner = handles(inside, skeleton, joints)
    bounds = (owner[:, None] == joints).astype(np.float64)
    solved = igl.bbw(inside.vertices, inside.tets, at.astype(np.int64), bounds, max_iter=ITERATIONS)
    own = np.clip(inside.interpolate(solved, canonical.points.astype(np.float64)), 0, None)
    own /= own.sum(1, keepdims=True)
    weights = np.zeros((len(own), len(skeleton.parents)), np.float32)
    weights[:, joints] = own
    return weights


def handles(inside: Lattice, skeleton: Skeleton, joints: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lattice vertices on bones, and the joint that each belongs to: the nearest. Every joint has one at least."""
    distance = np.stack([_to_bones(inside.vertices, skeleton, j) for j in joints], axis=1)  # (V, joints)
    nearest, near = distance.argmin(1), distance.min(1)
    taken = near <= NEAR * inside.size
    for j in np.flatnonzero(~np.isin(np.arange(len(joints)), nearest[taken])):
        free = np.where(taken, np.inf, distance[:, j])
        vertex = int(np.argmin(free))
        nearest[vertex], taken[vertex] = j, True
    at = np.flatnonzero(taken)
    return at, joints[nearest[at]]


def _to_bones(points: np.ndarray, skeleton: Skeleton, joint: int) -> np.ndarray:
    """Distance of points to the bones from a joint to its children, or to the joint where it has none. (V,)"""
    start = skeleton.joints[joint].astype(np.float64)
    ends = skeleton.joints[np.flatnonzero(np.asarray(skeleton.parents) == joint)].astype(np.float64)
    best = np.full(len(points), np.inf)
    for end in ends if len(ends) else [start]:
        along = end - start
        share = np.clip((points - start) @ along / max(along @ along, 1e-30), 0, 1)
        best = np.minimum(best, np.linalg.norm(points - start - share[:, None] * along, axis=1))
    return best
