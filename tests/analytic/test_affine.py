"""Shares of matched frames that predict the query's pose from theirs."""

from __future__ import annotations

import numpy as np
import pytest

from tasks.geometry.measure import vertex_rmse
from tasks.methods import partmm
from tasks.motion.affine import RIDGE, WIDTH, Space, nearest_moments, space
from tasks.motion.kernel import matern, squared_distances
from tasks.motion.matching import Way, match_prepared, prepare
from tasks.motion.posed import Posed
from tests.analytic import planted
from tests.analytic.test_methods import PAPER

A, B, UNSEEN = (planted.gesture(n, seed) for n, seed in ((90, 1), (80, 2), (40, 9)))
RESIDUAL = PAPER | {"represent": "residual", "dynamics": 0.5, "levels": 1}


@pytest.fixture(scope="module")
def train():
    return planted.training([A, B], affinity=0.0)


def on_a_line(at: list[float]) -> Space:
    return Space(np.array(at)[:, None], np.arange(len(at)), np.eye(1), np.ones(1))


def test_shares_sum_to_one_and_a_source_takes_what_lies_on_it():
    known = on_a_line([0.0, 1.5, 3.0, 20.0])
    found = nearest_moments(np.array([[1.5], [2.1], [9.0]]), known, 3)
    np.testing.assert_allclose(found.share.sum(1), 1.0)
    assert found.frame[0].tolist() == [0, 1, 2]
    assert found.share[0].argmax() == 1
    assert found.share[0, 1] > 0.85


def test_the_kernel_solves_the_kriging_system():
    """Shares minimise the variance under Matern's kernel with a ridge, subject to a sum of one: the bordered system."""
    rng = np.random.default_rng(0)
    frames, asked = rng.normal(size=(60, 9)), rng.normal(size=(7, 9))
    found = nearest_moments(asked, Space(frames, np.arange(60), np.eye(9), np.ones(1)), 14)
    far = squared_distances(asked, frames)
    for row in range(len(asked)):
        near = np.sort(np.argsort(far[row])[:14])
        assert found.frame[row].tolist() == near.tolist()
        system = np.ones((15, 15))
        there = frames[near]
        system[:14, :14] = matern(squared_distances(there, there) / WIDTH**2) + RIDGE * np.eye(14)
        system[14, 14] = 0.0
        want = np.linalg.solve(system, np.append(matern(far[row, near] / WIDTH**2), 1.0))[:14]
        np.testing.assert_allclose(found.share[row], want, atol=1e-9)
        variance = 1.0 - 2.0 * want @ matern(far[row, near] / WIDTH**2) + want @ system[:14, :14] @ want
        assert found.variance[row] == pytest.approx(variance, abs=1e-9)


def test_ten_copies_of_a_moment_count_as_one():
    once = nearest_moments(np.array([[0.4]]), on_a_line([0.0, 1.0]), 2)
    often = nearest_moments(np.array([[0.4]]), on_a_line([0.0] * 10 + [1.0]), 11)
    assert often.share[0, -1] == pytest.approx(once.share[0, -1], abs=0.04)


def test_of_neighbours_one_is_a_candidate_in_each_clip(train):
    known = Posed(train, train.database.poses)
    told = [space(known.keys(0, 0.5), np.ones(len(known.key_joints(0))), every) for every in (1, 3)]
    kept = [*range(0, 90, 3), *range(90, 170, 3)]
    assert told[1].index.tolist() == kept
    np.testing.assert_allclose(told[1].frames, told[0].frames[kept], atol=1e-12)
    found = nearest_moments(told[0].frames[:40], told[1], 8)
    assert set(found.frame.ravel()) <= set(kept)
    left = told[1].without(np.arange(90))
    assert left.index.tolist() == kept[30:]
    assert nearest_moments(told[0].frames[:5], left, 8).frame.min() >= 90


def test_training_clips_are_matched_with_each_other_only(train):
    way = Way(**RESIDUAL | {"sources": 30, "mirror": True})
    ready = prepare(train, way)
    alone = match_prepared(ready, train.database.poses, left_out=True)
    assert alone.sources[:90].min() >= 90
    assert alone.sources[90:].max() < 90
    free = match_prepared(ready, train.database.poses)
    assert free.variance.mean() < 0.2 * alone.variance.mean()


def test_between_sources_lies_what_between_poses_lies(train):
    query = planted.poses([UNSEEN])
    true = planted.truth(train, query)
    error = {s: vertex_rmse(partmm.animate(train, query, **RESIDUAL | {"sources": s}).points, true) for s in (0, 60)}
    assert error[60] < 0.95 * error[0]


def test_sources_are_training_frames_though_images_are_matched(train):
    made = partmm.animate(train, planted.poses([A]), **RESIDUAL | {"sources": 30, "mirror": True})
    assert made.sources.min() >= 0
    assert made.sources.max() < train.motion.frames
    assert vertex_rmse(made.points, train.motion.points[:90]) < 1e-2
