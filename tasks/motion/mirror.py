"""The mirror image of a motion: bodies and their clothes are alike on both sides, and so is gravity.

A clip of which every step to the left becomes a step to the right is a clip that might have been captured: it costs
nothing and doubles what a method may learn from, wherever skeleton and shape are their own mirror image at rest.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from tasks.geometry import rigid
from tasks.geometry.measure import diagonal
from tasks.geometry.parallel import for_chunks
from tasks.motion.frames import placed
from tasks.motion.posed import FRAME_CHUNK, centroids
from tasks.motion.projection import project
from tasks.values import Poses, Training

ALIKE = 0.03  # of the diagonal: joints and points that lie farther from their mirror image are no pair
NEIGHBOURS = 4  # points that stand for a mirrored point


def mirrored(training: Training) -> tuple[Poses, np.ndarray] | None:
    """The training poses and the transforms of the bones (F, B, 3, 4), mirrored at the plane of symmetry.

    The plane is upright, across x or z, through the skeleton's root, whichever brings joints and points closer to
    themselves. None where a joint or the usual point has no counterpart, where the joints' tree changes, and where
    no joint has a twin (a flat skeleton is no sign of two alike sides).
    """
    planes = [_across(training, axis) for axis in (0, 2)]
    found = min((p for p in planes if p is not None), key=lambda p: p[0], default=None)
    if found is None:
        return None
    _, axis, at, pairs = found
    flip = np.eye(3)
    flip[axis, axis] = -1.0
    poses = training.database.poses  # the plane holds the root at rest: shifts are flipped and no more
    turns = flip @ poses.rotations[:, pairs].astype(np.float64) @ flip
    moved = poses.translations[:, pairs].astype(np.float64) @ flip
    image = Poses(turns.astype(np.float32), moved.astype(np.float32), poses.clip_start)
    return image, _mirrored_bones(training, flip, at)


def with_image(training: Training) -> Training:
    """The training with a database that holds the image of every clip after all clips; as it is where it has none."""
    image, known = mirrored(training), training.database
    if image is None:
        return training
    (poses, bones), frames = image, len(known.bones)
    both = Poses(
        np.concatenate([known.poses.rotations, poses.rotations]),
        np.concatenate([known.poses.translations, poses.translations]),
        np.concatenate([known.poses.clip_start, known.poses.clip_start[1:] + frames]),
    )
    return replace(training, database=replace(known, poses=both, bones=np.concatenate([known.bones, bones])))


def _across(training: Training, axis: int) -> tuple[float, int, np.ndarray, np.ndarray] | None:
    """How far the rest shape is from its image, the axis, a point of the plane, and each joint's counterpart."""
    skeleton, rest = training.skeleton, training.skinning.rest.astype(np.float64)
    joints, parents = skeleton.joints.astype(np.float64), np.asarray(skeleton.parents)
    at = np.zeros(3)
    at[axis] = joints[0, axis]
    size = diagonal(rest)
    apart = np.linalg.norm(_reflect(joints, axis, at)[:, None] - joints, axis=2)
    pairs = apart.argmin(1)
    points = float(np.median(cKDTree(rest).query(_reflect(rest, axis, at))[0]))
    off = float(apart.min(1).max())
    same_tree = np.array_equal(np.where(parents < 0, -1, pairs[parents]), parents[pairs])
    alone, swapped_back = np.arange(len(pairs)), pairs[pairs]
    sides = np.array_equal(swapped_back, alone) and not np.array_equal(pairs, alone)
    if max(off, points) > ALIKE * size or not same_tree or not sides:
        return None
    return off + points, axis, at, pairs


def _reflect(points: np.ndarray, axis: int, at: np.ndarray) -> np.ndarray:
    image = points.copy()
    image[..., axis] = 2.0 * at[axis] - image[..., axis]
    return image


def _mirrored_bones(training: Training, flip: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Each bone moves as the image of what the bones of the mirrored place do there, blended by their weights."""
    rest, weights = training.skinning.rest.astype(np.float64), training.skinning.weights.astype(np.float64)
    axis = int(np.argmin(np.diag(flip)))
    apart, near = cKDTree(rest).query(_reflect(rest, axis, at), k=min(NEIGHBOURS, len(rest)))
    near_weight = 1.0 / np.maximum(apart.reshape(len(rest), -1), 1e-6 * diagonal(rest)) ** 2
    near_weight /= near_weight.sum(1, keepdims=True)
    image = np.einsum("nk,nkb->nb", near_weight, weights[near.reshape(len(rest), -1)])
    share = weights.T @ image
    share /= np.maximum(share.sum(1, keepdims=True), 1e-12)
    bones = training.database.bones
    centres = centroids(training.skinning.rest, training.skinning.weights)
    image_centres, out = _reflect(centres, axis, at), np.empty(bones.shape, np.float32)

    def work(a: int, b: int) -> None:
        blended = (share @ bones[a:b].reshape(b - a, -1, 12).astype(np.float64)).reshape(b - a, -1, 3, 4)
        placed(blended, image_centres, blended)
        place = _reflect(blended[..., 3], axis, at)
        rotation = project(np.diag(flip)[:, None] * blended[..., :3] * np.diag(flip))
        out[a:b] = rigid.make(rotation, place - (rotation @ centres[..., None])[..., 0])

    for_chunks(work, len(bones), FRAME_CHUNK)
    return out
