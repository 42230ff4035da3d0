"""The .npz form of rigged characters: good, odd and bad, on a small rig whose motion is known."""

from __future__ import annotations

import numpy as np
import pytest

from tasks.datasets import rigged_character, validate
from tasks.errors import InputError
from tasks.geometry import kinematics
from tasks.geometry.rotations import from_rotation_vector
from tasks.geometry.skinning import skin

FRAMES, SCALE = 6, 100.0
# a leg along -y whose foot is authored under the world's root, as in IK rigs; a helper moves nothing
NAMES = ["world", "hip", "knee", "foot", "pole"]
PARENTS = [-1, 0, 1, 0, 0]
JOINTS = np.array([[0, 0, 0], [0, 1, 0], [0, 0.5, 0], [0, 0.1, 0], [0.5, 0.5, 0]])
VERTICES = np.array(
    [[0.1, 0.9, 0], [0, 0.6, 0.1], [0.1, 0.5, 0], [0, 0.3, 0.1], [0.1, 0.1, 0], [0, 0, 0.1]], np.float32
)
FACES = np.array([[0, 1, 2], [1, 2, 3], [2, 3, 4], [3, 4, 5]])
# vertices go from hip over knee to foot; the knee shares vertex 4 with the foot
INDEX = np.array([[1, 0], [1, 2], [2, 0], [2, 0], [2, 3], [3, 0]])
VALUE = np.array([[1, 0], [0.5, 0.5], [1, 0], [1, 0], [0.5, 0.5], [1, 0]])


def truth() -> np.ndarray:
    """Rigid joint transforms in posed space (F, 5, 3, 4): the hip walks along x and turns, the rest follows."""
    rotations = np.zeros((FRAMES, 5, 3))
    rotations[:, 1, 2] = 0.1 * np.arange(FRAMES)
    rotations[:, 2, 2] = -0.2 * np.arange(FRAMES)
    shift = np.zeros((FRAMES, 5, 3))
    shift[:, 1, 0] = 40 * np.arange(FRAMES)
    chain = np.array([-1, 0, 1, 2, 0])
    return kinematics.forward(chain, JOINTS * SCALE, from_rotation_vector(rotations), shift)


def arrays(**changed) -> dict:
    matrices = truth()
    matrices[..., :3] *= SCALE  # mesh space is a hundred times smaller
    bind = np.tile(np.eye(4), (5, 1, 1))
    bind[:, :3, 3] = JOINTS
    data = {
        "rest_vertices": VERTICES,
        "faces": FACES,
        "weight_index": INDEX,
        "weight_value": VALUE,
        "joint_names": np.array(NAMES),
        "joint_parents": np.array(PARENTS),
        "bind_matrices": bind,
        "clip_names": np.array(["go"]),
        "clip_start": np.array([0, FRAMES]),
        "skin_matrices": matrices,
    } | changed
    return {k: v for k, v in data.items() if v is not None}


def load(tmp_path, *, hierarchy="attached", **changed):
    path = tmp_path / "leg.npz"
    np.savez(path, **arrays(**changed))
    return rigged_character.load(path=str(path), fps=24.0, hierarchy=hierarchy, unit="unit")


def dense() -> np.ndarray:
    weights = np.zeros((6, 5))
    np.add.at(weights, (np.arange(6)[:, None], INDEX), VALUE)
    return weights


def test_the_foot_goes_under_the_knee_and_helpers_go(tmp_path):
    motion = load(tmp_path)
    rig = motion.rig
    assert (rig.names, rig.parents.tolist()) == (("hip", "knee", "foot"), [-1, 0, 1])
    np.testing.assert_allclose(motion.points, skin(VERTICES * SCALE, dense(), truth()), atol=1e-4)
    np.testing.assert_allclose(motion.rest, VERTICES * SCALE, atol=1e-4)
    np.testing.assert_allclose(rig.translations[:, 1:], 0, atol=1e-4)
    np.testing.assert_allclose(rig.translations[:, 0, 0], 40 * np.arange(FRAMES), atol=1e-4)
    np.testing.assert_allclose(rig.rotations[:, 2], np.tile(np.eye(3), (FRAMES, 1, 1)), atol=1e-5)
    swing = from_rotation_vector(np.array([0, 0, -0.2]) * np.arange(FRAMES)[:, None])
    np.testing.assert_allclose(rig.rotations[:, 1], swing, atol=1e-5)


def test_the_authored_tree_keeps_the_foot_under_the_world(tmp_path):
    motion = load(tmp_path, hierarchy="authored")
    rig = motion.rig
    assert (rig.names, rig.parents.tolist()) == (("world", "hip", "knee", "foot"), [-1, 0, 1, 0])
    assert np.abs(rig.translations[:, 3]).max() > 100
    posed = kinematics.forward(rig.parents, rig.joints, rig.rotations, rig.translations)
    np.testing.assert_allclose(skin(motion.rest, rig.weights, posed), motion.points, atol=1e-3)


@pytest.mark.parametrize("hierarchy", ["attached", "authored"])
def test_many_roots_in_any_order_become_one_tree(tmp_path, hierarchy):
    order = np.array([3, 2, 4, 1, 0])  # foot, knee, pole, hip, world; every joint but the knee a root
    place = np.argsort(order)
    data = arrays()
    motion = load(
        tmp_path,
        hierarchy=hierarchy,
        joint_names=data["joint_names"][order],
        joint_parents=np.array([-1, 3, -1, -1, -1]),
        bind_matrices=data["bind_matrices"][order],
        skin_matrices=data["skin_matrices"][:, order],
        weight_index=place[INDEX],
    )
    rig = motion.rig
    above = dict(zip(rig.names, [None, *(rig.names[p] for p in rig.parents[1:])], strict=True))
    assert above == {"hip": None, "knee": "hip", "foot": "knee" if hierarchy == "attached" else "hip"}
    posed = kinematics.forward(rig.parents, rig.joints, rig.rotations, rig.translations)
    np.testing.assert_allclose(skin(motion.rest, rig.weights, posed), motion.points, atol=1e-3)


def test_a_mesh_space_that_lies_down_is_stood_up(tmp_path):
    """z up in mesh space, y up when posed, as FBX exports are: the rest shape comes out with y up."""
    lying = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])  # y to z
    data = arrays()
    matrices, bind = data["skin_matrices"].copy(), data["bind_matrices"].copy()
    matrices[..., :3] = matrices[..., :3] @ lying.T
    bind[:, :3, 3] = JOINTS @ lying.T
    down = load(tmp_path, rest_vertices=VERTICES @ lying.T, bind_matrices=bind, skin_matrices=matrices)
    up = load(tmp_path)
    np.testing.assert_allclose(down.rest, VERTICES * SCALE, atol=1e-4)
    np.testing.assert_allclose(down.points, up.points, atol=1e-4)
    np.testing.assert_allclose(down.rig.joints, up.rig.joints, atol=1e-4)
    np.testing.assert_allclose(down.rig.rotations, up.rig.rotations, atol=1e-5)


def test_joints_that_scale_keep_the_points_and_are_noted(tmp_path):
    matrices = arrays()["skin_matrices"].copy()
    matrices[2, 2, :, :3] *= 1.3
    motion = load(tmp_path, skin_matrices=matrices)
    scaled = truth()
    scaled[2, 2, :, :3] *= 1.3
    np.testing.assert_allclose(motion.points, skin(VERTICES * SCALE, dense(), scaled), atol=1e-3)
    assert any("skeleton alone" in note for note in validate.notes(motion))
    assert validate.notes(load(tmp_path)) == ["open surface: 6 boundary edges"]


def mirrored() -> np.ndarray:
    matrices = arrays()["skin_matrices"].copy()
    matrices[..., 0, :] *= -1
    return matrices


def poisoned() -> np.ndarray:
    matrices = arrays()["skin_matrices"].copy()
    matrices[4, 2, 0, 0] = np.nan
    return matrices


CHECKS = {"check_frames": np.array([0, 5]), "check_vertices": skin(VERTICES * SCALE, dense(), truth()[[0, 5]])}
BAD = {
    "no weights": ({"weight_value": None}, ("add weight_value",)),
    "weights of another mesh": ({"weight_index": INDEX[:5]}, ("weight_index", "(6, influences)", "(5, 2)")),
    "a joint out of range": ({"weight_index": INDEX + 3}, ("weight_index", "0 to 4", "3 to 6")),
    "a vertex without weight": ({"weight_value": VALUE * [[1], [1], [0], [1], [1], [1]]}, ("weights", "vertex 2")),
    "a negative weight": ({"weight_value": VALUE - 0.1}, ("weights", "at least zero")),
    "faces out of range": ({"faces": FACES + 1}, ("faces", "0 to 5")),
    "bind of other joints": ({"bind_matrices": np.zeros((4, 4, 4))}, ("bind_matrices", "(5, 4, 4)")),
    "matrices of other joints": ({"skin_matrices": truth()[:, :4]}, ("skin_matrices", "(frames, 5, 3, 4)")),
    "matrices as 4x4": ({"skin_matrices": np.zeros((6, 5, 4, 4))}, ("skin_matrices", "(6, 5, 4, 4)")),
    "NaN in a matrix": ({"skin_matrices": poisoned()}, ("skin matrices", "frame 4", "joint knee")),
    "mirrored": ({"skin_matrices": mirrored()}, ("skin matrices", "mirroring")),
    "NaN at rest": ({"rest_vertices": VERTICES * np.nan}, ("rest_vertices", "finite")),
    "a ring of parents": ({"joint_parents": np.array([-1, 2, 1, 0, 0])}, ("joint_parents", "cycle", "joint 1")),
    "a parent out of range": ({"joint_parents": np.array([-1, 0, 1, 9, 0])}, ("joint_parents", "0 to 4")),
    "names of numbers": ({"joint_names": np.arange(5)}, ("joint_names", "strings")),
    "clips that miss frames": ({"clip_start": np.array([0, 4])}, ("clip_start", "0 to 6")),
    "no motion": ({"skin_matrices": np.repeat(arrays()["skin_matrices"][:1], 6, 0)}, ("moving sequence",)),
    "other check vertices": ({**CHECKS, "check_vertices": CHECKS["check_vertices"] + 1}, ("check_vertices", "away")),
    "a check frame too far": ({**CHECKS, "check_frames": np.array([0, 6])}, ("check_frames", "0 to 5")),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_rigs(tmp_path, name):
    changed, says = BAD[name]
    with pytest.raises(InputError) as caught:
        load(tmp_path, **changed)
    message = str(caught.value)
    assert "leg.npz" in message
    assert "\n" not in message
    assert all(word in message for word in says), message


def test_the_files_own_check_passes(tmp_path):
    assert load(tmp_path, **CHECKS, fps=np.float32(30)).fps == 30.0


def test_other_formats_are_named(tmp_path):
    path = tmp_path / "leg.gltf"
    path.write_text("{}")
    with pytest.raises(InputError, match=r"one \.glb"):
        rigged_character.load(path=str(path), fps=24.0, hierarchy="attached", unit="unit")


def test_names_with_line_breaks_stay_on_one_line(tmp_path):
    names = np.array(["world", "hip", "kn\nee\x1b[31m", "foot", "pole"])
    with pytest.raises(InputError) as caught:
        load(tmp_path, joint_names=names, skin_matrices=poisoned())
    assert "joint kn ee [31m" in str(caught.value)
    assert str(caught.value).isprintable()
