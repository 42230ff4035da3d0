"""Baselines and regressions on a planted character: each is exact where its model holds."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from tasks.errors import InputError
from tasks.geometry.kinematics import forward
from tasks.geometry.measure import vertex_rmse
from tasks.geometry.rotations import from_rotation_vector
from tasks.geometry.skinning import skin
from tasks.methods import bone_response, lbs, lbs_fitted, lbs_residual, part_kernel, partmm
from tasks.motion import kernel, response
from tasks.motion.dynamics import root_dynamics
from tasks.motion.fitting import _onto_simplex
from tasks.motion.posed import Posed
from tasks.values import Poses
from tests.analytic import planted

A, B, C = planted.gesture(60, 1), planted.gesture(80, 2), planted.gesture(50, 3)
KERNEL = {
    "represent": "residual",
    "dynamics": 1.0,
    "reach": 8,
    "width": 1.0,
    "ridge": 1e-4,
    "tune": False,
    "landmarks": 1000,
    "mirror": False,
}
PLUS = {
    "k": 15,
    "patch": 7,
    "levels": 5,
    "lambda_": 0.7,
    "temperature": 1.0,
    "represent": "residual",
    "align": False,
    "dynamics": 1.0,
    "shrink": True,
    "mirror": False,
    "sources": 0,
    "every": 1,
}


@pytest.fixture(scope="module")
def train():
    return planted.training([A, B, C], affinity=0.0)


def stiff(train):
    """The same character whose bones follow the skeleton's skinning exactly: nothing is left to learn."""
    known = train.database.poses
    world = forward(train.skeleton.parents, train.skeleton.joints, known.rotations, known.translations)
    points = skin(train.canonical.points, train.skeleton.weights, world)
    return replace(
        train,
        motion=replace(train.motion, points=points),
        skinning=replace(train.skinning, transforms=world),
        database=replace(train.database, bones=world),
    )


@pytest.mark.parametrize("landmarks", [1000, 150])
def test_kernel_gives_training_frames_back(train, landmarks):
    query = train.database.poses
    made = part_kernel.animate(train, query, **KERNEL | {"ridge": 1e-8, "landmarks": landmarks})
    plain = vertex_rmse(lbs.animate(train, query).points, train.motion.points)
    assert vertex_rmse(made.points, train.motion.points) < (0.02 if landmarks == 1000 else 0.3) * plain


def test_kernel_learns_what_skinning_cannot_explain(train):
    wobble = from_rotation_vector(0.05 * np.random.default_rng(0).normal(size=(16, 3))).astype(np.float32)
    query = planted.poses([B @ wobble])
    true = planted.truth(train, query)
    plain = vertex_rmse(lbs.animate(train, query).points, true)
    assert vertex_rmse(part_kernel.animate(train, query, **KERNEL | {"ridge": 0.01}).points, true) < 0.5 * plain
    assert vertex_rmse(partmm.animate(train, query, **PLUS).points, true) < 0.7 * plain


def test_left_out_errors_are_those_of_training_without_the_clip():
    rng = np.random.default_rng(1)
    x, y = rng.normal(size=(40, 3)), rng.normal(size=(40, 2))
    clip = np.repeat([0, 1, 2], [10, 18, 12])
    gram = np.exp(-kernel.squared_distances(x, x) / 2.0)
    for centred in (True, False):
        total = 0.0
        for c in range(3):
            rest, mine = clip != c, clip == c
            mean = y[rest].mean(0) if centred else 0.0
            alpha = np.linalg.solve(gram[np.ix_(rest, rest)] + 0.1 * np.eye(rest.sum()), y[rest] - mean)
            total += ((y[mine] - mean - gram[np.ix_(mine, rest)] @ alpha) ** 2).sum()
        inverse = np.linalg.inv(gram + 0.1 * np.eye(40))
        assert np.isclose((kernel.left_out(inverse, y, clip, centred=centred) ** 2).sum(), total)


def test_landmarks_minimise_the_ridge_over_all_frames():
    """sum |y - m - k(x, centres) c|^2 + ridge c^T k(centres, centres) c has no slope at its coefficients (Nystroem)."""
    rng = np.random.default_rng(3)
    x, y = rng.normal(size=(80, 3)), rng.normal(size=(80, 2))
    ridge = 0.5
    found = kernel.fit(x, y, np.zeros(80), width=1.0, ridge=ridge, tune=False, landmarks=20)
    apart = (kernel.squared_distances(found.centres, z) / found.width**2 for z in (found.centres, x))
    inner, cross = map(kernel.matern, apart)
    slope = cross @ (cross.T @ found.coefficients - (y - found.mean)) + ridge * inner @ found.coefficients
    assert np.abs(slope).max() < 1e-5 * np.abs(cross @ (y - found.mean)).max()
    np.testing.assert_allclose(found(x), found.mean + cross.T @ found.coefficients, atol=1e-9)


def test_tuning_finds_that_noise_holds_nothing():
    rng = np.random.default_rng(2)
    x, y = rng.normal(size=(90, 4)), rng.normal(size=(90, 3))
    start = np.repeat([0, 1, 2], 30)
    loose = kernel.fit(x, y, start, width=0.3, ridge=0.01, tune=False, landmarks=90)
    tuned = kernel.fit(x, y, start, width=0.3, ridge=0.01, tune=True, landmarks=90)
    fresh = rng.normal(size=(50, 4))
    assert (tuned(fresh) ** 2).mean() < (loose(fresh) ** 2).mean()


def test_nothing_is_added_where_skinning_is_exact(train):
    exact = stiff(train)
    query = planted.poses([planted.gesture(30, 9)])
    weights = exact.skinning.weights
    own = replace(exact, skeleton=replace(exact.skeleton, weights=np.eye(16, dtype=np.float32)[weights.argmax(1)]))
    rigid = replace(own, skinning=replace(own.skinning, weights=own.skeleton.weights))
    true = lbs.animate(rigid, query).points
    for made in (
        lbs_residual.animate(rigid, query),
        part_kernel.animate(rigid, query, **KERNEL),
        partmm.animate(rigid, query, **PLUS),
    ):
        assert vertex_rmse(made.points, true) < 1e-5


def test_residual_of_a_constant_offset_is_found(train):
    """Bones that sit 3 cm beside where skinning would carry them, always."""
    exact = stiff(train)
    eye = np.eye(16, dtype=np.float32)[exact.skinning.weights.argmax(1)]
    shift = np.array([0.0, 0.03, 0.0])

    def shifted(world):
        out = world.copy()
        out[..., 3] += world[..., :3] @ shift
        return out

    moved = replace(
        exact,
        skeleton=replace(exact.skeleton, weights=eye),
        skinning=replace(exact.skinning, weights=eye, transforms=shifted(exact.skinning.transforms)),
        database=replace(exact.database, bones=shifted(exact.database.bones)),
    )
    query = planted.poses([planted.gesture(30, 9)])
    world = forward(exact.skeleton.parents, exact.skeleton.joints, query.rotations, query.translations)
    true = skin(exact.skinning.rest, eye, shifted(world))
    assert vertex_rmse(lbs_residual.animate(moved, query).points, true) < 1e-5


def test_fitted_weights_are_recovered(train):
    exact = stiff(train)
    wrong = np.full_like(exact.skeleton.weights, 1 / 16)
    blind = replace(exact, skeleton=replace(exact.skeleton, weights=wrong))
    query = planted.poses([planted.gesture(30, 9)])
    made = lbs_fitted.animate(blind, query, influences=4, keep=0.0)
    assert vertex_rmse(made.points, lbs.animate(exact, query).points) < 2e-3
    assert vertex_rmse(lbs.animate(blind, query).points, lbs.animate(exact, query).points) > 0.1
    kept = lbs_fitted.animate(exact, query, influences=4, keep=0.1)
    assert vertex_rmse(kept.points, lbs.animate(exact, query).points) < 1e-4


def test_projection_onto_the_simplex():
    for w in ([0.2, 0.8, 0.0], [3.0, 0.0, -1.0], [0.5, 0.5, 0.5], [-1e30, 0.3, 0.1]):
        got = np.array(w)
        _onto_simplex(got)
        assert np.isclose(got.sum(), 1)
        assert got.min() >= 0
        others = np.random.default_rng(0).dirichlet(np.ones(3), 2000)
        if min(w) > -1e6:
            assert ((got - w) ** 2).sum() <= ((others - np.array(w)) ** 2).sum(1).min() + 1e-12


def test_a_lone_training_clip_is_enough():
    lone = planted.training([B], affinity=0.0)
    query = planted.poses([planted.gesture(12, 9)])
    for made in (
        partmm.animate(lone, query, **PLUS),
        part_kernel.animate(lone, query, **KERNEL | {"tune": True}),
        lbs_fitted.animate(lone, query, influences=4, keep=0.1),
        lbs_residual.animate(lone, query),
    ):
        assert np.isfinite(made.points).all()


def test_bad_poses_are_refused(train):
    query = planted.poses([A])
    bad = replace(query, rotations=query.rotations * 1.1)
    for animate in (
        lambda: lbs_residual.animate(train, bad),
        lambda: lbs_fitted.animate(train, bad, influences=4, keep=0.1),
        lambda: part_kernel.animate(train, bad, **KERNEL),
    ):
        with pytest.raises(InputError, match="rotation matrices"):
            animate()


RESPONSE = {"lag": 2, "lags": 8, "pose": False, "width": 1.0, "ridge": 0.1, "landmarks": 1000}


def swinging(train, query: Poses) -> np.ndarray:
    """True bones that ride on the skeleton but lag behind: shifted by a filter of their place's acceleration."""
    posed = Posed(train, query)
    frames = np.zeros_like(posed.predicted)
    frames[..., :3] = np.eye(3)
    for b in range(frames.shape[1]):
        moving = root_dynamics(posed.predicted[:, b], np.zeros(3), query.clip_start, train.database.fps)[:, 2]
        for start, stop in pairwise(query.clip_start):
            for back, gain in ((0, -4e-4), (2, -2e-4), (6, 1e-4)):
                index = np.maximum(np.arange(start, stop) - back, start)
                frames[start:stop, b, :, 3] += gain * moving[index]
    return posed.decode(frames, "residual").astype(np.float32)


def test_the_answer_to_being_shaken_carries_over_to_motions_unlike_any_seen(train):
    bones = swinging(train, train.database.poses)
    points = skin(train.skinning.rest, train.skinning.weights, bones)
    soft = replace(
        train,
        motion=replace(train.motion, points=points),
        skinning=replace(train.skinning, transforms=bones),
        database=replace(train.database, bones=bones),
    )
    query = planted.poses([planted.gesture(60, 9)])
    true = skin(train.skinning.rest, train.skinning.weights, swinging(train, query))
    answered = vertex_rmse(bone_response.animate(soft, query, **RESPONSE).points, true)
    assert answered < 0.2 * vertex_rmse(lbs_residual.animate(soft, query).points, true)
    assert answered < 0.2 * vertex_rmse(partmm.animate(soft, query, **PLUS).points, true)


def test_a_response_that_left_out_clips_do_not_confirm_is_dropped():
    rng = np.random.default_rng(3)
    x, y, start = rng.normal(size=(60, 50)), rng.normal(size=(60, 2)), np.array([0, 20, 40, 60])
    filters, left_out = response.fit(x, 1e-6 * y, start)
    assert np.all(filters == 0)
    assert np.all(left_out == 0)
    true = rng.normal(size=(50, 2))
    filters, left_out = response.fit(x, x @ true, start)
    assert np.abs(filters - true).max() < 0.2
    np.testing.assert_allclose(
        left_out[:20],
        x[:20] @ np.linalg.solve(x[20:].T @ x[20:] + 0.1 * np.eye(50), x[20:].T @ (x[20:] @ true)),
        atol=1e-8,
    )
