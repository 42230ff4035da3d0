"""Regression bone by bone: what it is told, and how its settings are chosen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tasks.errors import InputError
from tasks.geometry.measure import vertex_rmse
from tasks.methods import bone_kernel, lbs
from tasks.motion import bonewise, kernel
from tasks.motion.posed import Posed
from tests.analytic import planted
from tests.analytic.test_methods_learned import stiff

A, B, C = planted.gesture(40, 1), planted.gesture(45, 2), planted.gesture(35, 3)
SETTINGS = {"dynamics": 0.5, "reach": 4, "width": 1.0, "ridge": 0.01, "landmarks": 1000, "mirror": False}
LAGS = [0, 1, 2, 4]


@pytest.fixture(scope="module")
def train():
    return planted.training([A, B, C], affinity=0.0)


@pytest.fixture(scope="module")
def told(train):
    return bonewise.Told(Posed(train, train.database.poses), train.database.bones, LAGS)


def test_what_is_seen_from_the_root_is_the_residual_seen_otherwise(told):
    np.testing.assert_allclose(
        bonewise.as_residual(told, told.numbers[:, :, 6:]), told.numbers[:, :, :6], atol=1e-6 * np.abs(told.unit).max()
    )


def test_training_frames_come_back(train):
    made = bone_kernel.animate(train, train.database.poses, **SETTINGS | {"ridge": 1e-8})
    assert vertex_rmse(made.points, planted.truth(train, train.database.poses)) < 1e-3


def test_left_out_frames_are_what_training_without_their_clip_gives(told):
    rows, bone, width = np.arange(len(told.clip)), 3, 1.0
    made = bonewise.left_out(told, None, rows, [(width, 0.5)], 0.1)[0, :, bone]
    x = told.features(bone, 0.5)
    apart = kernel.squared_distances(x, x)
    scale = np.sqrt(np.median(apart[apart > 0])) * width
    for clip in range(3):
        rest, mine = told.clip != clip, told.clip == clip
        gram = kernel.matern(apart / scale**2)
        y = told.numbers[rest, bone]
        solved = np.linalg.solve(gram[np.ix_(rest, rest)] + 0.1 * np.eye(rest.sum()), y - y.mean(0))
        np.testing.assert_allclose(made[mine], y.mean(0) + gram[np.ix_(mine, rest)] @ solved, atol=1e-5)


def test_where_skinning_is_exact_the_answer_is_skinning(train):
    """Residuals are nought and predicted so; seen from the root there is much to learn, and much to get wrong."""
    weights = np.eye(16, dtype=np.float32)[stiff(train).skinning.weights.argmax(1)]
    exact = stiff(replace(train, skeleton=replace(train.skeleton, weights=weights)))
    rigid = replace(exact, skinning=replace(exact.skinning, weights=weights))
    query = planted.poses([planted.gesture(30, 9)])
    made = bone_kernel.animate(rigid, query, **SETTINGS)
    assert vertex_rmse(made.points, lbs.animate(rigid, query).points) < 1e-4


def test_the_share_is_the_one_that_errs_least(train):
    """A skeleton whose skin says little of the bones: neither way of telling them is much better than the other."""
    even = replace(train.skeleton, weights=np.full_like(train.skeleton.weights, 1 / 16))
    blind = replace(train, skeleton=even)
    told = bonewise.Told(Posed(blind, blind.database.poses), blind.database.bones, LAGS)
    choice = bonewise.choose(told, None, dynamics=0.5, width=1.0, ridge=0.01)
    rows = np.arange(len(told.clip))
    made = bonewise.left_out(told, None, rows, [(choice.width, choice.dynamics)], 0.01)[0]
    error = {
        share: ((bonewise.both(told, made[:, :, :6], made[:, :, 6:], share) - told.numbers[:, :, :6]) ** 2).sum()
        for share in (0.0, choice.share - 0.05, choice.share, choice.share + 0.05, 1.0)
    }
    assert 0.0 < choice.share < 1.0
    assert min(error, key=error.get) == choice.share


def test_a_lone_clip_is_enough_and_bad_poses_are_refused(train):
    lone, query = planted.training([B], affinity=0.0), planted.poses([A])
    assert np.isfinite(bone_kernel.animate(lone, query, **SETTINGS).points).all()
    with pytest.raises(InputError, match="rotation matrices"):
        bone_kernel.animate(train, replace(query, rotations=query.rotations * 1.1), **SETTINGS)
