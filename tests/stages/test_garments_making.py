"""Making the dataset again: the recipe fits the functions, the patterns come out as shipped, cloth lies on a ball.

What needs the extra `garments` is skipped without it; Anny is never started here: its first start takes minutes.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh

from flows import config
from flows.exhibits import plan_files, plan_pictures
from flows.graph import Graph
from flows.pipeline import plan
from tasks.datasets import garments
from tasks.errors import InputError
from tasks.garments import body, check, manifest, pack, pattern, retarget, simulate
from tasks.geometry.neighbours import mesh_edges
from tasks.values import Canonical, Cloth, Motion, Poses, Rig
from tasks.workspace import Workspace

FOLDER = Path(garments.REPOSITORY) / "data" / "garments"
CASES = config.expand(["+experiment=make_garments"])
RECIPE = CASES[0].config["make"]
MOTION = RECIPE["motion"] | {"fps": RECIPE["fps"], "frames": None}
PHYSICS = RECIPE["simulate"] | {"fps": RECIPE["fps"]}


def planned(*overrides: str) -> tuple[Graph, list]:
    graph = Graph()
    return graph, [plan(case, graph) for case in config.expand(["+experiment=make_garments", *overrides])]


def test_two_garments_share_body_and_motions_and_are_one_simulation_a_clip():
    graph, cases = planned("make.only=[walk,kick]")
    files, pictures = plan_files(cases, graph), plan_pictures(cases, graph)
    stages = [node.stage for node in graph.nodes.values()]
    counts = {stage: stages.count(stage) for stage in dict.fromkeys(stages)}
    assert counts == {
        **{"body": 1, "cutting": 1, "motion": 3, "pattern": 2},
        **{"simulate": 6, "pack": 3, "check": 2, "figures": 2, "manifest": 1},
    }
    assert len(files) == 4
    assert len(pictures) == 2
    walk = next(n for n in graph.nodes.values() if n.stage == "motion" and n.settings.get("clip") == "walk")
    assert walk.settings == MOTION | RECIPE["clips"]["walk"]


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("make.only=[wlak]", ["make.only", "walk, run", "wlak"]),
        ("dataset=creature_animal", ["garments_tshirt or garments_dress", "creature"]),
    ],
)
def test_what_cannot_be_made_is_one_line(override, words):
    with pytest.raises(InputError) as caught:
        planned(override)
    assert all(word in str(caught.value) for word in words), caught.value


def test_without_the_extra_it_says_how_to_install_it(monkeypatch):
    monkeypatch.setattr(body, "find_spec", lambda name: None if name == "newton" else object())
    with pytest.raises(InputError, match=r"found no module newton; python -m pip install .*\[garments\]"):
        body.anny_body(**RECIPE["body"])


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
    poses = retarget.motion_clip(wearer, **MOTION | RECIPE["clips"][name])
    few = Poses(poses.rotations[::5], poses.translations[::5], poses.clip_start)
    lowest = simulate.body_points(wearer, few)[..., 1].min(1)
    assert abs(np.median(lowest)) < 0.12
    assert poses.clip_start[1] >= 15
    step = np.abs(np.diff(poses.translations[:, 0], axis=0)).max() * RECIPE["fps"]
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


def sliding(frames: int, clip_start: list[int]) -> Poses:
    """The ball moves along x at 0.3 m/s."""
    shift = np.zeros((frames, 3, 3), np.float32)
    shift[:, 0, 0] = 0.01 * np.arange(frames)
    return Poses(np.tile(np.eye(3, dtype=np.float32), (frames, 3, 1, 1)), shift, np.array(clip_start))


@pytest.fixture
def sheet() -> Canonical:
    x, z = np.meshgrid(np.linspace(-0.25, 0.25, 21), np.linspace(-0.25, 0.25, 21), indexing="ij")
    points = np.stack([x, np.full_like(x, 0.31), z], -1).reshape(-1, 3).astype(np.float32)
    corner = (np.arange(20)[:, None] * 21 + np.arange(20)).ravel()
    faces = (corner[:, None, None] + np.array([[0, 1, 22], [0, 22, 21]])).reshape(-1, 3).astype(np.int32)
    return Canonical(points, faces, -1, "sheet cut from nothing")


@pytest.mark.slow
def test_cloth_lies_on_a_moving_ball(ball, sheet, tmp_path):
    pytest.importorskip("newton")
    cloth = sheet
    points, faces = sheet.points, sheet.faces
    frames, poses = 16, sliding(16, [0, 16])
    settings = PHYSICS | {"substeps": 12}
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
    for frame in range(8):
        simulate._keep(tmp_path, frame, states[frame])
    resumed, last = simulate.simulate_frames(ball, cloth, poses, **settings, workspace=Workspace(tmp_path))
    np.testing.assert_allclose(last.points, states[-1].points, atol=1e-5)  # stopped and gone on: the same cloth
    assert resumed.frames == frames


class Killed(Exception):
    """Stands in for kill -9."""


@pytest.mark.parametrize("settled", [True, False])
def test_a_killed_simulation_goes_on_frame_by_frame(ball, sheet, tmp_path, monkeypatch, settled):
    poses = sliding(12, [0, 4, 12])
    done = []

    def falling(body, garment, poses, cloth, *, first, **settings):
        if cloth is None:
            cloth, first = Cloth(garment.points, np.zeros_like(garment.points)), 1
            yield cloth
        for frame in range(first, len(poses.rotations)):
            done.append(frame)
            cloth = Cloth(cloth.points - np.float32(0.01), cloth.velocities)
            yield cloth

    def tell(text, fraction):
        if done[-1:] == [7] and len(done) == 7:
            raise Killed

    monkeypatch.setattr(simulate, "simulate", falling)
    state = Cloth(sheet.points, np.zeros_like(sheet.points)) if settled else None
    workspace = Workspace(tmp_path, tell)
    with pytest.raises(Killed):
        simulate.simulate_frames(ball, sheet, poses, state, **PHYSICS, workspace=workspace)
    (tmp_path / "draft.npy").write_bytes(b"cut short")
    cloth, last = simulate.simulate_frames(ball, sheet, poses, state, **PHYSICS, workspace=workspace)
    assert done == list(range(1, 12))  # no frame twice
    assert cloth.frames == 8  # the lead-in is no data
    np.testing.assert_allclose(last.points, sheet.points - 0.11, atol=1e-5)
    np.testing.assert_array_equal(cloth.points[-1], last.points)


def test_packed_files_are_measured_and_described(ball, sheet, tmp_path, monkeypatch):
    """From simulated clips to files that the loader reads, with numbers that say what is wrong with them."""
    names = ("Hips", "LeftHand", "RightHand")
    assert ball.rig.names == names
    poses = {name: sliding(6, [0, 2, 6]) for name in ("a", "b")}
    shift = poses["a"].translations[2:, 0]
    points = sheet.points + shift[:, None]
    cloth = {
        n: Motion("tshirt", points.copy(), sheet.faces, np.array([0, 4]), (n,), 30.0, "m", sheet.points) for n in poses
    }
    cloth["b"].points[-1, 7] += 2.0  # a vertex that flies off
    still = Poses(poses["a"].rotations[:1], poses["a"].translations[:1], np.array([0, 1]))
    garment = Canonical(sheet.points, sheet.faces, -1, "tshirt cut from ball")
    packed = pack.pack_garment(ball, garment, poses, cloth, step=2e-4, clips=["b", "a"])
    wearer = pack.pack_body(ball, still)
    metrics, facts, about = manifest.check_garment(wearer, packed, every=1, workspace=Workspace(tmp_path))
    numbers = dict(zip(metrics.names, metrics.values, strict=True))
    assert numbers["frames_count"] == 8
    assert numbers["deep_pct"] == 0
    assert numbers["speed_max@b"] == pytest.approx(1000 * 30 * 2 * np.sqrt(3), rel=0.02)
    assert numbers["speed_max@a"] == pytest.approx(300, rel=0.05)
    assert about.notes[0].startswith("clip b explodes")
    (tmp_path / "sub").mkdir()
    for path, data in (*wearer.items(), *packed.items()):
        (tmp_path / "sub" / Path(path).name).write_bytes(data)
    read = garments.load(garment="tshirt", path=str(tmp_path / "sub"), weights="nearest")
    assert read.clip_names == ("b", "a")
    assert np.abs(read.points - np.concatenate([cloth["b"].points, points])).max() < 1.1e-4
    stated = manifest.manifest({"body": wearer, "tshirt": packed}, {"tshirt": facts}, every=1)
    text = json.loads(stated.items()[0][1])
    assert text["files"]["tshirt.npz"] == manifest.facts_of(packed.items()[0][1])
    assert text["garments"]["tshirt"]["clips"].keys() == {"a", "b"}
