"""Exported characters read back: glTF by our own reader and by trimesh, BVH by the angles it holds."""

from __future__ import annotations

import io
import json
import struct

import numpy as np
import pytest
import trimesh

from tasks.datasets import gltf, mesh_sequence
from tasks.datasets.rigging import to_motion
from tasks.errors import InputError
from tasks.export import bvh, character, glb
from tasks.geometry import kinematics, rigid
from tasks.geometry.rotations import from_quaternion, from_rotation_vector, geodesic
from tasks.geometry.skinning import skin
from tasks.values import Animation, Canonical, Motion, Poses, Skeleton, Skinning

FPS = 25.0
PARENTS = np.array([-1, 0, 1, 1], np.int32)
JOINTS = np.array([[0.1, 0.5, 0], [0.1, 1.0, 0], [0.6, 1.4, 0], [-0.4, 1.4, 0.2]], np.float32)


class Case:
    """A blob with a skeleton of four joints and five bones, all moving, in two clips."""

    def __init__(self, influences: int = 4) -> None:
        rng = np.random.default_rng(3)
        mesh = trimesh.creation.icosphere(subdivisions=2)
        points, count = (mesh.vertices + np.array([0, 1, 0])).astype(np.float32), len(mesh.vertices)
        self.canonical = Canonical(points, np.array(mesh.faces, np.int32), -1, "blob")
        self.skeleton = Skeleton(("hip", "chest", "left arm", "arm"), PARENTS, JOINTS, self._weights(rng, count, 4, 4))
        frames = 14
        turns = np.cumsum(rng.normal(scale=0.25, size=(frames, 4, 3)), axis=0)
        shift = np.zeros((frames, 4, 3), np.float32)
        shift[:, 0] = rng.normal(size=(frames, 3))
        rotations = from_rotation_vector(turns).astype(np.float32)
        start = np.array([0, 9, frames])
        self.poses = Poses(rotations, shift, start)
        spins = from_rotation_vector(np.cumsum(rng.normal(scale=0.3, size=(frames, 9, 3)), axis=0))
        self.bones = rigid.make(spins, rng.normal(size=(frames, 9, 3))).astype(np.float32)
        self.skinning = Skinning(points, self._weights(rng, count, 9, influences), self.bones, np.zeros(1))
        self.points = skin(points, self.skinning.weights, self.bones)
        self.motion = Motion("blob", self.points, self.canonical.faces, start, ("walk", "a/b"), FPS, "m")

    def _weights(self, rng, count: int, bones: int, influences: int) -> np.ndarray:
        weights = rng.random((count, bones))
        weights[np.argsort(weights, axis=1) < bones - influences] = 0
        return (weights / weights.sum(1, keepdims=True)).astype(np.float32)

    @property
    def values(self) -> tuple:
        return self.canonical, self.skinning, self.skeleton, self.motion, self.poses


def only(files) -> bytes:
    ((_, data),) = files.items()
    return data


@pytest.fixture
def case() -> Case:
    return Case()


def read_back(data: bytes, tmp_path) -> Motion:
    path = tmp_path / "out.glb"
    path.write_bytes(data)
    return to_motion(gltf.read_glb(path, fps=FPS), hierarchy="authored", unit="unit")


def match(found: np.ndarray, expected: np.ndarray) -> None:
    """Readers may order vertices anew: every expected point is found in every frame."""
    assert found.shape == expected.shape
    order = np.array([np.argmin(np.linalg.norm(found[0] - p, axis=1)) for p in expected[0]])
    np.testing.assert_allclose(found[:, order], expected, atol=2e-5)


@pytest.mark.parametrize("influences", [4, 7])
def test_bones_in_motion_come_back(tmp_path, influences):
    case = Case(influences)
    data = only(character.bones_glb(*case.values, name="blob"))
    motion = read_back(data, tmp_path)
    assert motion.clip_names == ("walk", "a_b")
    assert np.diff(motion.clip_start).tolist() == [9, 5]
    match(motion.points, case.points)
    animated = Animation(points=case.points[::-1], bones=case.bones[::-1])
    motion = read_back(only(character.bones_glb(*case.values, animated, name="blob")), tmp_path)
    match(motion.points, case.points[::-1])


def test_a_method_without_bones_gets_its_skeleton(case, tmp_path):
    posed = kinematics.forward(PARENTS, JOINTS, case.poses.rotations, case.poses.translations)
    points = skin(case.canonical.points, case.skeleton.weights, posed)
    files = character.bones_glb(*case.values, Animation(points=points), name="blob")
    assert files.paths == ("export/blob_skeleton.glb",)
    motion = read_back(only(files), tmp_path)
    match(motion.points, points)
    assert motion.rig.names == case.skeleton.names
    np.testing.assert_array_equal(motion.rig.parents, PARENTS)


def test_weights_of_a_methods_own_are_not_passed_off_as_the_skeletons(case):
    posed = kinematics.forward(PARENTS, JOINTS, case.poses.rotations, case.poses.translations)
    other = np.roll(case.skeleton.weights, 1, axis=1)
    with pytest.raises(InputError, match="take npz"):
        character.bones_glb(*case.values, Animation(points=skin(case.canonical.points, other, posed)), name="blob")


def test_others_read_the_mesh(case):
    data = only(character.bones_glb(*case.values, name="blob"))
    scene = trimesh.load(io.BytesIO(data), file_type="glb")
    (mesh,) = scene.geometry.values()
    np.testing.assert_allclose(mesh.vertices, case.canonical.points, atol=1e-6)
    assert len(mesh.faces) == len(case.canonical.faces)
    radial = case.canonical.points - [0, 1, 0]
    normals = glb.normals_of(case.canonical.points, case.canonical.faces)
    assert (normals * radial).sum(1).min() > 0.95
    length, _, kind = struct.unpack("<4sII", data[:12])[2], None, data[16:20]
    assert length == len(data)
    assert kind == b"JSON"
    tree = json.loads(data[20 : 20 + struct.unpack("<I", data[12:16])[0]])
    assert [a["name"] for a in tree["animations"]] == ["walk", "a_b"]
    above = {child: n for n, node in enumerate(tree["nodes"]) for child in node.get("children", [])}
    assert len({above[j] for j in tree["skins"][0]["joints"]}) == 1  # a skin's joints have a common root
    assert all(v["byteOffset"] % 4 == 0 for v in tree["bufferViews"])


def test_bare_points(case, tmp_path):
    bare = Canonical(case.canonical.points, None, -1, "points")
    data = only(character.bones_glb(bare, *case.values[1:], name="p"))
    tree = json.loads(data[20 : 20 + struct.unpack("<I", data[12:16])[0]])
    assert tree["meshes"][0]["primitives"][0]["mode"] == 0


def test_influences_sum_to_one_and_name_no_joint_in_vain():
    rng = np.random.default_rng(0)
    weights = rng.random((500, 20)) ** 6
    weights[:250, 4:] = 0
    joints, share = glb.influences(weights)
    assert joints.shape == (500, 8)
    np.testing.assert_allclose(share.sum(1, dtype=np.float64), 1, atol=1e-7)
    assert (joints[share == 0] == 0).all()
    assert glb.influences(weights[:250])[0].shape == (250, 4)
    assert glb.influences(np.ones((3, 2)))[1].tolist() == [[0.5, 0.5, 0, 0]] * 3


def test_quaternions_do_not_jump():
    turns = from_rotation_vector(np.linspace(0, 4 * np.pi, 80)[:, None, None] * np.array([0, 0, 1.0]))
    q = glb.quaternions(turns)
    assert np.abs(np.diff(q, axis=0)).max() < 0.1
    np.testing.assert_allclose(from_quaternion(q[..., [3, 0, 1, 2]]), turns, atol=1e-9)


def parse_bvh(text: str) -> tuple[dict, np.ndarray]:
    """Joint -> (parent, offset, channels) in file order, and the rows of numbers."""
    joints, stack, name = {}, [], None
    head, _, motion = text.partition("MOTION\n")
    for line in head.splitlines():
        words = line.split()
        if words[0] in ("ROOT", "JOINT"):
            name = words[1]
            joints[name] = [stack[-1] if stack else None, None, None]
        elif words[0] == "End":
            name = None
        elif words[0] == "{":
            stack.append(name)
        elif words[0] == "}":
            stack.pop()
        elif words[0] == "OFFSET" and name:
            joints[name][1] = [float(w) for w in words[1:]]
        elif words[0] == "CHANNELS":
            joints[name][2] = words[2:]
    lines = motion.splitlines()
    assert lines[0] == f"Frames: {len(lines) - 2}"
    assert float(lines[1].removeprefix("Frame Time: ")) == pytest.approx(1 / FPS)
    return joints, np.array([[float(w) for w in line.split()] for line in lines[2:]])


AXES = {"X": [1.0, 0, 0], "Y": [0, 1.0, 0], "Z": [0, 0, 1.0]}


def test_bvh_holds_the_poses(case):
    files = character.skeleton_bvh(case.skeleton, case.motion, case.poses, name="blob")
    assert files.paths == ("export/blob_walk.bvh", "export/blob_a_b.bvh")
    joints, rows = parse_bvh(files.items()[1][1].decode())
    assert list(joints) == ["hip", "chest", "left_arm", "arm"]
    assert [j[0] for j in joints.values()] == [None, "hip", "chest", "chest"]
    np.testing.assert_allclose(joints["arm"][1], JOINTS[3] - JOINTS[1], atol=1e-6)
    expected = kinematics.forward(PARENTS, JOINTS, case.poses.rotations[9:], case.poses.translations[9:])
    at = kinematics.joint_positions(expected, JOINTS)
    place, turn, column = {}, {}, 0
    for j, (name, (parent, offset, channels)) in enumerate(joints.items()):
        local, step = np.tile(np.eye(3), (len(rows), 1, 1)), np.tile(offset, (len(rows), 1))
        for channel in channels:
            value = rows[:, column]
            column += 1
            if channel.endswith("position"):
                step[:, "XYZ".index(channel[0])] = value
            else:
                local = local @ from_rotation_vector(np.radians(value)[:, None] * np.array(AXES[channel[0]]))
        turn[name] = local if parent is None else turn[parent] @ local
        place[name] = step if parent is None else place[parent] + (turn[parent] @ step[..., None])[..., 0]
        np.testing.assert_allclose(place[name], at[:, j], atol=2e-5)
        assert geodesic(turn[name], expected[:, j, :, :3]).max() < 1e-4
    assert column == rows.shape[1]


def test_angles_at_the_pole():
    up = from_rotation_vector(np.array([[np.pi / 2, 0, 0], [-np.pi / 2, 0, 0]])) @ from_rotation_vector(
        np.array([0.0, 0.7, 0.0])
    )
    z, x, y = np.moveaxis(bvh.euler_zxy(up), -1, 0)
    axes = [from_rotation_vector(a[:, None] * np.array(v)) for a, v in ((z, AXES["Z"]), (x, AXES["X"]), (y, AXES["Y"]))]
    np.testing.assert_allclose(axes[0] @ axes[1] @ axes[2], up, atol=1e-6)


def test_points_are_a_dataset_again(case, tmp_path):
    files = character.points_npz(case.canonical, case.motion, case.poses, case.skeleton, name="blob")
    path = tmp_path / "blob.npz"
    path.write_bytes(only(files))
    motion = mesh_sequence.load(path=str(path), fps=1.0, faces=True, unit="m")
    assert motion.fps == FPS
    assert motion.clip_names == ("walk", "a_b")
    np.testing.assert_array_equal(motion.points, case.points)
