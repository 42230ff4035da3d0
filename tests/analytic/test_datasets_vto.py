"""Files in the layout of VTO and DeformingThings4D, written here: what goes in comes out, and nothing else comes in."""

from __future__ import annotations

import os
import pickle
from collections import OrderedDict
from pathlib import Path

import numpy as np
import pytest
import trimesh

from tasks.datasets import anime, validate, vto
from tasks.datasets.canonical import canonical
from tasks.datasets.unpickle import read_pickle
from tasks.errors import InputError
from tasks.geometry import kinematics
from tasks.geometry.rotations import from_rotation_vector
from tasks.geometry.skinning import skin
from tasks.skeleton.given import given_poses, given_skeleton

JOINTS = np.array([[0.0, 0.1, 0.0], [0.0, 0.5, 0.0], [0.0, 0.9, 0.0]])
PARENTS = np.array([2**32 - 1, 0, 1], np.uint32)  # as SMPL writes the root's


def tube(radius: float) -> trimesh.Trimesh:
    mesh = trimesh.creation.cylinder(radius=radius, height=1.2, sections=24)
    mesh = mesh.subdivide().subdivide()
    return trimesh.Trimesh(mesh.vertices[:, [0, 2, 1]] + [0, 0.5, 0], mesh.faces[:, [0, 2, 1]], process=False)


def blend(points: np.ndarray) -> np.ndarray:
    """Weights of three joints along y."""
    share = np.clip((points[:, 1:2] - [0.4, 0.8]) / 0.2, 0, 1)
    return np.stack([1 - share[:, 0], share[:, 0] - share[:, 1], share[:, 1]], axis=1)


class Dataset:
    """A body of three joints and a tube worn over it, skinned exactly, in three sequences."""

    def __init__(self) -> None:
        self.body, self.garment = tube(0.1), tube(0.11)
        rng = np.random.default_rng(0)
        self.shape = np.array([0.5, 0.0])
        regressor = np.zeros((3, len(self.body.vertices)))
        for j, joint in enumerate(JOINTS):  # of points round the joint, the mean lies on the axis
            near = np.abs(self.body.vertices[:, 1] - joint[1])
            ring = np.isclose(near, near.min())
            regressor[j, ring] = 1 / ring.sum()
        self.joints = regressor @ self.body.vertices + [0.05, 0, 0]  # the shape's coefficient moves all by 0.05
        self.model = {
            "v_template": self.body.vertices,
            "f": self.body.faces.astype(np.uint32),
            "weights": blend(self.body.vertices),
            "kintree_table": np.stack([PARENTS, np.arange(3, dtype=np.uint32)]),
            "J_regressor": regressor,
            "shapedirs": np.tile(np.array([0.1, 0.0, 0.0])[:, None] * [1.0, 0.0], (len(self.body.vertices), 1, 1)),
        }
        self.clips = {}
        for name, frames in (("01_01", 5), ("07_02", 4)):
            turns = rng.normal(scale=0.3, size=(frames, 3, 3)) * np.linspace(0, 1, frames)[:, None, None]
            shift = rng.normal(size=(frames, 3))
            self.clips[name] = self.sequence(turns, shift)

    def sequence(self, turns: np.ndarray, shift: np.ndarray) -> dict:
        rest = self.garment.vertices + np.array([0.05, 0, 0])
        moved = np.zeros((len(turns), 3, 3))
        moved[:, 0] = shift
        transforms = kinematics.forward(np.array([-1, 0, 1]), self.joints, from_rotation_vector(turns), moved)
        return {
            "pose": turns.reshape(len(turns), -1),
            "translation": shift,
            "shape": np.tile(self.shape, (len(turns), 1)),
            "vertices": skin(rest, blend(self.garment.vertices), transforms).astype(np.float32),
            "faces": np.array(self.garment.faces, np.int32),
            "sequence": "01_01",
            "conf": OrderedDict(timestep=np.float64(0.005), wind=[0.0, 1], names=("a", None)),
        }

    def write(self, folder: Path, protocol: int = 4) -> Path:
        for name, clip in self.clips.items():
            (folder / f"tshirt_shape00_{name}.pkl").write_bytes(pickle.dumps(clip, protocol))
        return folder


@pytest.fixture
def data() -> Dataset:
    return Dataset()


def load(path, **changed):
    return vto.load(**{"path": str(path), "files": "*_shape00_*", "fps": 30.0, "up": "y"} | changed)


def rejects(call, *says: str) -> None:
    with pytest.raises(InputError) as caught:
        call()
    message = str(caught.value)
    assert "\n" not in message
    assert all(word in message for word in says), message


@pytest.mark.parametrize("protocol", [2, 3, 4, 5])
def test_sequences_are_clips(data, tmp_path, protocol):
    motion = load(data.write(tmp_path, protocol))
    assert (motion.name, motion.unit, motion.clip_names) == ("tshirt", "m", ("01_01", "07_02"))
    np.testing.assert_array_equal(motion.points, np.concatenate([c["vertices"] for c in data.clips.values()]))
    assert motion.rig is None
    assert motion.rest is None


def test_both_ways_to_write_poses_and_npz(data, tmp_path):
    np.savez(tmp_path / "smpl.npz", **data.model)
    data.write(tmp_path)
    first = load(tmp_path)
    clip = data.clips["07_02"]
    joined = {n: clip[n] for n in ("vertices", "faces")}
    joined |= {"poses": np.concatenate([clip["pose"], clip["translation"]], 1), "shapes": clip["shape"]}
    (tmp_path / "tshirt_shape00_07_02.pkl").unlink()
    np.savez(tmp_path / "tshirt_shape00_07_02.npz", **joined)
    second = load(tmp_path)
    np.testing.assert_allclose(second.rig.rotations, first.rig.rotations, atol=1e-6)
    np.testing.assert_allclose(second.rig.translations, first.rig.translations, atol=1e-6)


@pytest.mark.parametrize("up", ["y", "z"])
def test_with_the_body_model_its_skeleton_poses_the_garment(data, tmp_path, up):
    np.savez(tmp_path / "smpl.npz", **data.model)
    motion = load(data.write(tmp_path), up=up)
    assert motion.rig.names == ("joint00", "joint01", "joint02")
    assert validate.rig_error(motion) < 0.02  # weights from the body's surface, 1 cm under the cloth
    for choice in ("rest", "first"):
        shape = canonical(motion, choice=choice)
        skeleton = given_skeleton(motion, shape)
        poses = given_poses(motion, motion, shape, skeleton)
        turned = kinematics.forward(skeleton.parents, skeleton.joints, poses.rotations, poses.translations)
        error = np.linalg.norm(skin(shape.points, skeleton.weights, turned) - motion.points, axis=2)
        assert error.max() < 0.03
        assert np.median(error) < 0.002
    if up == "z":
        clip = data.clips["01_01"]["vertices"]
        np.testing.assert_allclose(motion.points[0], clip[0][:, [0, 2, 1]] * [1, 1, -1], atol=1e-6)


def test_vertices_and_faces_may_lie_beside(data, tmp_path):
    for name, clip in data.clips.items():
        bare = {n: v for n, v in clip.items() if n not in ("vertices", "faces")}
        stem = tmp_path / f"tshirt_shape00_{name}"
        stem.with_suffix(".pkl").write_bytes(pickle.dumps(bare))
        frames, points = clip["vertices"].shape[:2]
        numbers = np.array([1, points], "<i4").tobytes() + np.array([0, 1], "<f4").tobytes()
        header = b"POINTCACHE2\0" + numbers + np.array([frames], "<i4").tobytes()
        stem.with_suffix(".pc2").write_bytes(header + clip["vertices"].astype("<f4").tobytes())
    data.garment.export(tmp_path / "tshirt.obj")
    motion = load(tmp_path)
    np.testing.assert_array_equal(motion.points[:5], data.clips["01_01"]["vertices"])
    np.testing.assert_array_equal(motion.faces, data.garment.faces)
    cache = tmp_path / "tshirt_shape00_07_02.pc2"
    cache.write_bytes(cache.read_bytes()[:-4])
    rejects(lambda: load(tmp_path), "07_02.pc2", "bytes as its header says")
    cache.unlink()
    rejects(lambda: load(tmp_path), "07_02.pkl", "put tshirt_shape00_07_02.pc2 beside it")


class Evil:
    def __reduce__(self):
        return os.system, ("touch stolen",)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ({"vertices": Evil()}, ["posix.system" if os.name == "posix" else "nt.system", "numpy.savez"]),
        ({"vertices": np.array([{}, 1], object)}, ["array of Python objects", "numpy.savez"]),
        ({"conf": {"deep": [np.array([None])]}}, ["array of Python objects"]),
        ({"conf": Path("x")}, ["pathlib", "numpy.savez"]),
        (np.zeros(3), ["a dict of arrays", "ndarray"]),
    ],
)
def test_pickles_with_more_than_numbers_are_refused(tmp_path, monkeypatch, content, words):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "dress_shape00_01.pkl").write_bytes(pickle.dumps(content))
    rejects(lambda: load(tmp_path), "dress_shape00_01.pkl", *words)
    assert not (tmp_path / "stolen").exists()


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"", "an empty file"),
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\n", "git lfs pull"),
        (pickle.dumps({"vertices": np.zeros((9, 9))})[:60], "expected a pickle"),
        (b"not a pickle", "expected a pickle"),
        (b"\x80\x04cbuiltins\neval\n.", "builtins.eval, which is never loaded"),
    ],
)
def test_damaged_and_foreign_files(tmp_path, data, words):
    path = tmp_path / "a_shape00_1.pkl"
    path.write_bytes(data)
    rejects(lambda: read_pickle(path), "a_shape00_1.pkl", words)


def test_plain_content_comes_back(tmp_path):
    content = {"a": np.arange(6.0).reshape(2, 3).T, "b": np.float32(2.5), "c": [1, "x", None], "d": np.array(["t"])}
    path = tmp_path / "plain.pkl"
    for protocol in range(6):
        path.write_bytes(pickle.dumps(content, protocol))
        got = read_pickle(path)
        np.testing.assert_array_equal(got["a"], content["a"])
        assert (got["b"], got["c"], got["d"].tolist()) == (content["b"], content["c"], ["t"])


def test_what_does_not_fit_together(data, tmp_path):
    data.write(tmp_path)
    rejects(lambda: load(tmp_path, files="dress*"), "sequences called dress*", "tshirt_shape00_01_01")
    rejects(lambda: load(tmp_path / "nowhere"), "no such file or folder")
    np.savez(tmp_path / "smpl.npz", **data.model | {"kintree_table": data.model["kintree_table"][:, :2]})
    rejects(lambda: load(tmp_path), "smpl.npz: weights")
    np.savez(tmp_path / "smpl.npz", **{n: a for n, a in data.model.items() if n != "J_regressor"})
    rejects(lambda: load(tmp_path), "smpl.npz", "add J_regressor")
    np.savez(tmp_path / "smpl.npz", **data.model)
    clip = data.clips["07_02"]
    path = tmp_path / "tshirt_shape00_07_02.pkl"
    for change, words in (
        ({"shape": clip["shape"] + 1}, ("shape", "another", "one body at a time")),
        ({"pose": clip["pose"][:, :6]}, ("pose", "each of the 3 joints")),
        ({"pose": clip["pose"][1:]}, ("pose", "for 4 frames")),
        ({"faces": clip["faces"][1:]}, ("faces", "one garment at a time")),
        ({"pose": None, "translation": None}, ("pose", "take smpl.npz away")),
    ):
        path.write_bytes(pickle.dumps({n: v for n, v in (clip | change).items() if v is not None}))
        rejects(lambda: load(tmp_path), "07_02.pkl", *words)


def anime_bytes(points: np.ndarray, faces: np.ndarray) -> bytes:
    head = np.array([len(points), points.shape[1], len(faces)], "<i4").tobytes()
    first, offsets = points[0].astype("<f4"), (points[1:] - points[0]).astype("<f4")
    return head + first.tobytes() + faces.astype("<i4").tobytes() + offsets.tobytes()


def load_anime(path, **changed):
    return anime.load(**{"path": str(path), "files": "*", "fps": 24.0, "up": "z"} | changed)


def test_anime(tmp_path):
    rng = np.random.default_rng(1)
    faces = np.array([[0, 1, 2], [1, 2, 3], [2, 3, 4]])
    clips = {name: rng.normal(size=(frames, 5, 3)) for name, frames in (("bear_run", 6), ("bear_walk", 3))}
    for name, points in clips.items():
        (tmp_path / name).mkdir()
        (tmp_path / name / f"{name}.anime").write_bytes(anime_bytes(points, faces))
    one = load_anime(tmp_path / "bear_run" / "bear_run.anime", up="y")
    np.testing.assert_allclose(one.points, clips["bear_run"], atol=1e-6)
    np.testing.assert_array_equal(one.faces, faces)
    both = load_anime(tmp_path)
    assert (both.name, both.clip_names) == ("bear", ("bear_run", "bear_walk"))
    np.testing.assert_allclose(both.points[6:], clips["bear_walk"][..., [0, 2, 1]] * [1, 1, -1], atol=1e-6)
    assert load_anime(tmp_path, files="*_walk").frames == 3
    rejects(lambda: load_anime(tmp_path, files="cat*"), "no cat*.anime")
    odd = tmp_path / "bear_run" / "bear_odd.anime"
    odd.write_bytes(anime_bytes(clips["bear_run"], faces[:2]))
    rejects(lambda: load_anime(tmp_path), "bear_run", "the mesh of bear_odd.anime")
    whole = anime_bytes(clips["bear_run"], faces)
    for broken in (whole[:-4], whole[:7], whole + b"\0\0\0\0", b"\xff" * 60):
        odd.write_bytes(broken)
        rejects(lambda: load_anime(odd), "bear_odd.anime", "as its header says")
