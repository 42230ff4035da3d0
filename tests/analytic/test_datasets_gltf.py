"""The reader of binary glTF, on files made here whose motion is known in closed form."""

from __future__ import annotations

import copy
import json
import struct

import numpy as np
import pytest

from tasks.datasets import rigged_character
from tasks.datasets.gltf import interpolate
from tasks.errors import InputError
from tasks.geometry import kinematics
from tasks.geometry.skinning import skin

CODES = {"i1": 5120, "u1": 5121, "u2": 5123, "u4": 5125, "f4": 5126}
WIDTHS = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}
HALF = np.sqrt(0.5)

# an arm along x: shoulder at 0, elbow at 1, finger tip at 2; the elbow turns about z
ARM = np.array([[0, 0, 0], [0.5, 0.1, 0], [1.5, 0.1, 0], [2, 0, 0], [0.5, -0.1, 0.1], [1.5, -0.1, 0.1]], np.float32)
ARM_FACES = np.array([[0, 1, 4], [1, 2, 5], [2, 3, 5], [1, 5, 4]])
ELBOW = np.array([0, 0, 1, 1, 0, 1])  # which joint holds each vertex


class Scene:
    """A glTF tree and its binary chunk, written piece by piece."""

    def __init__(self) -> None:
        self.binary = b""
        self.tree = {"asset": {"version": "2.0"}, "buffers": [{}], "bufferViews": [], "accessors": []}

    def view(self, data: bytes, **more) -> int:
        self.binary += b"\0" * (-len(self.binary) % 4)
        self.tree["bufferViews"].append({"buffer": 0, "byteOffset": len(self.binary), "byteLength": len(data)} | more)
        self.binary += data
        return len(self.tree["bufferViews"]) - 1

    def add(self, array, kind: str = "f4", **more) -> int:
        array = np.asarray(array, f"<{kind}").reshape(len(array), -1)
        accessor = {"componentType": CODES[kind], "count": len(array), "type": WIDTHS[array.shape[1]]}
        self.tree["accessors"].append(accessor | {"bufferView": self.view(array.tobytes())} | more)
        return len(self.tree["accessors"]) - 1

    def bytes(self) -> bytes:
        tree = copy.deepcopy(self.tree)
        tree["buffers"][0].setdefault("byteLength", len(self.binary))
        text = json.dumps(tree).encode()
        text += b" " * (-len(text) % 4)
        binary = self.binary + b"\0" * (-len(self.binary) % 4)
        chunks = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(binary), 0x004E4942) + binary
        return b"glTF" + struct.pack("<II", 2, 12 + len(chunks)) + chunks


def quaternion(degrees: float) -> list[float]:
    half = np.radians(degrees) / 2
    return [0.0, 0.0, np.sin(half), np.cos(half)]


def shifted(x: float) -> np.ndarray:
    """A shift along x as glTF stores it: columns first."""
    matrix = np.eye(4)
    matrix[3, 0] = x
    return matrix.ravel()


def arm(how: str = "LINEAR", keys: tuple = (0.0, 1.0), values: list | None = None) -> Scene:
    scene = Scene()
    values = [quaternion(0), quaternion(90)] if values is None else values
    one = np.zeros((6, 4))
    one[:, 0] = 1
    attributes = {
        "POSITION": scene.add(ARM),
        "JOINTS_0": scene.add(np.column_stack([ELBOW, np.zeros((6, 3))]), "u1"),
        "WEIGHTS_0": scene.add(one * 255, "u1", normalized=True),
    }
    scene.tree |= {
        "nodes": [
            {"name": "world", "children": [1, 4], "scale": [2, 2, 2]},
            {"name": "shoulder", "children": [2]},
            {"name": "between", "translation": [0.25, 0, 0], "children": [3]},
            {"name": "elbow", "translation": [0.75, 0, 0]},
            {"name": "body", "mesh": 0, "skin": 0, "translation": [7, 7, 7]},  # a skinned mesh ignores its own node
        ],
        "meshes": [{"primitives": [{"attributes": attributes, "indices": scene.add(ARM_FACES.ravel(), "u2")}]}],
        "skins": [{"joints": [1, 3], "inverseBindMatrices": scene.add([shifted(0), shifted(-1)])}],
        "animations": [
            {
                "name": "Armature|Bend",
                "samplers": [{"input": scene.add(keys), "output": scene.add(values), "interpolation": how}],
                "channels": [{"sampler": 0, "target": {"node": 3, "path": "rotation"}}],
            }
        ],
    }
    return scene


def bent(degrees: np.ndarray) -> np.ndarray:
    """The arm at given elbow angles, at twice the size, as the world node scales."""
    out = np.repeat(ARM[None].astype(np.float64), len(degrees), 0)
    for f, angle in enumerate(np.radians(degrees)):
        c, s = np.cos(angle), np.sin(angle)
        out[f, ELBOW == 1] = (ARM[ELBOW == 1] - [1, 0, 0]) @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) + [1, 0, 0]
    return 2 * out


def load(scene: Scene | bytes, tmp_path, fps: float = 4.0):
    path = tmp_path / "arm.glb"
    path.write_bytes(scene if isinstance(scene, bytes) else scene.bytes())
    return rigged_character.load(path=str(path), fps=fps, hierarchy="attached", unit="m")


def test_linear_turn(tmp_path):
    motion = load(arm(), tmp_path)
    assert (motion.name, motion.clip_names, motion.unit, motion.fps) == ("arm", ("Bend",), "m", 4.0)
    np.testing.assert_allclose(motion.points, bent(np.linspace(0, 90, 5)), atol=1e-6)
    np.testing.assert_array_equal(motion.faces, ARM_FACES)
    np.testing.assert_allclose(motion.rest, 2 * ARM, atol=1e-6)


def test_rig_of_the_arm(tmp_path):
    motion = load(arm(), tmp_path)
    rig = motion.rig
    assert (rig.names, rig.parents.tolist()) == (("shoulder", "elbow"), [-1, 0])
    np.testing.assert_allclose(rig.joints, [[0, 0, 0], [2, 0, 0]], atol=1e-6)
    np.testing.assert_allclose(rig.rotations[:, 0], np.tile(np.eye(3), (5, 1, 1)), atol=1e-6)
    np.testing.assert_allclose(rig.rotations[-1, 1], [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-6)
    np.testing.assert_allclose(rig.translations, 0, atol=1e-6)
    posed = kinematics.forward(rig.parents, rig.joints, rig.rotations, rig.translations)
    np.testing.assert_allclose(skin(motion.rest, rig.weights, posed), motion.points, atol=1e-6)


def test_step_holds_and_cubic_follows_hermite(tmp_path):
    motion = load(arm("STEP"), tmp_path)
    np.testing.assert_allclose(motion.points, bent(np.array([0, 0, 0, 0, 90])), atol=1e-6)
    no = [0.0] * 4
    motion = load(arm("CUBICSPLINE", values=[no, quaternion(0), no, no, quaternion(90), no]), tmp_path)
    u = np.linspace(0, 1, 5)
    share = 3 * u**2 - 2 * u**3  # flat tangents: an ease-in, ease-out blend, then made unit length
    x, w = share * HALF, 1 - share + share * HALF
    np.testing.assert_allclose(motion.points, bent(np.degrees(2 * np.arctan2(x, w))), atol=1e-6)


def test_interpolation_by_hand():
    keys, values = np.array([0.0, 1.0, 3.0]), np.array([[0.0], [1.0], [5.0]])
    at = np.array([-1.0, 0.5, 1.0, 2.0, 3.0, 9.0])
    np.testing.assert_allclose(interpolate(keys, values, at, "LINEAR", turns=False)[:, 0], [0, 0.5, 1, 3, 5, 5])
    np.testing.assert_allclose(interpolate(keys, values, at, "STEP", turns=False)[:, 0], [0, 0, 1, 1, 5, 5])
    times = np.linspace(0, 3, 7)
    cubic = np.array([[0.0, v**3, 3 * v**2] for v in keys])  # t^3 with its own tangents comes back exactly
    cubic[:, 0] = cubic[:, 2]
    out = interpolate(keys, cubic.reshape(-1, 1), times, "CUBICSPLINE", turns=False)
    np.testing.assert_allclose(out[:, 0], times**3, atol=1e-12)
    one = interpolate(np.array([2.0]), np.array([[4.0]]), times, "LINEAR", turns=False)
    np.testing.assert_array_equal(one, np.full((7, 1), 4.0))
    far = np.array([quaternion(0), -np.array(quaternion(90))])  # the same turn with the other sign: take the short way
    middle = interpolate(np.array([0.0, 1.0]), far, np.array([0.5]), "LINEAR", turns=True)[0]
    np.testing.assert_allclose(middle, quaternion(45), atol=1e-12)


def test_interleaved_and_sparse_accessors(tmp_path):
    scene = arm()
    rows = np.concatenate([ARM, np.full((6, 2), 9, np.float32)], axis=1)  # five floats a vertex, three of them position
    position = scene.tree["accessors"][0]
    position["bufferView"] = scene.view(rows.tobytes(), byteStride=20)
    np.testing.assert_allclose(load(scene, tmp_path).points[0], 2 * ARM, atol=1e-6)
    del position["bufferView"]  # zeros, then six replaced
    index, values = scene.view(np.arange(6, dtype="<u2").tobytes()), scene.view(ARM.tobytes())
    position["sparse"] = {
        "count": 6,
        "indices": {"bufferView": index, "componentType": 5123},
        "values": {"bufferView": values},
    }
    np.testing.assert_allclose(load(scene, tmp_path).points[0], 2 * ARM, atol=1e-6)


def test_seams_are_welded_and_primitives_joined(tmp_path):
    scene = arm()
    first = scene.tree["meshes"][0]["primitives"][0]
    half = [scene.add(ARM_FACES[a:b].ravel(), "u2") for a, b in ((0, 2), (2, 4))]
    scene.tree["meshes"][0]["primitives"] = [first | {"indices": half[0]}, first | {"indices": half[1]}]
    motion = load(scene, tmp_path)
    np.testing.assert_allclose(motion.rest, 2 * ARM, atol=1e-6)
    np.testing.assert_array_equal(motion.faces, ARM_FACES)


def test_two_skins_of_one_armature(tmp_path):
    """A second mesh bound in a space of its own, shifted by 5 along x, comes to lie where its skin says."""
    scene = arm()
    tree = scene.tree
    primitive = copy.deepcopy(tree["meshes"][0]["primitives"][0])
    primitive["attributes"]["POSITION"] = scene.add(ARM + np.array([5, 0, 1]))
    tree["meshes"].append({"primitives": [primitive]})
    tree["skins"].append({"joints": [1, 3], "inverseBindMatrices": scene.add([shifted(-5), shifted(-6)])})
    tree["nodes"].append({"mesh": 1, "skin": 1})
    motion = load(scene, tmp_path)
    assert motion.points.shape[1] == 12
    np.testing.assert_allclose(motion.points[:, 6:] - [0, 0, 2], motion.points[:, :6], atol=1e-6)
    tree["skins"][1]["inverseBindMatrices"] = scene.add([shifted(-5), shifted(-8)])
    with pytest.raises(InputError, match="agree about the bind pose"):
        load(scene, tmp_path)


def test_clips_of_one_name_and_without_a_name(tmp_path):
    scene = arm()
    bend = scene.tree["animations"][0]
    unnamed = {k: v for k, v in bend.items() if k != "name"}
    scene.tree["animations"] = [bend, bend, unnamed]
    motion = load(scene, tmp_path)
    assert motion.clip_names == ("Bend", "Bend_2", "clip002")
    assert motion.clip_start.tolist() == [0, 5, 10, 15]


def damage(change) -> Scene:
    scene = arm()
    change(scene.tree, scene)
    return scene


def primitive(tree: dict) -> dict:
    return tree["meshes"][0]["primitives"][0]


DAMAGED = {
    "no skin": (lambda t, s: t["nodes"][4].pop("skin"), "none skinned"),
    "no animation": (lambda t, s: t.pop("animations"), "at least one animation"),
    "draco": (lambda t, s: t.update(extensionsRequired=["KHR_draco_mesh_compression"]), "without compression"),
    "external buffer": (lambda t, s: t["buffers"][0].update(uri="arm.bin"), "external buffers"),
    "lines": (lambda t, s: primitive(t).update(mode=1), "triangles"),
    "no weights": (lambda t, s: primitive(t)["attributes"].pop("WEIGHTS_0"), "JOINTS_0 and WEIGHTS_0"),
    "a joint beyond the skin": (lambda t, s: t["skins"][0].update(joints=[1]), "JOINTS_0"),
    "a vertex beyond the mesh": (lambda t, s: primitive(t).update(indices=s.add([0, 1, 6], "u2")), "indices"),
    "an accessor beyond the file": (lambda t, s: t["accessors"][0].update(count=600), "truncated or damaged"),
    "an accessor that is not there": (lambda t, s: primitive(t).update(indices=99), "IndexError"),
    "a key without its value": (lambda t, s: t["accessors"][-1].update(count=1), "rotation values"),
    "key times that fall": (
        lambda t, s: t["animations"][0]["samplers"][0].update(input=s.add([1.0, 0.0])),
        "key times that rise",
    ),
    "an unknown interpolation": (
        lambda t, s: t["animations"][0]["samplers"][0].update(interpolation="SPRING"),
        "SPRING",
    ),
    "no rotation at all": (
        lambda t, s: t["animations"][0]["samplers"][0].update(output=s.add(np.zeros((2, 4)))),
        "quaternion of zeros",
    ),
    "nodes in a ring": (lambda t, s: t["nodes"][3].update(children=[1]), "cycle"),
    "nodes that are no list": (lambda t, s: t.update(nodes=5), "TypeError"),
    "weights of zero": (
        lambda t, s: primitive(t)["attributes"].update(WEIGHTS_0=s.add(np.zeros((6, 4)))),
        "sum above zero",
    ),
    "NaN among the points": (
        lambda t, s: primitive(t)["attributes"].update(POSITION=s.add(ARM * np.nan)),
        "finite numbers",
    ),
    "a bind pose that is flat": (
        lambda t, s: t["skins"][0].update(inverseBindMatrices=s.add(np.zeros((2, 16)))),
        "inverted",
    ),
    "an arm that keeps still": (
        lambda t, s: t["animations"][0]["samplers"][0].update(output=s.add([quaternion(0)] * 2)),
        "moving sequence",
    ),
    "morph targets that move": (
        lambda t, s: (
            primitive(t).update(targets=[{}]),
            t["animations"][0]["channels"].append({"sampler": 0, "target": {"node": 4, "path": "weights"}}),
        ),
        "morph targets",
    ),
}


@pytest.mark.parametrize("name", DAMAGED)
def test_damaged_scenes(tmp_path, name):
    change, says = DAMAGED[name]
    with pytest.raises(InputError) as caught:
        load(damage(change), tmp_path)
    message = str(caught.value)
    assert "arm.glb" in message
    assert says in message
    assert "\n" not in message


def test_damaged_containers(tmp_path):
    whole = arm().bytes()
    for data, says in (
        (b"", "empty file"),
        (b"PK\x03\x04" + whole[4:], "binary glTF"),
        (whole[:4] + struct.pack("<I", 1) + whole[8:], "glTF 2.0"),
        (whole[:200], "truncated"),
        (whole[:20] + b"}" + whole[21:], "JSON"),
    ):
        with pytest.raises(InputError, match=says):
            load(data, tmp_path)
    (tmp_path / "folder.glb").mkdir()
    with pytest.raises(InputError, match="a folder"):
        rigged_character.load(path=str(tmp_path / "folder.glb"), fps=24.0, hierarchy="attached", unit="unit")


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_random_damage_is_loaded_or_refused_but_never_crashes(tmp_path):
    whole = arm().bytes()
    rng = np.random.default_rng(0)
    refused = []
    for _ in range(300):
        data = bytearray(whole)
        for at in rng.integers(12, len(data), rng.integers(1, 4)):
            data[at] = rng.integers(0, 256)
        try:
            load(bytes(data), tmp_path)
        except InputError as error:
            refused.append(str(error))
    assert 0 < len(refused) < 300
    assert not any("\n" in message for message in refused)
