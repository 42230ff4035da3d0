"""The numbers of bones and skeleton themselves, which all methods share."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from tasks.evaluation.fragments import bone_fragments
from tasks.evaluation.joints import counting_joints, joint_scores
from tasks.evaluation.metrics import FRAMES_AT_ONCE, declared, squared_errors
from tasks.geometry import kinematics, measure, rigid
from tasks.geometry.skinning import skin
from tasks.values import Canonical, Metrics, Motion, Poses, Rig, Skeleton, Skinning

_NAMED = {"precision": "joint_precision", "recall": "joint_recall", "f1": "joint_f1", "f1_fine": "joint_f1_fine"}
_NAMED |= {"link_f1": "link_f1", "j2j": "j2j_pct", "j2b": "j2b_pct", "b2b": "b2b_pct"}


def evaluate_rig(
    train: Motion, canonical: Canonical, skinning: Skinning, skeleton: Skeleton, poses: Poses, *, turn: float
) -> Metrics:
    """Error of the bones alone and of the skeleton alone on the frames they were fitted to, and their counts.

    Where the data has a true rig and the skeleton is another, its joints are scored too (``tasks.evaluation.joints``);
    true joints count when they turn more than ``turn`` degrees from where they are in the canonical shape somewhere.
    """

    def bones(piece: slice) -> np.ndarray:
        return skin(skinning.rest, skinning.weights, skinning.transforms[piece])

    def joints(piece: slice) -> np.ndarray:
        rotations, shifts = poses.rotations[piece], poses.translations[piece]
        transforms = kinematics.forward(skeleton.parents, skeleton.joints, rotations, shifts)
        return skin(canonical.points, skeleton.weights, transforms)

    diagonal = measure.diagonal(canonical.points)
    bones_rmse, skeleton_rmse = _rmse_in_pieces(bones, train.points), _rmse_in_pieces(joints, train.points)
    found = {
        "bones_rmse": bones_rmse,
        "bones_rmse_pct": 100.0 * bones_rmse / diagonal,
        "bones_count": float(skinning.transforms.shape[1]),
        "bone_fragments": bone_fragments(canonical, skinning),
        "skeleton_rmse": skeleton_rmse,
        "skeleton_rmse_pct": 100.0 * skeleton_rmse / diagonal,
        "joints_count": float(len(skeleton.parents)),
    }
    return declared(found | _against_truth(train, canonical, skeleton, turn), train.unit)


def evaluate_joints(train: Motion, canonical: Canonical, skeleton: Skeleton, *, turn: float) -> Metrics:
    """The joints alone against the true rig, and their count; nothing where the data has no rig. turn: as above."""
    found = _against_truth(train, canonical, skeleton, turn)
    return declared(found | ({"joints_count": float(len(skeleton.parents))} if found else {}), train.unit)


def _against_truth(train: Motion, canonical: Canonical, skeleton: Skeleton, turn: float) -> dict[str, float]:
    if train.rig is None or train.rig.names == skeleton.names:
        return {}
    true_joints, true_parents = counting_joints(at_canonical(train.rig, canonical), turn)
    if len(true_joints) == 0:
        return {}
    diagonal = measure.diagonal(canonical.points)
    scores = joint_scores(skeleton.joints, skeleton.parents, true_joints, true_parents, diagonal)
    return {name: scores[short] for short, name in _NAMED.items()}


def at_canonical(rig: Rig, canonical: Canonical) -> Rig:
    """The true rig bound anew in the canonical shape, which may be a posed frame: joints where they are there, turns
    from there. A joint that is bent in the canonical frame and in all others alike moves nothing."""
    if canonical.frame < 0:
        return rig
    transforms = kinematics.forward(rig.parents, rig.joints, rig.rotations, rig.translations)
    there = transforms[canonical.frame]
    joints = kinematics.joint_positions(there, rig.joints)
    since = rigid.compose(transforms, rigid.inverse(there))
    return Rig(rig.names, rig.parents, joints, rig.weights, *kinematics.local_poses(rig.parents, joints, since))


def _rmse_in_pieces(make: Callable[[slice], np.ndarray], truth: np.ndarray) -> float:
    """Vertex RMSE of a motion that is made a few frames at a time, so that it never lies in memory whole."""
    pieces = [slice(a, min(a + FRAMES_AT_ONCE, len(truth))) for a in range(0, len(truth), FRAMES_AT_ONCE)]
    return math.sqrt(np.concatenate([squared_errors(make(p), truth[p]).mean(1) for p in pieces]).mean())
