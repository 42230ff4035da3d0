"""Files of Gaussians: written and read again, and the layout byte by byte."""

from __future__ import annotations

import io
import json
import struct

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from tasks.export.splat_files import (
    C0,
    WRITERS,
    gaussians_ply,
    gaussians_splat,
    rigged_ply,
)
from tasks.geometry.gaussians import at_frame
from tasks.values import Gaussians, Poses, Reconstruction, Skeleton, Skinning
from tests.analytic.splats import read_ply, read_splat


def some(count: int, degree: int, isotropic: bool, seed: int = 0) -> Gaussians:
    random = np.random.default_rng(seed)
    turns = random.normal(size=(count, 4))
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    return Gaussians(
        means=random.normal(size=(count, 3)).astype(np.float32),
        scales=np.exp(random.normal(-3, 1, (count, 1 if isotropic else 3))).astype(np.float32),
        quaternions=None if isotropic else turns.astype(np.float32),
        opacities=random.uniform(0.01, 0.99, count).astype(np.float32),
        sh=random.normal(0, 0.3, (count, (degree + 1) ** 2, 3)).astype(np.float32),
    )


def moving(frames: int = 3) -> Reconstruction:
    gaussians = some(5, 0, True)
    random = np.random.default_rng(1)
    return Reconstruction(
        name="thing",
        gaussians=gaussians,
        points=(gaussians.means + random.normal(0, 0.1, (frames, 5, 3))).astype(np.float32),
        rotations=None,
        scaling=random.uniform(0.5, 2, (frames, 5)).astype(np.float32),
        opacity=None,
        times=np.linspace(0, 1, frames).astype(np.float32),
        fps=24.0,
        clip_start=np.array([0, 2, frames]),
        clip_names=("one", "two"),
        unit="m",
        rig=None,
        history=np.zeros((0, 3)),
    )


@settings(max_examples=20, deadline=None)
@given(st.integers(1, 20), st.integers(0, 3), st.booleans(), st.integers(0, 99))
def test_a_ply_comes_back_as_it_was(count, degree, isotropic, seed):
    before = some(count, degree, isotropic, seed)
    after = read_ply(WRITERS["ply"](before))
    assert np.array_equal(after.means, before.means)
    assert np.array_equal(after.sh, before.sh)
    np.testing.assert_allclose(after.scales, np.broadcast_to(before.scales, (count, 3)), rtol=1e-5)
    np.testing.assert_allclose(after.opacities, before.opacities, atol=1e-6)
    np.testing.assert_allclose(after.quaternions, [[1, 0, 0, 0]] * count if isotropic else before.quaternions)


def test_another_reader_finds_the_columns_of_the_format():
    """Colours of degree one and up: all of red, then green, then blue."""
    gaussians = some(4, 1, False)
    table = trimesh.load(io.BytesIO(WRITERS["ply"](gaussians)), file_type="ply", process=False)
    column = table.metadata["_ply_raw"]["vertex"]["data"]
    np.testing.assert_array_equal(column["f_rest_0"].ravel(), gaussians.sh[:, 1, 0])
    np.testing.assert_array_equal(column["f_rest_2"].ravel(), gaussians.sh[:, 3, 0])
    np.testing.assert_array_equal(column["f_rest_3"].ravel(), gaussians.sh[:, 1, 1])
    np.testing.assert_array_equal(column["rot_0"].ravel(), gaussians.quaternions[:, 0])
    np.testing.assert_allclose(np.exp(column["scale_1"].ravel()), gaussians.scales[:, 1], rtol=1e-5)
    np.testing.assert_allclose(1 / (1 + np.exp(-column["opacity"].ravel())), gaussians.opacities, atol=1e-6)


def test_certain_opacities_stay_so():
    before = some(2, 0, True)
    before.opacities[:] = [0, 1]
    np.testing.assert_allclose(read_ply(WRITERS["ply"](before)).opacities, [0, 1], atol=2e-6)


@pytest.mark.parametrize("isotropic", [True, False])
def test_a_splat_comes_back_to_its_bytes(isotropic):
    before = some(50, 2, isotropic)
    data = WRITERS["splat"](before)
    after = read_splat(data)
    assert np.array_equal(after.means, before.means)
    assert np.array_equal(after.scales, np.broadcast_to(before.scales, (50, 3)))
    shown = np.clip(0.5 + C0 * before.sh[:, 0], 0, 1)
    np.testing.assert_allclose(0.5 + C0 * after.sh[:, 0], shown, atol=0.5 / 255 + 1e-6)
    np.testing.assert_allclose(after.opacities, before.opacities, atol=0.5 / 255 + 1e-6)
    turns = np.tile([1, 0, 0, 0], (50, 1)) if isotropic else before.quaternions
    assert np.abs((after.quaternions * turns).sum(1)).min() > np.cos(np.deg2rad(0.6))
    again = read_splat(WRITERS["splat"](after))
    assert np.array_equal(again.sh, after.sh)
    assert np.array_equal(again.opacities, after.opacities)


def test_a_splat_by_hand():
    one = Gaussians(
        means=np.array([[1, 2, 3]], np.float32),
        scales=np.array([[0.1, 0.2, 0.3]], np.float32),
        quaternions=np.array([[0, -2, 0, 0]], np.float32),  # of any length
        opacities=np.array([0.5], np.float32),
        sh=np.array([[[0.5, -0.5, -0.3]]], np.float32) / np.float32(C0),
    )
    expected = struct.pack("<6f8B", 1, 2, 3, 0.1, 0.2, 0.3, 255, 0, 51, 128, 128, 0, 128, 128)
    assert WRITERS["splat"](one) == expected


@pytest.mark.parametrize("kind", ["ply", "splat"])
def test_a_reconstruction_is_one_file_a_frame(tmp_path, kind):
    made = moving()
    read = {"ply": read_ply, "splat": read_splat}[kind]
    brought = {"ply": gaussians_ply, "splat": gaussians_splat}[kind](made, name="thing").items()
    for path, data in brought:
        file = tmp_path / path.removeprefix("export/thing/")
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(data)
    files = sorted((tmp_path / "frames").iterdir())
    assert [f.name for f in files] == [f"{i:06d}.{kind}" for i in range(3)]
    for f, file in enumerate(files):
        found = read(file.read_bytes())
        assert np.array_equal(found.means, made.points[f])
        np.testing.assert_allclose(found.scales, np.repeat(at_frame(made, f).scales, 3, axis=1), rtol=1e-5)
    assert np.array_equal(read((tmp_path / f"canonical.{kind}").read_bytes()).means, made.gaussians.means)
    about = json.loads((tmp_path / "motion.json").read_text())
    assert about["clips"] == [{"name": "one", "start": 0}, {"name": "two", "start": 2}]
    assert about["times"] == [0, 0.5, 1]


def test_a_rig_goes_with_its_gaussians(tmp_path):
    made = moving()
    weights = np.full((5, 2), 0.5, np.float32)
    bones = np.zeros((3, 2, 3, 4), np.float32)
    skinning = Skinning(made.points[0], weights, bones, np.zeros(0))
    skeleton = Skeleton(("a", "b"), np.array([-1, 0]), np.zeros((2, 3)), weights)
    poses = Poses(np.zeros((3, 2, 3, 3)), np.zeros((3, 2, 3)), made.clip_start)
    for path, data in rigged_ply(made, skinning, skeleton, poses, name="thing").items():
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / path).write_bytes(data)
    folder = tmp_path / "export" / "thing"
    assert np.array_equal(read_ply((folder / "rigged.ply").read_bytes()).means, made.points[0])
    with np.load(folder / "rig.npz", allow_pickle=False) as rig:
        assert np.array_equal(rig["transforms"], bones)
        assert rig["joint_names"].tolist() == ["a", "b"]
    assert not (folder / "canonical.ply").exists()  # where the Gaussians' own rest lies: both may be asked for
    few = Skinning(made.points[0][:4], weights[:4], bones, np.zeros(0))
    with pytest.raises(ValueError, match="4 points of the rig"):
        rigged_ply(made, few, skeleton, poses, name="thing")
