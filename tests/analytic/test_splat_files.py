"""Files of Gaussians: written and read again, the layout byte by byte, and what is refused."""

from __future__ import annotations

import io
import json
import struct

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from tasks.errors import InputError
from tasks.export.splat_files import (
    C0,
    gaussians_ply,
    gaussians_splat,
    read_gaussians,
    rigged_ply,
    write_gaussians,
)
from tasks.geometry.gaussians import at_frame
from tasks.values import Gaussians, Poses, Reconstruction, Skeleton, Skinning


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
def test_a_ply_comes_back_as_it_was(tmp_path_factory, count, degree, isotropic, seed):
    before = some(count, degree, isotropic, seed)
    file = tmp_path_factory.mktemp("ply") / "a.ply"
    write_gaussians(before, file)
    after = read_gaussians(file)
    assert np.array_equal(after.means, before.means)
    assert np.array_equal(after.sh, before.sh)
    np.testing.assert_allclose(after.scales, before.scales, rtol=1e-5)
    np.testing.assert_allclose(after.opacities, before.opacities, atol=1e-6)
    assert (after.quaternions is None) == isotropic
    if not isotropic:
        np.testing.assert_allclose(after.quaternions, before.quaternions, atol=1e-6)


def test_another_reader_finds_the_columns_of_the_format(tmp_path):
    """Colours of degree one and up: all of red, then green, then blue."""
    gaussians = some(4, 1, False)
    write_gaussians(gaussians, tmp_path / "a.ply")
    table = trimesh.load(io.BytesIO((tmp_path / "a.ply").read_bytes()), file_type="ply", process=False)
    column = table.metadata["_ply_raw"]["vertex"]["data"]
    np.testing.assert_array_equal(column["f_rest_0"].ravel(), gaussians.sh[:, 1, 0])
    np.testing.assert_array_equal(column["f_rest_2"].ravel(), gaussians.sh[:, 3, 0])
    np.testing.assert_array_equal(column["f_rest_3"].ravel(), gaussians.sh[:, 1, 1])
    np.testing.assert_array_equal(column["rot_0"].ravel(), gaussians.quaternions[:, 0])
    np.testing.assert_allclose(np.exp(column["scale_1"].ravel()), gaussians.scales[:, 1], rtol=1e-5)
    np.testing.assert_allclose(1 / (1 + np.exp(-column["opacity"].ravel())), gaussians.opacities, atol=1e-6)


def test_a_ply_of_another_program_is_read(tmp_path):
    """Doubles, columns in another order, one too many, a second element behind."""
    names = ["opacity", "f_dc_2", "f_dc_1", "f_dc_0", "rot_3", "rot_2", "rot_1", "rot_0"]
    names += ["scale_2", "scale_1", "scale_0", "z", "y", "x"]
    header = ["ply", "format binary_little_endian 1.0", "comment of another program", "element vertex 1"]
    header += [f"property double {n}" for n in names] + ["property uchar label", "element face 0"]
    header += ["property list uchar int vertex_indices", "end_header", ""]
    values = [0.0, 0.3, 0.2, 0.1, 0, 0, 0, 2.0, 2.0, 1.0, 0.0, 3, 2, 1]
    (tmp_path / "a.ply").write_bytes("\n".join(header).encode() + struct.pack("<14dB", *values, 7))
    found = read_gaussians(tmp_path / "a.ply")
    np.testing.assert_allclose(found.means, [[1, 2, 3]])
    np.testing.assert_allclose(found.scales, np.exp([[0.0, 1, 2]]), rtol=1e-6)
    np.testing.assert_allclose(found.quaternions, [[1, 0, 0, 0]])
    np.testing.assert_allclose(found.sh, [[[0.1, 0.2, 0.3]]])
    assert found.opacities.tolist() == [0.5]


def test_certain_opacities_stay_so(tmp_path):
    before = some(2, 0, True)
    before.opacities[:] = [0, 1]
    write_gaussians(before, tmp_path / "a.ply")
    np.testing.assert_allclose(read_gaussians(tmp_path / "a.ply").opacities, [0, 1], atol=2e-6)


@pytest.mark.parametrize("isotropic", [True, False])
def test_a_splat_comes_back_to_its_bytes(tmp_path, isotropic):
    before = some(50, 2, isotropic)
    write_gaussians(before, tmp_path / "a.splat")
    assert (tmp_path / "a.splat").stat().st_size == 50 * 32
    after = read_gaussians(tmp_path / "a.splat")
    assert np.array_equal(after.means, before.means)
    assert np.array_equal(after.scales, before.scales)
    shown = np.clip(0.5 + C0 * before.sh[:, 0], 0, 1)
    np.testing.assert_allclose(0.5 + C0 * after.sh[:, 0], shown, atol=0.5 / 255 + 1e-6)
    np.testing.assert_allclose(after.opacities, before.opacities, atol=0.5 / 255 + 1e-6)
    if not isotropic:
        assert np.abs((after.quaternions * before.quaternions).sum(1)).min() > np.cos(np.deg2rad(0.6))
    write_gaussians(after, tmp_path / "b.splat")
    again = read_gaussians(tmp_path / "b.splat")
    assert np.array_equal(again.sh, after.sh)
    assert np.array_equal(again.opacities, after.opacities)


def test_a_splat_by_hand(tmp_path):
    row = struct.pack("<6f8B", 1, 2, 3, 0.1, 0.2, 0.3, 255, 0, 51, 128, 128, 0, 128, 128)
    (tmp_path / "a.splat").write_bytes(row)
    found = read_gaussians(tmp_path / "a.splat")
    np.testing.assert_allclose(found.scales, [[0.1, 0.2, 0.3]], rtol=1e-6)
    np.testing.assert_allclose(0.5 + C0 * found.sh[0, 0], [1, 0, 0.2], atol=1e-6)
    np.testing.assert_allclose(found.quaternions, [[0, -1, 0, 0]], atol=1e-6)
    assert found.opacities[0] == pytest.approx(128 / 255)


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.ply", b"", ["a.ply", "binary little-endian", "something else"]),
        ("a.ply", b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n0\n", ["ASCII"]),
        ("a.ply", b"ply\nformat binary_little_endian 1.0\nelement vertex 1\nend_header\n", ["element vertex"]),
        (
            "a.ply",
            b"ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty float x\nend_header\n\0\0\0\0",
            ["no f_dc_0"],
        ),
        ("a.splat", b"123", ["32 bytes", "3 bytes"]),
        ("a.splat", b"", ["32 bytes", "0 bytes"]),
        ("a.splat", struct.pack("<6f8B", float("nan"), *[1] * 13), ["means", "finite"]),
    ],
)
def test_wrong_files_are_one_line(tmp_path, name, content, words):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError) as error:
        read_gaussians(tmp_path / name)
    assert all(word in str(error.value) for word in words)


def test_truncated_and_missing_files_and_other_endings_are_one_line(tmp_path):
    write_gaussians(some(9, 0, True), tmp_path / "a.ply")
    (tmp_path / "a.ply").write_bytes((tmp_path / "a.ply").read_bytes()[:-1])
    with pytest.raises(InputError, match=r"expected 9 Gaussians, found 8 .*truncated"):
        read_gaussians(tmp_path / "a.ply")
    with pytest.raises(InputError, match="no such file"):
        read_gaussians(tmp_path / "b.ply")
    with pytest.raises(InputError, match=r"\.ply or \.splat"):
        write_gaussians(some(9, 0, True), tmp_path / "a.obj")


@pytest.mark.parametrize("kind", ["ply", "splat"])
def test_a_reconstruction_is_one_file_a_frame(tmp_path, kind):
    made = moving()
    brought = {"ply": gaussians_ply, "splat": gaussians_splat}[kind](made, name="thing").items()
    for path, data in brought:
        file = tmp_path / path.removeprefix("export/thing/")
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(data)
    files = sorted((tmp_path / "frames").iterdir())
    assert [f.name for f in files] == [f"{i:06d}.{kind}" for i in range(3)]
    for f, file in enumerate(files):
        found = read_gaussians(file)
        assert np.array_equal(found.means, made.points[f])
        np.testing.assert_allclose(found.scales, at_frame(made, f).scales, rtol=1e-5)
    assert np.array_equal(read_gaussians(tmp_path / f"canonical.{kind}").means, made.gaussians.means)
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
    assert np.array_equal(read_gaussians(folder / "canonical.ply").means, made.points[0])
    with np.load(folder / "rig.npz", allow_pickle=False) as rig:
        assert np.array_equal(rig["transforms"], bones)
        assert rig["joint_names"].tolist() == ["a", "b"]
    few = Skinning(made.points[0][:4], weights[:4], bones, np.zeros(0))
    with pytest.raises(ValueError, match="4 points of the rig"):
        rigged_ply(made, few, skeleton, poses, name="thing")
