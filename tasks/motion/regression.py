"""What regressing methods share: bones as six numbers, poses as features with a memory."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from tasks.geometry import rigid
from tasks.geometry.rotations import from_rotation_vector, to_rotation_vector
from tasks.motion.posed import Posed, centroids
from tasks.values import Training

LEAST = 0.03  # of the heaviest joint's weight: no joint of a part is without a say


def to_numbers(frames: np.ndarray) -> np.ndarray:
    """Frames of bones (F, B, 3, 4) -> (F, B, 6): rotation vector in radians, position."""
    return np.concatenate([to_rotation_vector(frames[..., :3]), frames[..., 3]], axis=-1)


def from_numbers(numbers: np.ndarray) -> np.ndarray:
    """The inverse of :func:`to_numbers`."""
    return rigid.make(from_rotation_vector(numbers[..., :3]), numbers[..., 3:])


def features(posed: Posed, joints: np.ndarray, weights: np.ndarray, *, dynamics: float, lags: list[int]) -> np.ndarray:
    """What a pose looks like to a regression, (F, D) float64.

    The rotation matrices of the joints, weighted so that squared distances are about the mean squared angle between the
    poses in radians, each joint by its share of ``weights``; and the root's dynamics, ``dynamics`` times as heavy as in
    matching; each of now and of every lag (frames back; before a clip's first frame, that frame).
    """
    heavy = np.sqrt(weights / (2.0 * weights.sum()))[:, None, None]
    turns = (heavy * posed.poses.rotations[:, joints]).reshape(len(posed.world), -1)
    now = np.concatenate([turns, dynamics * posed.dynamics.reshape(len(turns), -1)], axis=1)
    return with_past(now, posed.poses.clip_start, lags)


def with_past(now: np.ndarray, clip_start: np.ndarray, lags: list[int]) -> np.ndarray:
    """(F, D) -> (F, L D) each frame beside what was ``lags`` frames ago (before a clip's first frame: that frame)."""
    back = [np.maximum(np.arange(b - a)[:, None] - np.array(lags), 0) + a for a, b in pairwise(clip_start)]
    return now[np.concatenate(back)].reshape(len(now), -1) / np.sqrt(len(lags))


def joint_weights(posed: Posed, part: int, joints: np.ndarray) -> np.ndarray:
    """How much the poses of a part's joints say of its bones: the root of the skin that they share. (J of the part,)"""
    skinning = posed.training.skinning
    share = posed.training.parts.affinity[part] * skinning.weights.astype(np.float64).mean(0)
    weight = np.sqrt((share @ posed.affinity)[joints])
    return np.maximum(weight, LEAST * weight.max()) if weight.max() > 0 else np.ones(len(joints))


def bone_radii(rest: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Root mean square distance of each bone's points from its centroid: what a radian of error is worth. (B,)."""
    weights = weights.astype(np.float64)
    mass = np.maximum(weights.sum(0), 1e-12)
    centres = centroids(rest, weights)
    apart = ((rest.astype(np.float64)[:, None] - centres) ** 2).sum(2)  # (N, B)
    return np.sqrt(np.maximum((weights * apart).sum(0) / mass, 1e-12))


def shape_units(training: Training) -> np.ndarray:
    """(B, 6): what makes an error in a bone's six numbers an error of its points: its radius for turns, and the root of
    its share of the shape for all, so that tuning minds what is seen."""
    radius = bone_radii(training.skinning.rest, training.skinning.weights)
    share = np.sqrt(training.skinning.weights.astype(np.float64).mean(0) + 1e-12)
    return share[:, None] * np.repeat([radius, np.ones_like(radius)], 3, axis=0).T
