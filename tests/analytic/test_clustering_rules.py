"""Where clusters are split and how many are kept, by hand."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from tasks.bones.clustering import _seeds, choose_count


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
