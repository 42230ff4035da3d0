"""Partwise motion matching: poses of the inner skeleton in, transforms of the free-form bones out."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import numpy as np

from tasks.errors import InputError
from tasks.geometry import rigid
from tasks.geometry.measure import diagonal
from tasks.geometry.rotations import project_so3, to_quaternion
from tasks.motion.blending import PartMotion, Sources, blend, gather, strongest
from tasks.motion.dynamics import root_dynamics
from tasks.motion.frames import centroids, from_frames, predicted, to_frames
from tasks.motion.parts import bone_affinity
from tasks.motion.query import check_poses
from tasks.motion.search import Keys, nearest_windows
from tasks.motion.skeletons import joint_transforms, model_root, subtree, to_root
from tasks.values import Poses, Training

# Radians a unit of gravity direction, body diagonal/s, body diagonal/s^2 and rad/s: the weights of a prototype on
# clothing (0.3, 0.1 per m/s, 0.1 per g, 0.03 per rad/s) for a body whose bounding box has a diagonal of two metres.
DYNAMICS = np.array([0.3, 0.2, 0.02, 0.03])


@dataclass(frozen=True)
class Matched:
    """bones: (F, B, 3, 4) on canonical points; sources: (F, P, k) int32; distance: (F, P) mean angle in radians."""

    bones: np.ndarray
    sources: np.ndarray
    distance: np.ndarray


def match(
    training: Training,
    query: Poses,
    *,
    k: int,
    patch: int,
    levels: int,
    lambda_: float,
    temperature: float,
    represent: Literal["root", "part", "residual"],
    align: bool,
    dynamics: float,
) -> Matched:
    """Bones for the query poses, matched and blended part by part (GaussiAnimate 3.3, eq. 7-10, alg. 1).

    For the settings see :func:`tasks.methods.partmm.animate`. Raises InputError as that does.
    """
    _check(k, patch, levels, lambda_, temperature, represent, align, dynamics)
    check_poses(query, training.skeleton, "query")
    known = training.database.poses
    longest = int(np.diff(known.clip_start).max())
    if longest < patch:
        expected = f"at most the {longest} frames of the longest training clip"
        raise InputError("animate.patch", expected=expected, found=str(patch))
    train_side = _Side(training, known, dynamics)
    values = _values(training, train_side, represent)
    done = []
    for a, b in pairwise(query.clip_start):
        clip = _padded(query, int(a), int(b), patch)
        side = _Side(training, clip, dynamics)
        frames = len(clip.rotations)
        strides = _strides(min(frames, longest), patch, levels)
        bones = np.zeros((frames, training.skinning.weights.shape[1], 3, 4))
        sources, distance = [], []
        for p in range(len(training.parts.names)):
            found = nearest_windows(side.keys(p), train_side.keys(p), k=k, patch=patch, strides=strides)
            row = gather(found, strides, patch=patch, lambda_=lambda_, temperature=temperature)
            _add_part(bones, training, p, row, values, side, train_side, represent, align)
            sources.append(strongest(row, k))
            distance.append(_per_frame(found.distance[-1, :, 0], frames, patch))
        bones = side.decode(rigid.make(project_so3(bones[..., :3]), bones[..., 3]), represent)
        done.append([x[: int(b - a)] for x in (bones, np.stack(sources, 1), np.stack(distance, 1))])
    bones, sources, distance = (np.concatenate(x) for x in zip(*done, strict=True))
    return Matched(bones.astype(np.float32), sources, distance.astype(np.float32))


class _Side:
    """Everything about one run of poses that matching needs: the training poses or one query clip."""

    def __init__(self, training: Training, poses: Poses, weight: float) -> None:
        skeleton, skinning = training.skeleton, training.skinning
        self.parts, self.poses, self.skeleton = training.parts, poses, skeleton
        self.root = model_root(skeleton)
        self.world = joint_transforms(skeleton, poses)
        self.model = to_root(self.world, self.world[:, self.root])
        self.turns = to_quaternion(self.model[..., :3])
        self.local = to_quaternion(poses.rotations).astype(np.float32)
        self.centres = centroids(skinning.rest, skinning.weights)
        self.affinity = bone_affinity(skinning.weights, skeleton.weights)
        self.extra = np.zeros((len(poses.rotations), 0, 3), np.float32)
        if weight > 0:
            size = diagonal(training.canonical.points)
            pivot = skeleton.joints[self.root].astype(np.float64)
            moving = root_dynamics(self.world[:, self.root], pivot, poses.clip_start, training.database.fps)
            unit = weight * DYNAMICS / np.array([1.0, size, size, 1.0])
            self.extra = (moving * unit[:, None]).astype(np.float32)

    def keys(self, part: int) -> Keys:
        """Local rotations of the part's joints. The model's root is left out: bones are stored relative to it."""
        joints = self.parts.joints[part]
        inner = joints & subtree(self.skeleton.parents)[self.root]
        inner[self.root] = False
        chosen = np.flatnonzero(inner if inner.any() else joints)
        return Keys(self.local[:, chosen], self.extra, self.poses.clip_start)

    def part(self, part: int, represent: str) -> PartMotion:
        """Joints and anchor of a part in the frame that its bones are stored in."""
        inside = self.parts.joints[part] & subtree(self.skeleton.parents)[self.root]
        root = int(self.parts.roots[part])
        model = self.model
        if represent == "part":
            model = to_root(model, model[:, root])
        turns = to_quaternion(model[:, inside, :, :3]) if represent == "part" else self.turns[:, inside]
        return PartMotion(turns, rigid.apply(model[:, root], self.skeleton.joints[root].astype(np.float64)))

    def predicted(self) -> np.ndarray:
        """Where skinning would carry the bones, in the world."""
        return predicted(self.world, self.affinity, self.centres)

    def decode(self, frames: np.ndarray, represent: str) -> np.ndarray:
        """Frames of bones, seen from the model's root or from their prediction -> transforms in the world."""
        outer = self.predicted() if represent == "residual" else None
        if outer is not None:
            return from_frames(rigid.compose(outer, frames), self.centres)
        return rigid.compose(self.world[:, self.root][:, None], from_frames(frames, self.centres))


def _values(training: Training, side: _Side, represent: str) -> np.ndarray:
    """The training bones as frames: seen from the model's root or, as residuals, from their prediction."""
    bones = to_frames(training.database.bones.astype(np.float64), side.centres)
    if represent == "residual":
        return rigid.compose(rigid.inverse(side.predicted()), bones)
    return to_root(bones, side.world[:, side.root])


def _add_part(bones, training, p, row: Sources, values, side: _Side, train_side: _Side, represent, align) -> None:
    """Adds one part's blend to the bones that follow it, (T, B, 3, 4) in place, weighted by affinity."""
    follows = np.flatnonzero(training.parts.affinity[p] > 0)
    root = int(training.parts.roots[p])
    mine = np.ascontiguousarray(values[:, follows])
    if represent == "part":
        mine = to_root(mine, train_side.model[:, root])
    mixed = blend(row, mine, side.part(p, represent), train_side.part(p, represent), align=align)
    if represent == "part":
        mixed = rigid.compose(side.model[:, root][:, None], mixed)
    bones[:, follows] += training.parts.affinity[p, follows, None, None] * mixed


def _per_frame(distance: np.ndarray, frames: int, patch: int) -> np.ndarray:
    """Distance of each frame's best window: (T windows) -> (T frames)."""
    best = np.full(frames, np.inf)
    for i in range(patch):
        np.minimum(best[i : i + len(distance)], distance, out=best[i : i + len(distance)])
    return best


def _strides(frames: int, patch: int, levels: int) -> list[int]:
    """Strides of the pyramid, coarsest first: as many levels as let every frame lie in some window."""
    count = min(levels, 1 + int(np.floor(np.log2(max(frames / patch, 1)))))
    return [2**level for level in range(count - 1, -1, -1)]


def _padded(query: Poses, a: int, b: int, patch: int) -> Poses:
    """One clip; shorter ones than a patch hold their last pose."""
    index = np.minimum(np.arange(a, max(b, a + patch)), b - 1)
    return Poses(query.rotations[index], query.translations[index], np.array([0, len(index)], np.int64))


def _check(k, patch, levels, lambda_, temperature, represent, align, dynamics) -> None:
    for name, value, good, expected in (
        ("k", k, k >= 1, "1 or more"),
        ("patch", patch, patch >= 1, "1 or more frames"),
        ("levels", levels, levels >= 1, "1 or more"),
        ("lambda", lambda_, 0 < lambda_ <= 1, "a number in (0, 1]"),
        ("temperature", temperature, temperature > 0, "a positive number"),
        ("dynamics", dynamics, dynamics >= 0, "0 (off) or a positive weight"),
        ("represent", represent, represent in ("root", "part", "residual"), "root, part or residual"),
    ):
        if not good:
            raise InputError(f"animate.{name}", expected=expected, found=str(value))
    if align and represent == "residual":
        raise InputError(
            "animate.align",
            expected="false with represent=residual (a residual is already seen from the posed skeleton)",
            found="true",
        )
