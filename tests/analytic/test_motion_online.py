"""Matching one pose at a time: the same windows as in whole clips, and what it costs."""

from __future__ import annotations

import numpy as np
import pytest

from tasks.benchmarks.matching import benchmark_matching
from tasks.geometry.measure import vertex_rmse
from tasks.motion.matching import Way, prepare
from tasks.motion.online import DELAY, Online, WindowSearch
from tasks.motion.posed import Posed
from tasks.motion.search import nearest_windows
from tests.analytic import planted
from tests.analytic.test_methods import PAPER

A, B, C, UNSEEN = (planted.gesture(n, seed) for n, seed in ((60, 1), (80, 2), (50, 3), (40, 9)))
RESIDUAL = PAPER | {"represent": "residual", "dynamics": 1.0}
WAYS = [PAPER, PAPER | {"represent": "part"}, RESIDUAL | {"shrink": True}, RESIDUAL | {"sources": 40}]


@pytest.fixture(scope="module")
def train():
    return planted.training([A, B, C])


@pytest.mark.parametrize("way", WAYS)
def test_a_training_clip_comes_back_pose_by_pose(train, way):
    poses = planted.poses([A, B, C])
    online = Online(prepare(train, Way(**way)))
    for _ in range(2):  # a second motion knows nothing of the first
        made = np.stack([online.pose(poses.rotations[f], poses.translations[f]) for f in range(60, 140)])
        online.restart()
        known = way["patch"] - 1 + 2 * DELAY  # from here on window and dynamics are those of the clip
        assert vertex_rmse(made[known:], train.motion.points[60 + known : 140]) < (
            1e-2 if way["shrink"] or way["sources"] else 1e-4
        )


@pytest.mark.parametrize("patch", [1, 7])
def test_windows_are_those_of_the_search_in_whole_clips(train, patch):
    asked = Posed(train, planted.poses([UNSEEN]))
    known = Posed(train, train.database.poses)
    for part in range(len(train.parts.names)):
        query, database = asked.keys(part, 1.0), known.keys(part, 1.0)
        whole = nearest_windows(query, database, k=5, patch=patch, strides=[1])
        search = WindowSearch(database, k=5, patch=patch)
        for f in range(len(query.rotations)):
            distance, last = search.push(query.rotations[f], query.extra[f])
            if f >= patch - 1:
                np.testing.assert_allclose(distance, whole.distance[0, f - patch + 1], rtol=1e-5)
                assert set(last - patch + 1) == set(whole.start[0, f - patch + 1])


def test_the_benchmark_finds_every_nearest_window(train):
    sizes = {"vertices": 200, "frames": 150, "patches": [50, 400], "recall_queries": 4, "repeats": 1}
    way = PAPER | {"represent": "residual", "dynamics": 1.0}
    found = benchmark_matching(train, planted.poses([UNSEEN]), matching=way, **sizes, threads=1, seed=0)
    named = dict(zip(found.names, found.values.tolist(), strict=True))
    assert named["recall_at_7"] == 1.0
    assert named["points_count"] == 200
    assert min(named[n] for n in ("fps", "p99_ms", "clip_fps", "query_ms@50", "query_ms@400", "build_seconds")) > 0
