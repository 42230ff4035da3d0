"""Simulated cloth: what falls, hangs, rests and is dragged along, the body that frames outline, and the method."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tasks.errors import InputError
from tasks.geometry import rigid
from tasks.geometry.measure import diagonal, vertex_rmse
from tasks.geometry.rotations import from_rotation_vector
from tasks.geometry.skinning import skin
from tasks.methods import part_cloth, part_kernel, partmm, partmm_cloth
from tasks.motion import foretold, hung, kernel
from tasks.motion.cloth import Fabric, fabric, simulate
from tasks.motion.database import build_database
from tasks.motion.outline import ALONG, AROUND, BIN, Outline, find_outline
from tasks.motion.parts import find_parts
from tasks.motion.posed import Posed
from tasks.values import Canonical, Motion, Poses, Skeleton, Skinning, Training
from tests.analytic import planted
from tests.analytic.test_units import moved, shifted

FPS, STEPS = 30.0, 20
NOBODY = Outline(np.zeros(0, int), np.zeros((0, 4, 3)), np.zeros(0), np.zeros((0, ALONG, AROUND)))
# a bone of a metre along x, as thick as 0.1 m
BAR = Outline(
    np.zeros(1, int),
    np.array([[[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]], float),
    np.ones(1),
    np.full((1, ALONG, AROUND), 0.1),
)
REGRESSION = {"dynamics": 0.5, "reach": 4, "width": 1.0, "ridge": 0.03, "landmarks": 1000, "mirror": False}
CLOTH = {"pull": 16.0, "substeps": STEPS, "density": 0.2, "stretch": 1e4, "drag": 0.5, "friction": 0.8}


def points_apart(count: int, drag: float = 0.0, friction: float = 0.0) -> Fabric:
    return Fabric(np.zeros((0, 2), np.int64), np.zeros(0), np.ones(count), 1e4, drag, friction)


def standing(frames: int) -> np.ndarray:
    return rigid.identity(frames, 1, dtype=np.float64)


def run(cloth: Fabric, body: Outline, world: np.ndarray, target: np.ndarray, pull: np.ndarray) -> np.ndarray:
    start = np.array([0, len(target)])
    return simulate(cloth, body, world, target, pull, start, fps=FPS, substeps=STEPS)


def test_what_nothing_holds_falls_and_air_slows_it():
    target, frames = np.zeros((31, 1, 3)), 31
    made = run(points_apart(1), NOBODY, standing(frames), target, np.zeros((frames, 1)))
    steps, step = np.arange(frames) * STEPS, 1.0 / (FPS * STEPS)
    np.testing.assert_allclose(made[:, 0, 1], -9.81 * step**2 * steps * (steps + 1) / 2, atol=1e-9)
    made = run(points_apart(1, drag=20.0), NOBODY, standing(frames), target, np.zeros((frames, 1)))
    assert -np.diff(made[-2:, 0, 1])[0] * FPS == pytest.approx(9.81 / 20.0, rel=0.03)


def test_a_thread_stretches_by_what_hangs_on_it():
    thread = Fabric(np.array([[0, 1]]), np.array([0.5]), np.array([1.0, 0.2]), 50.0, 5.0, 0.0)
    target = np.tile(np.array([[0.0, 1.0, 0.0], [0.0, 0.5, 0.0]]), (150, 1, 1))
    pull = np.tile([1e4, 0.0], (150, 1))
    made = run(thread, NOBODY, standing(150), target, pull)
    assert made[-1, 0, 1] == pytest.approx(1.0, abs=1e-3)
    assert made[-1, 0, 1] - made[-1, 1, 1] == pytest.approx(0.5 + 0.2 * 9.81 / 50.0, abs=2e-3)


def test_a_point_that_is_drawn_sags_by_gravity_over_the_square_of_the_pull():
    target = np.zeros((200, 1, 3))
    made = run(points_apart(1, drag=5.0), NOBODY, standing(200), target, np.full((200, 1), 10.0))
    assert made[-1, 0, 1] == pytest.approx(-9.81 / 10.0**2, rel=0.02)


@pytest.mark.parametrize(("friction", "goes"), [(0.0, 0.0), (5.0, 1.0)])
def test_skin_keeps_points_out_and_drags_them_along_by_friction(friction, goes):
    frames = 60
    world = standing(frames)
    world[:, 0, 0, 3] = 0.2 * (np.arange(frames) / frames) ** 2  # the bar goes along its own axis
    target = np.tile(np.array([[0.5, 0.1, 0.0]]), (frames, 1, 1))
    made = run(points_apart(1, friction=friction), BAR, world, target, np.zeros((frames, 1)))
    np.testing.assert_allclose(made[:, 0, 1], 0.1, atol=1e-4)
    assert made[-1, 0, 0] - 0.5 == pytest.approx(goes * world[-1, 0, 0, 3], abs=0.01)


def test_frames_outline_the_body():
    """Cloth that now touches a tapering bone of two joints, now hangs away from it."""
    rng = np.random.default_rng(0)
    tree = Skeleton(
        ("a", "b"), np.array([-1, 0], np.int32), np.array([[0, 0, 0], [0, -1, 0]], np.float32), np.ones((1, 2))
    )
    turns = from_rotation_vector(rng.normal(0, 0.5, (200, 3)))
    world = np.stack([rigid.make(turns, rng.normal(0, 1, (200, 3)))] * 2, axis=1)
    along, angle = rng.uniform(0, 1, (200, 2000)), rng.uniform(-np.pi, np.pi, (200, 2000))
    away = 0.15 - 0.05 * along + np.where(rng.random((200, 2000)) < 0.2, 0.0, rng.uniform(0, 0.1, (200, 2000)))
    points = np.stack([away * np.cos(angle), -along, away * np.sin(angle)], axis=2)
    made = find_outline(tree, tree.joints, world, rigid.apply(world[:, :1], points))
    middles = (np.arange(ALONG) + 0.5) / ALONG
    assert made.joint.tolist() == [0]
    np.testing.assert_allclose(
        made.radius[0], np.repeat((0.15 - 0.05 * middles)[:, None], AROUND, 1), atol=2 * BIN + 0.0025
    )


def test_where_cloth_never_comes_there_is_no_body():
    tree = Skeleton(
        ("a", "b"), np.array([-1, 0], np.int32), np.array([[0, 0, 0], [0, -1, 0]], np.float32), np.ones((1, 2))
    )
    world = rigid.identity(100, 2, dtype=np.float64)
    points = np.tile(np.array([[0.1, -0.55, 0.0]]), (100, 1, 1))
    radius = find_outline(tree, tree.joints, world, points).radius[0]
    assert np.count_nonzero(radius) == 1
    assert radius.max() == pytest.approx(0.1, abs=BIN)


def test_left_out_clips_are_told_as_training_without_them_tells():
    rng = np.random.default_rng(1)
    x, y, clip = rng.normal(size=(60, 4)), rng.normal(size=(60, 3)), np.repeat([0, 1, 2], 20)
    process = foretold._Process(x, y, clip, 2.0, 0.1, True)
    made, variance = process.left_out(x, clip)
    for c in range(3):
        rest, mine = clip != c, clip == c
        alone = foretold._Process(x[rest], y[rest], clip[rest], 2.0, 0.1, True)
        np.testing.assert_allclose(made[mine], alone(x[mine])[0], atol=1e-9)
        np.testing.assert_allclose(variance[mine], alone(x[mine])[1], atol=1e-9)
        gram = kernel.correlation(x[rest], x[rest], 2.0) + 0.1 * np.eye(40)
        near = kernel.correlation(x[mine], x[rest], 2.0)
        np.testing.assert_allclose(variance[mine], 1 - np.diag(near @ np.linalg.solve(gram, near.T)), atol=1e-9)


def hanging(clips: int, frames: int = 60) -> Training:
    """A cloth that hangs from a bar that is shaken, with a bone for each of its rows: poses alone do not tell where it
    is."""
    rows, columns = 7, 5
    grid = np.stack(np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij"), axis=2).reshape(-1, 2)
    rest = np.stack([0.1 * grid[:, 1], 1.0 - 0.1 * grid[:, 0], np.zeros(len(grid))], axis=1)
    corner = np.arange(rows * columns).reshape(rows, columns)[:-1, :-1].ravel()
    faces = np.concatenate(
        [
            np.stack([corner, corner + 1, corner + columns], 1),
            np.stack([corner + 1, corner + columns + 1, corner + columns], 1),
        ]
    )
    rng = np.random.default_rng(5)
    time = np.arange(frames) / FPS
    swing = np.concatenate([np.sin(rng.uniform(3, 9) * time + rng.uniform(0, 6)) for _ in range(clips)])
    start = np.arange(clips + 1) * frames
    joints = np.array([[0.2, 1.0, 0.0], [0.2, 1.2, 0.0]])
    rotations = from_rotation_vector(swing[:, None, None] * np.array([[0.6, 0, 0], [0, 0, 0]]))
    poses = Poses(rotations.astype(np.float32), np.zeros((len(swing), 2, 3), np.float32), start)
    weights = np.tile([1.0, 0.0], (len(rest), 1)).astype(np.float32)
    tree = Skeleton(("bar", "top"), np.array([-1, 0], np.int32), joints.astype(np.float32), weights)
    world = np.stack([rigid.make(rotations[:, 0], joints[0] - rotations[:, 0] @ joints[0])] * 2, axis=1)
    target = rigid.apply(world[:, :1], np.tile(rest, (len(swing), 1, 1)))
    pull = np.tile(np.where(grid[:, 0] == 0, 300.0, 0.0), (len(swing), 1))
    cloth = fabric(rest, faces, density=0.2, stretch=1e4, drag=0.5, friction=0.0)
    points = simulate(cloth, NOBODY, world, target, pull, start, fps=FPS, substeps=STEPS)
    soft = np.maximum(1.0 - np.abs(grid[:, :1] - np.arange(rows)), 0.0).astype(np.float32)
    bones = np.stack([rigid.procrustes(rest, points, soft[:, b] + 1e-3) for b in range(rows)], axis=1)
    skinning = Skinning(rest.astype(np.float32), soft, bones.astype(np.float32), np.zeros((0, 2)))
    names = tuple(f"clip{c}" for c in range(clips))
    motion = Motion("hanging", points.astype(np.float32), faces, start, names, FPS, "m")
    canonical = Canonical(skinning.rest, faces, -1, "rest")
    database = build_database(motion, skinning, poses)
    return Training(
        motion,
        canonical,
        skinning,
        tree,
        database,
        find_parts(tree, skinning, kind="whole", named=[], overlap=1, affinity=0.0),
    )


@pytest.fixture(scope="module")
def shaken() -> Training:
    return hanging(6)


def split(train: Training) -> tuple[Training, Poses, np.ndarray]:
    """The last clip asked, the others known."""
    a, known = int(train.motion.clip_start[-2]), train.database.poses
    motion = train.motion.take_clips(list(range(len(train.motion.clip_names) - 1)))
    skinning = replace(train.skinning, transforms=train.skinning.transforms[:a])
    poses = Poses(known.rotations[:a], known.translations[:a], motion.clip_start)
    asked = Poses(known.rotations[a:], known.translations[a:], np.array([0, len(known.rotations) - a]))
    rest = replace(train, motion=motion, skinning=skinning, database=build_database(motion, skinning, poses))
    return rest, asked, train.motion.points[a:]


MATCHING = {"k": 3, "patch": 5, "dynamics": 0.5, "mirror": False, "sources": 60, "every": 2}


def test_cloth_that_swings_is_followed_where_matching_is_lost(shaken):
    known, asked, truth = split(shaken)
    made = partmm_cloth.animate(known, asked, **MATCHING | CLOTH | {"friction": 0.0, "pull": 1.0})
    plain = {"levels": 1, "lambda_": 0.7, "temperature": 1.0, "represent": "residual", "align": False, "shrink": False}
    alone = partmm.animate(known, asked, **MATCHING | plain)
    assert vertex_rmse(made.points, truth) < 0.8 * vertex_rmse(alone.points, truth)
    np.testing.assert_array_equal(made.sources, alone.sources)
    one = split(hanging(2))[0]  # a single clip: nothing to weigh by
    np.testing.assert_array_equal(
        partmm_cloth.animate(one, asked, **MATCHING | CLOTH).bones, partmm.animate(one, asked, **MATCHING | plain).bones
    )


def test_cloth_that_swings_is_followed_where_regression_is_lost(shaken):
    known, asked, truth = split(shaken)
    made = part_cloth.animate(known, asked, **REGRESSION | CLOTH | {"friction": 0.0, "pull": 1.0})
    alone = part_kernel.animate(known, asked, represent="residual", tune=True, **REGRESSION)
    assert vertex_rmse(made.points, truth) < 0.8 * vertex_rmse(alone.points, truth)


@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_data_of_unknown_unit_may_have_any(shaken, scale):
    known, asked, _ = split(replace(shaken, motion=replace(shaken.motion, unit="unit")))
    settings = REGRESSION | CLOTH | {"pull": 1.0}
    here = part_cloth.animate(known, asked, **settings).points
    there = part_cloth.animate(moved(known, scale, np.zeros(3)), shifted(asked, scale), **settings).points / scale
    assert vertex_rmse(there, here) < 0.01 * diagonal(known.canonical.points)  # loose cloth makes much of last bits


def test_what_is_no_cloth_is_as_foretold():
    """A planted body: its bones are a function of the pose, which hanging cloth does not predict."""
    train = planted.training([planted.gesture(40, s, 0.4) for s in (1, 2, 3)], affinity=0.0)
    corner = np.arange(len(train.canonical.points) - 2)
    faces = np.stack([corner, corner + 1, corner + 2], axis=1)
    meshed = replace(train, canonical=replace(train.canonical, faces=faces))
    query = planted.poses([planted.gesture(20, 9, 0.4)])
    settings = REGRESSION | CLOTH
    made = part_cloth.animate(meshed, query, **settings)
    alone = part_kernel.animate(meshed, query, represent="residual", tune=True, **REGRESSION)
    assert vertex_rmse(made.points, alone.points) < 0.02 * diagonal(train.canonical.points)
    one = replace(planted.training([planted.gesture(40, 1)]), canonical=meshed.canonical)
    assert np.isfinite(part_cloth.animate(one, query, **settings).points).all()


def test_bare_points_and_bad_poses_are_refused(shaken):
    bare = replace(shaken, canonical=replace(shaken.canonical, faces=None))
    with pytest.raises(InputError, match="bare points"):
        part_cloth.animate(bare, shaken.database.poses, **REGRESSION | CLOTH)
    with pytest.raises(InputError, match="bare points"):
        partmm_cloth.animate(bare, shaken.database.poses, **MATCHING | CLOTH)
    bad = replace(shaken.database.poses, rotations=shaken.database.poses.rotations * 1.1)
    with pytest.raises(InputError, match="rotation matrices"):
        part_cloth.animate(shaken, bad, **REGRESSION | CLOTH)


def test_bones_come_close_to_the_points(shaken):
    known = Posed(shaken, shaken.database.poses)
    made = hung.fitted(shaken, known.predicted * 0 + rigid.identity(*known.predicted.shape[:2]), shaken.motion.points)
    points = skin(shaken.skinning.rest, shaken.skinning.weights, made)
    assert vertex_rmse(points, shaken.motion.points) < 0.02
