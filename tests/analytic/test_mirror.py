"""Mirror images of training clips, against a character that is its own mirror image."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tasks.geometry.measure import vertex_rmse
from tasks.geometry.skinning import skin
from tasks.methods import bone_kernel, mlp, part_kernel
from tasks.motion.database import build_database
from tasks.motion.mirror import mirrored
from tasks.motion.posed import Posed
from tasks.values import Poses
from tests.analytic import planted

FLIP = np.diag([-1.0, 1.0, 1.0]).astype(np.float32)
PAIRS = np.array(
    [planted.NAMES.index(n[:-1] + {"l": "r", "r": "l"}.get(n[-1], n[-1]) if n[-2] == "_" else n) for n in planted.NAMES]
)
KERNEL = {
    "represent": "residual",
    "dynamics": 0.0,
    "reach": 0,
    "width": 1.0,
    "ridge": 1e-4,
    "tune": False,
    "landmarks": 1000,
}
BONES = {name: value for name, value in KERNEL.items() if name not in ("represent", "tune")}
NET = {
    "hidden": 32,
    "steps": 200,
    "patience": 200,
    "rate": 0.01,
    "represent": "residual",
    "dynamics": False,
    "seed": 0,
}


def image(poses: Poses) -> Poses:
    return replace(
        poses, rotations=FLIP @ poses.rotations[:, PAIRS] @ FLIP, translations=poses.translations[:, PAIRS] @ FLIP
    )


@pytest.fixture(scope="module")
def symmetric():
    """The planted character with points on both sides, whose bones are its joints and the arms' swell when bent."""
    known = planted.training([planted.gesture(n, s) for n, s in ((60, 1), (50, 2), (40, 3))], affinity=0.0)
    skeleton = known.skeleton
    rest = (skeleton.joints[:, None] + 0.02 * np.array(list(np.ndindex(3, 3, 3)))[None] - 0.02).reshape(-1, 3)
    weights = np.repeat(np.eye(len(skeleton.parents), dtype=np.float32), 27, axis=0)
    shape = replace(skeleton, weights=weights)
    skinning = replace(known.skinning, rest=rest.astype(np.float32), weights=weights)
    canonical = replace(known.canonical, points=skinning.rest, faces=None)
    parts = replace(known.parts, affinity=(known.parts.joints / known.parts.joints.sum(0)).astype(np.float32))
    return replace(known, skeleton=shape, skinning=skinning, canonical=canonical, parts=parts)


def moved(training, poses: Poses) -> np.ndarray:
    """Bones that follow their joints, and lean out sideways by the sine of the left arm's turn on the left, and as the
    image of that on the right."""
    posed = Posed(training, poses)
    bones = posed.world.copy()
    for side, sign in (("l", 1.0), ("r", -1.0)):
        arm, leg = planted.NAMES.index(f"arm_{side}"), planted.NAMES.index(f"elbow_{side}")
        bones[:, leg, :, 3] += sign * 0.3 * poses.rotations[:, arm, 0, 0, None] * bones[:, leg, :, 0]
    return bones.astype(np.float32)


def trained(symmetric, poses: Poses):
    bones = moved(symmetric, poses)
    points = skin(symmetric.skinning.rest, symmetric.skinning.weights, bones)
    names = tuple(f"clip_{c}" for c in range(len(poses.clip_start) - 1))
    motion = replace(
        symmetric.motion, points=points, faces=None, clip_start=poses.clip_start, clip_names=names, rig=None
    )
    skinning = replace(symmetric.skinning, transforms=bones)
    return replace(symmetric, motion=motion, skinning=skinning, database=build_database(motion, skinning, poses))


def test_the_image_of_a_motion_is_what_the_image_of_its_poses_would_do(symmetric):
    training = trained(symmetric, symmetric.database.poses)
    poses, bones = mirrored(training)
    expected = image(training.database.poses)
    np.testing.assert_allclose(poses.rotations, expected.rotations, atol=1e-6)
    np.testing.assert_allclose(poses.translations, expected.translations, atol=1e-6)
    np.testing.assert_allclose(bones, moved(symmetric, expected), atol=1e-4)


@pytest.mark.parametrize(("method", "settings"), [(part_kernel, KERNEL), (bone_kernel, BONES), (mlp, NET)])
def test_what_the_left_arm_did_is_known_of_the_right(symmetric, method, settings):
    """The right arm rests in training and moves in the query: only the mirror image says what it does."""
    poses, right = symmetric.database.poses, [planted.NAMES.index(f"{n}_r") for n in ("arm", "elbow", "hand")]
    still = poses.rotations.copy()
    still[:, right] = np.eye(3, dtype=np.float32)
    training = trained(symmetric, replace(poses, rotations=still))
    query = image(Poses(still[:60], poses.translations[:60], np.array([0, 60])))
    truth = skin(training.skinning.rest, training.skinning.weights, moved(symmetric, query))
    error = {m: vertex_rmse(method.animate(training, query, **settings, mirror=m).points, truth) for m in (0, 1)}
    assert error[1] < 0.2 * error[0]


def test_a_lopsided_character_has_no_image(symmetric):
    skeleton = symmetric.skeleton
    joints = skeleton.joints.copy()
    joints[planted.NAMES.index("hand_l")] *= 1.5
    assert mirrored(replace(symmetric, skeleton=replace(skeleton, joints=joints))) is None
    one_armed = skeleton.parents.copy()
    one_armed[planted.NAMES.index("arm_l")] = planted.NAMES.index("spine")
    assert mirrored(replace(symmetric, skeleton=replace(skeleton, parents=one_armed))) is None


def test_a_point_that_has_a_twin_takes_it_alone_however_near_others_lie(symmetric):
    """Neighbouring points follow two bones by turns: their image does, too."""
    skeleton = symmetric.skeleton
    joint, place = np.divmod(np.arange(len(symmetric.skinning.rest)), 27)
    owner = np.where(place % 2, joint, np.maximum(skeleton.parents[joint], 0))
    weights = np.eye(len(skeleton.parents), dtype=np.float32)[owner]
    mixed = replace(symmetric, skinning=replace(symmetric.skinning, weights=weights))
    _, bones = mirrored(mixed)
    flip = np.diag([-1.0, 1.0, 1.0, 1.0]).astype(np.float32)
    used = np.unique(owner)
    np.testing.assert_allclose(bones[:, used], (FLIP @ symmetric.database.bones[:, PAIRS] @ flip)[:, used], atol=2e-4)
