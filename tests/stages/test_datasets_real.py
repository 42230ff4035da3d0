"""Loaders held against real files."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from tasks.datasets import mesh_sequence, rigged_character, validate
from tasks.datasets.canonical import canonical
from tasks.datasets.split import split
from tasks.errors import InputError
from tasks.geometry import kinematics
from tasks.geometry.measure import diagonal
from tasks.geometry.skinning import skin
from tasks.values import Skeleton

SEQUENCES = {
    "cat_poses": (9, 7207, 14410),
    "horse_collapse": (53, 8431, 16843),
    "horse_gallop": (24, 8431, 16843),
    "horse_poses": (10, 8431, 16843),
    "human_crane": (175, 10002, 20000),
    "human_samba": (175, 9971, 19938),
}
ANIMALS = ("alpaca", "deer", "donkey", "fox", "horse", "husky", "shibainu", "wolf")
DINOSAURS = ("apatosaurus", "parasaurolophus", "stegosaurus", "trex", "triceratops")
RIGS = (*ANIMALS, *DINOSAURS, "knight", "platformercharacter")
IDLE = ("Idle", "Idle_2", "Idle_Headlow", "Idle_2_HeadLow")


def sequence(shared_data, name):
    path = str(shared_data / "mesh_sequences" / f"{name}.npz")
    return mesh_sequence.load(path=path, fps=24.0, faces=True, unit="unit")


def character(shared_data, name, *, hierarchy="attached"):
    path = str(shared_data / "rigged_quaternius" / name)
    return rigged_character.load(path=path, fps=24.0, hierarchy=hierarchy, unit="unit")


@pytest.mark.parametrize("name", SEQUENCES)
def test_mesh_sequences_load(shared_data, name):
    motion = sequence(shared_data, name)
    assert (*motion.points.shape[:2], len(motion.faces)) == SEQUENCES[name]
    train, test = split(motion, by="frames", test=[], fraction=0.2, observed=1.0, frames=None)
    assert train.frames + test.frames == motion.frames
    frame = canonical(train, choice="least_deformed").frame
    assert 0 <= frame < train.frames
    horse = name.startswith("horse")
    assert validate.notes(motion) == (["open surface: 19 boundary edges"] if horse else [])


def test_the_published_gallop_of_48_files_is_refused(shared_data, tmp_path):
    once = sequence(shared_data, "horse_gallop")
    path = tmp_path / "gallop48.npz"
    np.savez(path, vertices=np.concatenate([once.points, once.points]), faces=once.faces)
    motion = mesh_sequence.load(path=str(path), fps=24.0, faces=True, unit="unit")
    with pytest.raises(InputError, match="repeat training frames"):
        split(motion, by="frames", test=[], fraction=0.2, observed=1.0, frames=None)


@pytest.mark.parametrize("name", RIGS)
def test_rigs_reproduce_the_posed_vertices(shared_data, name):
    motion = character(shared_data, f"decoded/{name}.npz")
    rig = motion.rig
    with np.load(shared_data / "rigged_quaternius" / "decoded" / f"{name}.npz") as data:
        frames, expected, used = data["check_frames"], data["check_vertices"], data["joint_used"]
        moving = {str(n) for n in data["joint_names"][used]}
    size = diagonal(expected[0])
    assert np.abs(motion.points[frames] - expected).max() < 1e-6 * size
    posed = kinematics.forward(rig.parents, rig.joints, rig.rotations, rig.translations)
    assert np.abs(skin(motion.rest, rig.weights, posed) - motion.points).max() < 1e-5 * size
    Skeleton(rig.names, rig.parents, rig.joints, rig.weights)  # one root, parents first
    assert moving <= set(rig.names)
    turned = np.trace(rig.rotations[:, 0].mean(0))  # the rest shape stands as the posed ones do
    assert turned > 2.0
    np.testing.assert_allclose(rig.weights.sum(1), 1.0, atol=1e-6)
    np.testing.assert_allclose(rig.rotations @ rig.rotations.swapaxes(-1, -2), np.eye(3) + 0 * rig.rotations, atol=1e-5)


@pytest.mark.parametrize("name", [*ANIMALS, "knight", "platformercharacter"])
def test_feet_hang_on_their_legs(shared_data, name):
    """In the files the feet of these IK rigs are roots or children of the world's root."""
    rig = character(shared_data, f"decoded/{name}.npz").rig
    size = diagonal(rig.joints)
    feet = [n for n in rig.names if n.startswith(("IKFrontLeg", "IKBackLeg", "Foot."))]
    assert feet
    for foot in feet:
        j = rig.names.index(foot)
        above, side = rig.names[rig.parents[j]], foot[-2:]
        assert "LowerLeg" in above
        assert above.endswith(side)
        assert np.abs(rig.translations[:, j]).max() < 0.1 * size


def test_authored_tree_reproduces_the_points_too(shared_data):
    motion = character(shared_data, "decoded/horse.npz", hierarchy="authored")
    rig = motion.rig
    assert rig.names[0] == "Body"
    assert rig.parents[rig.names.index("IKBackLeg.L")] == 0
    posed = kinematics.forward(rig.parents, rig.joints, rig.rotations, rig.translations)
    assert np.abs(skin(motion.rest, rig.weights, posed) - motion.points).max() < 1e-5 * diagonal(motion.points[0])


@pytest.mark.parametrize("name", ["fox", "horse", "knight", "trex"])
def test_glb_equals_its_decoded_form(shared_data, name):
    ours, theirs = (character(shared_data, path) for path in (f"glb/{name}.glb", f"decoded/{name}.npz"))
    assert ours.clip_names == theirs.clip_names
    assert ours.clip_start.tolist() == theirs.clip_start.tolist()
    assert ours.rig.names == theirs.rig.names
    assert ours.rig.parents.tolist() == theirs.rig.parents.tolist()
    size = diagonal(theirs.points[0])
    keys = [m.points[[0, 40, 90]].swapaxes(0, 1).reshape(m.points.shape[1], -1) for m in (ours, theirs)]
    _, same = cKDTree(keys[0]).query(keys[1])  # vertex order is nobody's promise
    assert len(set(same)) == len(same)
    assert abs(len(keys[0]) - len(keys[1])) <= 2  # trex: two seams that only a tolerance would weld
    assert np.abs(ours.points[:, same] - theirs.points).max() < 2e-5 * size
    np.testing.assert_allclose(ours.rig.weights[same], theirs.rig.weights, atol=1e-4)
    np.testing.assert_allclose(ours.rig.rotations, theirs.rig.rotations, atol=1e-5)


@pytest.mark.parametrize("name", RIGS)
def test_test_clips_are_chosen_well(shared_data, name):
    motion = character(shared_data, f"decoded/{name}.npz")
    train, test = split(motion, by="clips", test=[], fraction=0.2, observed=1.0, frames=None)
    held = set(test.clip_names)
    assert held
    assert not held & set(IDLE)
    assert not any(n.endswith("_Idle") for n in held)
    assert held | set(train.clip_names) == set(motion.clip_names)


def test_a_truncated_glb_is_one_line(shared_data, tmp_path):
    whole = (shared_data / "rigged_quaternius" / "glb" / "fox.glb").read_bytes()
    path = tmp_path / "fox.glb"
    for size in (0, 3, 12, 30, 5000, len(whole) // 2, len(whole) - 4):
        path.write_bytes(whole[:size])
        with pytest.raises(InputError, match=r"fox\.glb") as caught:
            rigged_character.load(path=str(path), fps=24.0, hierarchy="attached", unit="unit")
        assert "\n" not in str(caught.value)
