"""Forward kinematics of a tree whose parents stand before their children."""

from __future__ import annotations

import numpy as np

from tasks.geometry import rigid


def forward(parents: np.ndarray, joints: np.ndarray, rotations: np.ndarray, translations: np.ndarray) -> np.ndarray:
    """Transforms of every joint acting on canonical points.

    parents: (J,), -1 for the root; joints: (J, 3) rest positions; rotations: (F, J, 3, 3) local to the parent,
    identity at rest; translations: (F, J, 3) added to the rest offset in the parent's frame -> (F, J, 3, 4).
    """
    dtype = np.result_type(rotations, joints)
    world = np.empty((*rotations.shape[:2], 3, 3), dtype)
    position = np.empty((*rotations.shape[:2], 3), dtype)
    for j, p in enumerate(parents):
        if p < 0:
            world[:, j] = rotations[:, j]
            position[:, j] = joints[j] + translations[:, j]
        else:
            world[:, j] = world[:, p] @ rotations[:, j]
            offset = joints[j] - joints[p] + translations[:, j]
            position[:, j] = position[:, p] + (world[:, p] @ offset[..., None])[..., 0]
    return rigid.make(world, position - (world @ joints[..., None])[..., 0])


def local_poses(parents: np.ndarray, joints: np.ndarray, transforms: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The inverse of :func:`forward`: (F, J, 3, 4) -> rotations (F, J, 3, 3), translations (F, J, 3)."""
    world = transforms[..., :3]
    position = rigid.apply(transforms, joints)
    up = np.where(parents < 0, 0, parents)
    is_root = (np.asarray(parents) < 0)[:, None]
    parent_world = np.where(is_root[..., None], np.eye(3, dtype=world.dtype), world[:, up])
    parent_position = np.where(is_root, 0.0, position[:, up])
    offset = np.where(is_root, joints, joints - joints[up])
    to_parent = np.swapaxes(parent_world, -1, -2)
    rotations = to_parent @ world
    translations = (to_parent @ (position - parent_position)[..., None])[..., 0] - offset
    return rotations, translations


def joint_positions(transforms: np.ndarray, joints: np.ndarray) -> np.ndarray:
    """Where the joints are in each frame. transforms: (F, J, 3, 4); joints: (J, 3) -> (F, J, 3)."""
    return rigid.apply(transforms, joints)
