"""Making the dataset again: the recipe fits the functions, the patterns come out as shipped, cloth lies on a ball.

What needs the extra `garments` is skipped without it; Anny is never started here: its first start takes minutes.
"""

from __future__ import annotations

import inspect
from pathlib import Path

import numpy as np
import pytest
import trimesh
import yaml

from tasks.datasets import garments
from tasks.garments import body, check, pack, pattern, retarget, simulate
from tasks.geometry.neighbours import mesh_edges
from tasks.values import Canonical, Motion, Poses, Rig

FOLDER = Path(garments.REPOSITORY) / "data" / "garments"
RECIPE = yaml.safe_load((FOLDER / "recipe.yaml").read_text())


@pytest.mark.parametrize(
    ("function", "settings"),
    [
        (body.anny_body, RECIPE["body"]),
        *((pattern.cut, settings) for settings in RECIPE["cut"].values()),
        (retarget.dressing, RECIPE["dressing"] | {"start": None}),
        *((retarget.motion_clip, RECIPE["motion"] | settings) for settings in RECIPE["clips"].values()),
        (simulate.simulate, RECIPE["simulate"] | {"first": 0}),
        (pack.garment_arrays, RECIPE["pack"]),
    ],
)
def test_recipe_is_the_keywords_of_its_functions(function, settings):
    keywords = [p for p in inspect.signature(function).parameters.values() if p.kind is p.KEYWORD_ONLY]
    assert set(settings) == {p.name for p in keywords}
    for keyword in keywords:
        if keyword.annotation in ("int", "float", "str"):
            assert type(settings[keyword.name]).__name__ == keyword.annotation, keyword.name


def test_shipped_clips_are_the_recipes():
    for kind in ("tshirt", "dress"):
        motion = garments.load(garment=kind, path="data/garments", weights="nearest")
        assert set(motion.clip_names) == set(RECIPE["clips"])


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["tshirt", "dress"])
def test_pattern_comes_out_as_shipped(kind):
    wearer = garments.read_body(FOLDER / "body.npz")
    cut = pattern.cut(wearer, **RECIPE["cut"][kind])
    with np.load(FOLDER / f"{kind}.npz", allow_pickle=False) as archive:
        shipped = archive["rest"]
    assert len(cut.points) == pytest.approx(len(shipped), rel=0.03)
    distance = np.abs(check.depth_in(cut.points, cut.faces, shipped))  # unsigned: the garment is open
    assert np.percentile(distance, 99) < 0.004
    mesh = trimesh.Trimesh(cut.points, cut.faces, process=False)
    assert mesh.is_winding_consistent
    assert mesh.euler_number == -2  # a ball with four openings: hem, neck, two arms
    assert len(mesh.split(only_watertight=False)) == 1
    assert np.degrees(mesh.face_angles.min()) > 12
    length = np.linalg.norm(np.diff(cut.points[mesh_edges(cut.faces)], axis=1), axis=2)
    assert np.median(length) == pytest.approx(RECIPE["cut"][kind]["edge"], rel=0.1)
    assert check.depth_in(wearer.points[0], wearer.faces, cut.points).max() < -0.004


@pytest.mark.parametrize("name", list(RECIPE["clips"]))
def test_clips_are_motions_of_a_body(name):
    """Feet stay near the ground on average, nothing jumps, and the lead-in starts from standing."""
    pytest.importorskip("pybullet_data")
    wearer = garments.read_body(FOLDER / "body.npz")
    poses = retarget.motion_clip(wearer, **RECIPE["motion"] | RECIPE["clips"][name])
    few = Poses(poses.rotations[::5], poses.translations[::5], poses.clip_start)
    lowest = simulate.body_points(wearer, few)[..., 1].min(1)
    assert abs(np.median(lowest)) < 0.12
    assert poses.clip_start[1] >= 15
    step = np.abs(np.diff(poses.translations[:, 0], axis=0)).max() * RECIPE["motion"]["fps"]
    assert step < 6


@pytest.fixture
def ball() -> Motion:
    shape = trimesh.creation.icosphere(subdivisions=4, radius=0.3)
    names = ("Hips", "LeftHand", "RightHand")
    weights = np.zeros((len(shape.vertices), 3), np.float32)
    weights[:, 0] = 1
    still = np.tile(np.eye(3, dtype=np.float32), (1, 3, 1, 1))
    zero = np.zeros((1, 3, 3), np.float32)
    rig = Rig(names, np.array([-1, 0, 0], np.int32), zero[0], weights, still, zero)
    vertices = shape.vertices.astype(np.float32)
    return Motion(
        "ball", vertices[None], shape.faces.astype(np.int32), np.array([0, 1]), ("a",), 30.0, "m", vertices, rig
    )


@pytest.mark.slow
def test_cloth_lies_on_a_moving_ball(ball):
    pytest.importorskip("newton")
    x, z = np.meshgrid(np.linspace(-0.25, 0.25, 21), np.linspace(-0.25, 0.25, 21), indexing="ij")
    points = np.stack([x, np.full_like(x, 0.31), z], -1).reshape(-1, 3).astype(np.float32)
    corner = (np.arange(20)[:, None] * 21 + np.arange(20)).ravel()
    faces = (corner[:, None, None] + np.array([[0, 1, 22], [0, 22, 21]])).reshape(-1, 3).astype(np.int32)
    cloth = Canonical(points, faces, -1, "sheet")
    frames = 16
    shift = np.zeros((frames, 3, 3), np.float32)
    shift[:, 0, 0] = 0.01 * np.arange(frames)  # 0.3 m/s
    poses = Poses(np.tile(np.eye(3, dtype=np.float32), (frames, 3, 1, 1)), shift, np.array([0, frames]))
    settings = RECIPE["simulate"] | {"substeps": 12}
    states = list(simulate.simulate(ball, cloth, poses, None, first=0, **settings))
    assert len(states) == frames
    np.testing.assert_array_equal(states[0].points, points)
    moved = np.stack([state.points for state in states])
    found = check.quality(ball, poses, moved, points, faces, fps=30.0, every=1)
    assert (found.depth > 0.002).mean() < 0.005
    assert np.percentile(np.abs(found.strain), 99) < 0.15
    centre = moved[:, 220]
    assert 0.29 < centre[-1, 1] < 0.32  # it lies on top
    assert centre[-1, 0] > 0.05  # friction takes it along, half of the way at least
    assert moved[-1, :, 1].min() < 0.25  # and its corners hang
    chunk, last = simulate.simulate_chunk(ball, cloth, poses, states[7], first=8, count=8, **settings)
    np.testing.assert_allclose(last.points, states[-1].points, atol=1e-5)  # stopped and gone on: the same cloth
    assert chunk.frames == 8
