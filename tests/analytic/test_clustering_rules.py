"""Where clusters are split, how many are kept and what Gaussian bones weigh, by hand."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from tasks.bones.clustering import _seeds, choose_count
from tasks.bones.gaussian import gaussian_bones
from tasks.bones.stray import trusted
from tasks.values import Canonical, Clusters, Motion


@pytest.mark.parametrize(("slack", "chosen"), [(0.001, 1), (0.02, 0)])
def test_errors_are_compared_per_degree_of_freedom_left(slack, chosen):
    """Of 100 points 10 clusters leave 80 % of the numbers free and 40 leave 20 %: half the error there is none won."""
    counts, errors = np.array([10, 40]), np.array([2.0 * 1.01, 1.0])
    assert choose_count(counts, errors, 100, slack, 0.0) == chosen
    assert choose_count(counts, errors, 100, slack, 2.1) == 0  # good enough by itself


def test_a_cluster_is_split_where_error_and_distance_exceed_their_least():
    """Ten points on a line, all wrong by a hundred: the one that is worst, not the one that lies farthest out."""
    rest = np.zeros((10, 4))
    rest[:, 0] = np.arange(10.0)
    error = np.full(10, 100.0)
    error[7], error[9] = 110.0, 101.0
    near = np.arange(10)[:, None]
    assert _seeds(SimpleNamespace(rest=rest), np.zeros(10, np.int32), error, near, 5) == [7]
    error[9] = 108.0  # 8 x 4 against 10 x 2
    assert _seeds(SimpleNamespace(rest=rest), np.zeros(10, np.int32), error, near, 5) == [9]


def test_the_worst_cluster_is_split_first_and_a_good_one_never():
    rest = np.zeros((9, 4))
    rest[:, 0] = np.arange(9.0)
    labels = np.repeat(np.arange(3), 3).astype(np.int32)
    error = np.array([1.0, 1, 2, 5, 5, 9, 0.001, 0.001, 0.002])
    near = np.arange(9)[:, None]
    assert _seeds(SimpleNamespace(rest=rest), labels, error, near, 5) == [5, 2]
    assert _seeds(SimpleNamespace(rest=rest), labels, error, near, 1) == [5]


def test_gaussian_weights_are_a_softmax_of_half_the_squared_mahalanobis_distance():
    """A long ellipsoid and a flat one, which is as thick as a hundredth of the shape."""
    rng = np.random.default_rng(0)
    long, flat = rng.normal(size=(200, 3)) * [3.0, 0.5, 0.5], rng.normal(size=(200, 3)) * [1.0, 1.0, 0.0]
    points = np.concatenate([long, flat + np.array([6.0, 0.0, 0.0])])
    labels = np.repeat(np.arange(2), 200)
    thin = (0.01 * np.linalg.norm(np.ptp(points, axis=0))) ** 2 * np.eye(3)
    expected = np.empty((400, 2))
    for b in range(2):
        own = points[labels == b]
        away = points - own.mean(0)
        inverse = np.linalg.inv(np.cov(own.T, bias=True) + thin)
        expected[:, b] = [np.exp(-0.5 * 0.7 * x @ inverse @ x) for x in away]
    expected /= expected.sum(1, keepdims=True)
    motion = Motion("two", np.stack([points, points]), None, np.array([0, 2]), ("a",), 30.0)
    still = np.zeros((2, 2, 3, 4), np.float32)
    still[..., :3] = np.eye(3)
    found = gaussian_bones(
        motion,
        Canonical(points.astype(np.float32), None, 0, "first"),
        Clusters(labels.astype(np.int32), still, np.ones(400, bool), np.zeros(0), np.zeros(0)),
        sharpness=0.7,
        influences=2,
    )
    np.testing.assert_allclose(found.weights, expected, atol=1e-4)


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_a_point_that_wanders_among_still_ones_is_not_trusted_and_a_loose_part_is(scale):
    rng = np.random.default_rng(3)
    rest = rng.uniform(-1, 1, (400, 3))
    points = np.repeat(rest[None], 20, axis=0)
    points += 0.002 * rng.normal(size=points.shape)
    points[:, 7] += 0.4 * rng.normal(size=(20, 3))
    loose = rest[:, 0] > 0.3
    points[:, loose] += np.linspace(0, 2, 20)[:, None, None] * np.array([1.0, 0.0, 0.0])
    found = trusted((scale * points).astype(np.float32), (scale * rest).astype(np.float32), None)
    assert np.flatnonzero(~found).tolist() == [7]
