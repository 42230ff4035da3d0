"""What matching must do on a planted character whose true bones are known functions of its pose."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tasks.errors import InputError
from tasks.geometry import kinematics, rigid
from tasks.geometry.measure import vertex_rmse
from tasks.geometry.rotations import from_rotation_vector
from tasks.geometry.skinning import skin
from tasks.methods import lbs, partmm
from tasks.motion.database import build_database
from tasks.motion.parts import find_parts
from tasks.values import Poses
from tests.analytic import planted

PAPER = {
    "k": 7,
    "patch": 7,
    "levels": 5,
    "lambda_": 0.7,
    "temperature": 1.0,
    "represent": "root",
    "align": True,
    "dynamics": 0.0,
    "shrink": False,
    "mirror": False,
    "sources": 0,
    "every": 1,
}
WAYS = [
    PAPER,
    PAPER | {"k": 1, "levels": 1},
    PAPER | {"represent": "part"},
    PAPER | {"represent": "part", "align": False},
    PAPER | {"represent": "residual", "align": False},
    PAPER | {"dynamics": 1.0},
]
A, B, C = planted.gesture(60, 1), planted.gesture(80, 2), planted.gesture(50, 3)


@pytest.fixture(scope="module")
def train():
    return planted.training([A, B, C])


@pytest.mark.parametrize("way", WAYS)
def test_a_training_clip_comes_back(train, way):
    query = planted.poses([A, B, C])
    query = Poses(query.rotations[60:140], query.translations[60:140], np.array([0, 80]))
    made = partmm.animate(train, query, **way)
    assert vertex_rmse(made.points, train.motion.points[60:140]) < 1e-4
    np.testing.assert_array_equal(made.sources[:, :, 0], np.arange(60, 140)[:, None].repeat(5, 1))
    assert made.distance.max() < 1e-6
    assert made.parts == train.parts.names


def test_fullmm_is_partmm_with_one_part(train):
    whole = planted.training([A, B, C], kind="whole")
    named = planted.training([A, B, C], kind="named", named=["all=" + ",".join(planted.NAMES)])
    query = planted.poses([planted.gesture(40, 9)])
    full, one = partmm.animate(whole, query, **PAPER), partmm.animate(named, query, **PAPER)
    assert full.points.tobytes() == one.points.tobytes()
    assert vertex_rmse(full.points, partmm.animate(train, query, **PAPER).points) > 1e-3


@pytest.mark.parametrize("way", [way for way in WAYS if way["dynamics"] == 0])  # which tell tilted bodies apart
def test_moving_the_root_moves_the_result(train, way):
    query = planted.poses([planted.gesture(30, 9)])
    turn, shift = from_rotation_vector(np.array([0.3, 1.0, -0.5])), np.array([2.0, -1.0, 0.5])
    pivot = train.skeleton.joints[0].astype(float)
    rotations, translations = query.rotations.astype(float), query.translations.astype(float)
    translations[:, 0] = (pivot + translations[:, 0]) @ turn.T + shift - pivot
    rotations[:, 0] = turn @ rotations[:, 0]
    moved = partmm.animate(train, Poses(rotations, translations, query.clip_start), **way)
    still = partmm.animate(train, query, **way)
    np.testing.assert_allclose(moved.points, still.points @ turn.T.astype(np.float32) + shift, atol=2e-4)


def test_turning_about_the_axis_up_moves_the_result_with_dynamics_too(train):
    query = planted.poses([planted.gesture(30, 9)])
    turn = from_rotation_vector(np.array([0.0, 1.0, 0.0]))
    pivot = train.skeleton.joints[0].astype(float)
    rotations, translations = query.rotations.astype(float), query.translations.astype(float)
    translations[:, 0] = (pivot + translations[:, 0]) @ turn.T - pivot
    rotations[:, 0] = turn @ rotations[:, 0]
    way = PAPER | {"dynamics": 1.0}
    moved = partmm.animate(train, Poses(rotations, translations, query.clip_start), **way)
    np.testing.assert_allclose(
        moved.points, partmm.animate(train, query, **way).points @ turn.T.astype(np.float32), atol=2e-4
    )


def test_parts_recombine_clips_and_the_whole_body_cannot(train):
    """Legs of one clip under the arms of another: every part is in the database, the whole body is not."""
    mixed = A[:50].copy()
    mixed[:, planted.ARMS] = C[:, planted.ARMS]
    query = planted.poses([mixed])
    true = planted.truth(train, query)
    whole = planted.training([A, B, C], kind="whole")
    part, full = partmm.animate(train, query, **PAPER), partmm.animate(whole, query, **PAPER)
    limbs = np.isin(np.repeat(np.arange(16), 12), planted.ARMS + planted.LEGS)
    assert vertex_rmse(part.points[:, limbs], true[:, limbs]) < 0.3 * vertex_rmse(full.points[:, limbs], true[:, limbs])
    arm, leg = part.parts.index("arm_l"), part.parts.index("leg_r")
    assert np.all(part.sources[:, leg, 0] == np.arange(50))  # clip A
    assert np.all(part.sources[:, arm, 0] == np.arange(140, 190))  # clip C
    assert part.distance[:, [arm, leg]].max() < 1e-6 < full.distance.min()


def test_residuals_explain_what_skinning_cannot(train):
    """The planted bones depend on their joints' rotations alone: residuals of a near pose must beat plain skinning."""
    wobble = from_rotation_vector(0.05 * np.random.default_rng(0).normal(size=(16, 3))).astype(np.float32)
    query = planted.poses([B @ wobble])
    true = planted.truth(train, query)
    made = partmm.animate(train, query, **PAPER | {"represent": "residual", "align": False})
    assert vertex_rmse(made.points, true) < 0.5 * vertex_rmse(lbs.animate(train, query).points, true)


def test_every_bone_stays_rigid(train):
    made = partmm.animate(train, planted.poses([planted.gesture(40, 9)]), **PAPER)
    r = made.bones[..., :3].astype(float)
    np.testing.assert_allclose(r @ r.swapaxes(-1, -2), np.broadcast_to(np.eye(3), r.shape), atol=1e-5)
    assert np.all(np.linalg.det(r) > 0)
    np.testing.assert_array_equal(made.points, skin(train.skinning.rest, train.skinning.weights, made.bones))


@pytest.mark.parametrize("frames", [1, 3, 7, 8, 13])
def test_queries_about_as_short_as_a_patch(train, frames):
    start = 70
    query = planted.poses([A, B, C])
    query = Poses(
        query.rotations[start : start + frames], query.translations[start : start + frames], np.array([0, frames])
    )
    made = partmm.animate(train, query, **PAPER)
    assert made.points.shape == (frames, *train.canonical.points.shape)
    assert made.sources.shape == (frames, 5, 7)
    assert np.all(made.sources >= 0)
    if frames >= 7:
        assert vertex_rmse(made.points, train.motion.points[start : start + frames]) < 1e-3


def test_clips_of_a_query_do_not_touch_each_other(train):
    one, two = planted.gesture(20, 7), planted.gesture(5, 8)
    both = planted.poses([one, two], drift=0.0)
    made = partmm.animate(train, both, **PAPER)
    alone = [partmm.animate(train, planted.poses([x], drift=0.0), **PAPER).points for x in (one, two)]
    np.testing.assert_array_equal(made.points, np.concatenate(alone))


def test_a_skeleton_of_one_joint_follows_its_root(train):
    """No inner joints are left to match: the root's own rotation is the key, and the shape still moves rigidly."""
    tree = replace(
        train.skeleton,
        names=("pelvis",),
        parents=train.skeleton.parents[:1],
        joints=train.skeleton.joints[:1],
        weights=np.ones((len(train.skeleton.weights), 1), np.float32),
    )
    known = Poses(A[:, :1], np.zeros((60, 1, 3), np.float32), np.array([0, 60]))
    world = kinematics.forward(tree.parents, tree.joints, known.rotations, known.translations)
    motion = replace(
        train.motion,
        points=skin(train.canonical.points, tree.weights, world),
        clip_start=known.clip_start,
        clip_names=("a",),
    )
    bones = replace(train.skinning, weights=tree.weights, transforms=world)
    parts = replace(
        train.parts, names=("whole",), joints=np.ones((1, 1), bool), roots=np.zeros(1, int), affinity=np.ones((1, 1))
    )
    single = replace(
        train,
        motion=motion,
        skinning=bones,
        skeleton=tree,
        parts=parts,
        database=build_database(motion, bones, known),
    )
    query = Poses(B[:20, :1], np.zeros((20, 1, 3), np.float32), np.array([0, 20]))
    made = partmm.animate(single, query, **PAPER)
    np.testing.assert_allclose(made.points, lbs.animate(single, query).points, atol=1e-5)


def under_a_turning_node(pose: Poses, pelvis: np.ndarray, seed: int) -> Poses:
    """The same poses in the world of a body that hangs on a node at the origin, which turns for itself."""
    node = from_rotation_vector(np.cumsum(np.random.default_rng(seed).normal(0, 0.2, (len(pose.rotations), 1, 3)), 0))
    back = np.swapaxes(node, -1, -2)
    hips = back @ pose.rotations[:, :1]
    moved = (back @ (pelvis + pose.translations[:, :1])[..., None])[..., 0] - pelvis
    rotations = np.concatenate([node, hips, pose.rotations[:, 1:]], axis=1).astype(np.float32)
    translations = np.concatenate([np.zeros_like(moved), moved, pose.translations[:, 1:]], axis=1).astype(np.float32)
    return Poses(rotations, translations, pose.clip_start)


@pytest.mark.parametrize("way", [PAPER, PAPER | {"represent": "part"}])
def test_a_node_above_the_body_plays_no_part(train, way):
    """Rigs hang bodies on a node that carries them through the world: how it turns is not the body's pose."""
    tree, count = train.skeleton, len(train.skinning.rest)
    hung = replace(
        tree,
        names=("node", *tree.names),
        parents=np.append(-1, tree.parents + 1),
        joints=np.concatenate([np.zeros((1, 3)), tree.joints]).astype(np.float32),
        weights=np.concatenate([np.zeros((count, 1)), tree.weights], axis=1).astype(np.float32),
    )
    known = under_a_turning_node(train.database.poses, tree.joints[0], 1)
    below = replace(
        train,
        skeleton=hung,
        parts=find_parts(hung, train.skinning, kind="auto", named=[], overlap=1, affinity=0.15),
        database=build_database(train.motion, train.skinning, known),
    )
    query = planted.poses([planted.gesture(30, 9)])
    made = partmm.animate(below, under_a_turning_node(query, tree.joints[0], 2), **way)
    np.testing.assert_allclose(made.points, partmm.animate(train, query, **way).points, atol=2e-4)


def test_lbs_is_forward_kinematics_and_skinning(train):
    query = planted.poses([B])
    world = kinematics.forward(train.skeleton.parents, train.skeleton.joints, query.rotations, query.translations)
    hand = rigid.apply(world[:, 6], train.skeleton.joints[6])
    lone = replace(train, skeleton=replace(train.skeleton, weights=np.eye(16, dtype=np.float32)[np.full(192, 6)]))
    lone = replace(lone, canonical=replace(lone.canonical, points=np.tile(train.skeleton.joints[6], (192, 1))))
    np.testing.assert_allclose(lbs.animate(lone, query).points[:, 0], hand, atol=1e-5)


@pytest.mark.parametrize("method", [lambda t, q: lbs.animate(t, q), lambda t, q: partmm.animate(t, q, **PAPER)])
def test_bad_poses_are_refused(train, method):
    good = planted.poses([planted.gesture(10, 5)])
    fewer = Poses(good.rotations[:, :15], good.translations[:, :15], good.clip_start)
    with pytest.raises(InputError, match="16 joints"):
        method(train, fewer)
    for spoil in (lambda r: 1.01 * r, lambda r: -r, lambda r: r * np.array([1, 1, -1])):
        bent = good.rotations.copy()
        bent[4, 3] = spoil(bent[4, 3])
        with pytest.raises(InputError, match="frame 4, joint head"):
            method(train, replace(good, rotations=bent))
    holes = good.translations.copy()
    holes[2, 0, 1] = np.nan
    with pytest.raises(InputError, match="frame 2"):
        method(train, replace(good, translations=holes))


def test_a_patch_longer_than_every_training_clip_is_refused(train):
    with pytest.raises(InputError, match=r"animate\.patch"):
        partmm.animate(train, planted.poses([A]), **PAPER | {"patch": 81})


def test_database_refuses_frames_or_clips_that_do_not_agree(train):
    known = train.database.poses
    with pytest.raises(InputError, match=r"poses\.rotations"):
        build_database(train.motion, train.skinning, replace(known, rotations=known.rotations[:-1]))
    with pytest.raises(InputError, match="clip_start"):
        build_database(train.motion, train.skinning, replace(known, clip_start=np.array([0, 190])))
