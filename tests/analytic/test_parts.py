"""Parts of planted skeletons."""

from __future__ import annotations

import numpy as np
import pytest

from tasks.errors import InputError
from tasks.motion.parts import bone_affinity, find_parts
from tasks.values import Skeleton, Skinning
from tests.analytic import planted


def skinned(tree: Skeleton) -> Skinning:
    rest = np.zeros((len(tree.weights), 3), np.float32)
    return Skinning(rest, tree.weights, np.zeros((1, len(tree.parents), 3, 4), np.float32), np.zeros((0, 2)))


def members(parts, name: str) -> set[str]:
    return {planted.NAMES[j] for j in np.flatnonzero(parts.joints[parts.names.index(name)])}


def chain(parents: list[int]) -> Skeleton:
    """A tree with one point a joint and bones of length one."""
    count = len(parents)
    joints = np.zeros((count, 3), np.float32)
    for j, p in enumerate(parents[1:], start=1):
        joints[j] = joints[p] + (1, 0, 0)
    return Skeleton(tuple(f"j{j}" for j in range(count)), np.array(parents), joints, np.eye(count, dtype=np.float32))


def test_automatic_parts_are_torso_and_limbs_with_one_joint_of_overlap():
    tree, _ = planted.skeleton()
    parts = find_parts(tree, skinned(tree), kind="auto", named=[], overlap=1, affinity=0.15)
    assert parts.names == ("torso", "arm_l", "arm_r", "leg_l", "leg_r")
    assert members(parts, "torso") == {"pelvis", "spine", "chest", "head", "arm_l", "arm_r", "leg_l", "leg_r"}
    assert members(parts, "leg_r") == {"leg_r", "knee_r", "foot_r"}
    assert [planted.NAMES[r] for r in parts.roots] == ["pelvis", "arm_l", "arm_r", "leg_l", "leg_r"]
    np.testing.assert_allclose(parts.affinity.sum(0), 1, atol=1e-6)


def test_overlap_zero_and_two():
    tree, _ = planted.skeleton()
    none = find_parts(tree, skinned(tree), kind="auto", named=[], overlap=0, affinity=0.0)
    assert np.all(none.joints.sum(0) == 1)
    two = find_parts(tree, skinned(tree), kind="auto", named=[], overlap=2, affinity=0.0)
    assert {"knee_l", "elbow_r"} <= members(two, "torso")


def test_affinity_is_row_normalised_and_cut():
    weights = np.array([[1.0, 0], [1, 0], [0, 1], [0, 1]])
    skin = np.array([[1.0, 0], [0.8, 0.2], [0, 1], [0, 1]])
    np.testing.assert_allclose(bone_affinity(weights, skin), [[0.9, 0.1], [0, 1]])
    tree = Skeleton(("a", "b"), np.array([-1, 0]), np.array([[0, 0, 0], [1, 0, 0]], np.float32), skin)
    bones = Skinning(np.zeros((4, 3)), weights, np.zeros((1, 2, 3, 4)), np.zeros((0, 2)))
    cut = find_parts(tree, bones, kind="named", named=["one=a", "two=b"], overlap=0, affinity=0.15)
    np.testing.assert_allclose(cut.affinity, [[1, 0], [0, 1]])
    kept = find_parts(tree, bones, kind="named", named=["one=a", "two=b"], overlap=0, affinity=0.05)
    np.testing.assert_allclose(kept.affinity, [[0.9, 0], [0.1, 1]], atol=1e-6)


def test_whole_is_one_part():
    tree, _ = planted.skeleton()
    parts = find_parts(tree, skinned(tree), kind="whole", named=[], overlap=1, affinity=0.15)
    assert parts.names == ("whole",)
    assert parts.joints.all()
    assert np.all(parts.affinity == 1)


def test_a_rig_hung_under_a_still_armature_joint_is_rooted_where_the_skin_begins():
    tree, _ = planted.skeleton()
    count = len(tree.parents)
    joints = np.concatenate([np.zeros((1, 3), np.float32), tree.joints, [[0, 0, 0.5]]]).astype(np.float32)
    weights = np.concatenate([np.zeros((len(tree.weights), 1)), tree.weights, np.zeros((len(tree.weights), 1))], 1)
    parents = np.concatenate([[-1], tree.parents + 1, [0]])
    rig = Skeleton(("armature", *tree.names, "pole"), parents, joints, weights.astype(np.float32))
    parts = find_parts(rig, skinned(rig), kind="auto", named=[], overlap=1, affinity=0.15)
    assert [rig.names[r] for r in parts.roots] == ["pelvis", "arm_l", "arm_r", "leg_l", "leg_r"]
    assert not parts.joints[:, count + 1].any()  # the helper moves no skin and is matched by no part


def test_a_small_tree_beside_four_limbs_goes_to_the_torso():
    # root with four limbs of three bones and a one-bone tail
    parents = [-1, 0, 1, 2, 0, 4, 5, 0, 7, 8, 0, 10, 11, 0]
    parts = find_parts(chain(parents), skinned(chain(parents)), kind="auto", named=[], overlap=0, affinity=0.0)
    assert np.flatnonzero(parts.joints[0]).tolist() == [0, 13]
    assert parts.joints[1:].sum(1).tolist() == [3, 3, 3, 3]


def test_a_pair_of_legs_is_not_torn_apart_by_a_long_neck():
    # pelvis 0 with two legs of four bones; spine 9-10 with two legs of three and a neck of five on joint 10
    parents = [-1, 0, 1, 2, 3, 0, 5, 6, 7, 0, 9, 10, 11, 12, 10, 14, 15, 10, 17, 18, 19, 20]
    parts = find_parts(chain(parents), skinned(chain(parents)), kind="auto", named=[], overlap=0, affinity=0.0)
    assert parts.names == ("torso", "j1", "j5", "j11", "j14")
    assert np.flatnonzero(parts.joints[0]).tolist() == [0, 9, 10, 17, 18, 19, 20, 21]


@pytest.mark.parametrize(("parents", "expected"), [([-1], 1), ([-1, 0, 1, 2], 2), ([-1, 0, 0], 3)])
def test_fewer_than_four_limbs(parents, expected):
    parts = find_parts(chain(parents), skinned(chain(parents)), kind="auto", named=[], overlap=0, affinity=0.0)
    assert len(parts.names) == expected
    assert parts.joints.any(0).all()


@pytest.mark.parametrize(
    ("named", "message"),
    [
        (["legs=leg_l,knee_x"], "'knee_x' in part 'legs'"),
        (["legs"], "part=joint"),
        (["legs=leg_l", "legs=leg_r"], "twice"),
        (["legs=leg_l,knee_l,foot_l"], "missing pelvis, spine"),
    ],
)
def test_bad_names_are_one_clear_line(named, message):
    tree, _ = planted.skeleton()
    with pytest.raises(InputError) as error:
        find_parts(tree, skinned(tree), kind="named", named=named, overlap=1, affinity=0.15)
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_unknown_joint_lists_the_valid_ones():
    tree, _ = planted.skeleton()
    with pytest.raises(InputError, match="pelvis, spine, chest"):
        find_parts(tree, skinned(tree), kind="named", named=["a=nose"], overlap=1, affinity=0.15)


def test_named_part_without_bones_is_an_error():
    tree, _ = planted.skeleton()
    rest = [n for n in planted.NAMES if n != "hand_l"]
    no_hand = Skinning(np.zeros((len(tree.weights), 3)), tree.weights.copy(), np.zeros((1, 16, 3, 4)), np.zeros((0, 2)))
    no_hand.weights[:, planted.NAMES.index("hand_l")] = 0
    named = ["hand=hand_l", "body=" + ",".join(rest)]
    with pytest.raises(InputError, match="none in 'hand'"):
        find_parts(tree, no_hand, kind="named", named=named, overlap=1, affinity=0.3)
