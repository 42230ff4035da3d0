"""Bones as moving frames, seen from the model's root, from a part's root joint or from what skinning predicts.

A bone's frame stands at its centroid (the mean of the canonical points that it moves) and is unrotated at rest.
Blending positions of centroids, instead of translations of canonical points, keeps a bone where its sources have it
even when their rotations differ.
"""

from __future__ import annotations

import numpy as np

from tasks.geometry import rigid
from tasks.geometry.rotations import project_so3


def centroids(rest: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """(N, 3) points and (N, B) weights -> (B, 3) float64; the shape's own centroid for a bone of no weight."""
    mass = weights.astype(np.float64).sum(0)
    mean = (weights.astype(np.float64).T @ rest) / np.maximum(mass, 1e-12)[:, None]
    return np.where(mass[:, None] > 1e-9, mean, rest.mean(0, dtype=np.float64))


def to_frames(transforms: np.ndarray, centres: np.ndarray) -> np.ndarray:
    """Transforms on canonical points (F, B, 3, 4) -> frames [R | position of the centroid]."""
    return rigid.make(transforms[..., :3], rigid.apply(transforms, centres))


def from_frames(frames: np.ndarray, centres: np.ndarray) -> np.ndarray:
    """The inverse of :func:`to_frames`."""
    rotation = frames[..., :3]
    return rigid.make(rotation, frames[..., 3] - (rotation @ centres[..., None])[..., 0])


def predicted(joint_transforms: np.ndarray, affinity: np.ndarray, centres: np.ndarray) -> np.ndarray:
    """Where linear blend skinning of the skeleton would carry the bones' frames.

    joint_transforms: (F, J, 3, 4) on canonical points; affinity: (B, J), rows sum to one; centres: (B, 3)
    -> (F, B, 3, 4), rotations projected to SO(3).
    """
    frames, joints = joint_transforms.shape[:2]
    blended = (affinity @ joint_transforms.reshape(frames, joints, 12)).reshape(frames, len(affinity), 3, 4)
    return rigid.make(project_so3(blended[..., :3]), rigid.apply(blended, centres))
