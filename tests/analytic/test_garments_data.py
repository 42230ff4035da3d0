"""The garments that lie in data/: what the manifest says of them is recomputed from the files."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from tasks.datasets import garments
from tasks.datasets.split import split
from tasks.errors import InputError
from tasks.garments import check, manifest
from tasks.geometry import kinematics
from tasks.geometry.measure import vertex_rmse
from tasks.geometry.skinning import skin
from tasks.values import Poses

FOLDER = Path(garments.REPOSITORY) / "data" / "garments"
TEST_CLIPS = ["dance_b", "kick", "spin"]
KINDS = ("tshirt", "dress")


@pytest.fixture(scope="module")
def stated() -> dict:
    return json.loads((FOLDER / "manifest.json").read_text())


@pytest.fixture(scope="module")
def motions() -> dict:
    return {kind: garments.load(garment=kind, path="data/garments", weights="robust") for kind in KINDS}


def test_files_are_the_ones_described(stated):
    for name, facts in stated["files"].items():
        assert manifest.facts_of((FOLDER / name).read_bytes()) == facts
    assert sum(facts["bytes"] for facts in stated["files"].values()) < 20e6


@pytest.mark.parametrize("kind", KINDS)
def test_motion(motions, stated, kind):
    motion = motions[kind]
    assert motion.frames >= 1200
    assert (motion.frames, motion.points.shape[1]) == (
        stated["garments"][kind]["frames"],
        stated["garments"][kind]["vertices"],
    )
    assert motion.unit == "m"
    assert np.isfinite(motion.points).all()
    assert len(set(motion.clip_names)) >= 12
    rig = motion.rig
    assert 20 <= len(rig.names) <= 24
    assert (np.asarray(rig.parents) < 0).sum() == 1
    np.testing.assert_allclose(rig.weights.sum(1), 1, atol=1e-5)
    assert rig.weights.min() >= 0
    identity = rig.rotations @ np.swapaxes(rig.rotations, -1, -2)
    np.testing.assert_allclose(identity, np.broadcast_to(np.eye(3), identity.shape), atol=1e-5)


@pytest.mark.parametrize("kind", KINDS)
def test_split_by_motion(motions, kind):
    train, test = split(motions[kind], by="clips", test=TEST_CLIPS, fraction=0.2, observed=1.0, frames=None)
    assert test.clip_names == tuple(name for name in motions[kind].clip_names if name in TEST_CLIPS)
    assert train.frames + test.frames == motions[kind].frames  # no test frame repeats a training frame
    assert train.frames >= 1000
    assert not set(train.clip_names) & set(TEST_CLIPS)


@pytest.mark.parametrize("kind", KINDS)
def test_strain_and_speed(motions, stated, kind):
    motion = motions[kind]
    strain = check.strain(motion.points, motion.rest, motion.faces)
    p99 = np.percentile(np.abs(strain), 99)
    assert p99 == pytest.approx(stated["garments"][kind]["strain_abs_p99"], abs=2e-4)
    assert p99 < 0.15
    for name, frames in zip(motion.clip_names, motion.clips(), strict=True):
        speed = np.linalg.norm(np.diff(motion.points[frames], axis=0), axis=2).max() * motion.fps
        assert speed == pytest.approx(stated["garments"][kind]["clips"][name]["speed_max"], rel=1e-3)
        assert speed < 25  # nothing explodes: the feet of the spin kick reach 13 m/s


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_cloth_stays_out_of_the_body(motions, kind):
    """On every 40th frame; the manifest says it of many more."""
    motion, body = motions[kind], garments.read_body(FOLDER / "body.npz")
    poses = garments.read_poses(FOLDER / f"{kind}.npz")
    some = slice(20, None, 40)
    at = Poses(poses.rotations[some], poses.translations[some], poses.clip_start)
    found = check.quality(body, at, motion.points[some], motion.rest, motion.faces, fps=1.0, every=1)
    assert (found.depth > 0.002).mean() < 0.005


@pytest.mark.parametrize("kind", KINDS)
def test_skeleton_belongs_to_the_cloth(motions, kind):
    """LBS explains most of where the cloth is: with the poses of another frame it does not."""
    motion = motions[kind]
    rig, some = motion.rig, np.arange(0, motion.frames, 25)
    posed = kinematics.forward(rig.parents, rig.joints, rig.rotations[some], rig.translations[some])
    error = vertex_rmse(skin(motion.rest, rig.weights, posed), motion.points[some])
    wrong = vertex_rmse(skin(motion.rest, rig.weights, np.roll(posed, 1, axis=0)), motion.points[some])
    assert error < 0.2
    assert error < 0.3 * wrong


def test_bad_input(tmp_path):
    with pytest.raises(InputError, match="no such file or folder"):
        garments.load(garment="dress", path=str(tmp_path / "nowhere"), weights="robust")
    with pytest.raises(InputError, match="a garment's file"):
        garments.load(garment="dress", path=str(tmp_path), weights="robust")
    (tmp_path / "body.npz").write_bytes((FOLDER / "body.npz").read_bytes())
    (tmp_path / "dress.npz").write_bytes((FOLDER / "dress.npz").read_bytes()[:100_000])
    with pytest.raises(InputError, match=r"dress\.npz"):
        garments.load(garment="dress", path=str(tmp_path), weights="robust")
    with np.load(FOLDER / "dress.npz", allow_pickle=False) as archive:
        arrays = dict(archive)
    np.savez(tmp_path / "dress.npz", **arrays | {"joint_turns": arrays["joint_turns"][:, 1:]})
    with pytest.raises(InputError, match="22 turns"):
        garments.load(garment="dress", path=str(tmp_path), weights="robust")
