"""Training without one clip, bounds and gains: what stands beside a method's number."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from tasks.bones.refit import compression_floor
from tasks.errors import InputError
from tasks.evaluation.left_out import evaluate_left_out, spread
from tasks.geometry.measure import vertex_rmse
from tasks.motion.left_out import leave_out
from tasks.reporting.gains import gains, printed_gains
from tasks.reporting.paper import Paper, PaperCell
from tasks.values import Animation, Metrics, Motion
from tests.analytic import planted

A, B, C, UNSEEN = (planted.gesture(n, seed) for n, seed in ((30, 1), (40, 2), (20, 3), (25, 9)))


@pytest.fixture(scope="module")
def train():
    return planted.training([A, B, C])


@pytest.fixture(scope="module")
def unseen():
    return planted.training([UNSEEN]).motion


def left_out(train, unseen, run, runs=3):
    poses, query = planted.poses([A, B, C]), planted.poses([UNSEEN])
    return leave_out(train.motion, unseen, train.skinning, poses, query, run=run, runs=runs)


def test_every_clip_is_left_out_once_and_asked_for(train, unseen):
    for run, clip in enumerate(train.motion.clips()):
        motion, skinning, database, asked, truth = left_out(train, unseen, run)
        rest = np.delete(np.arange(90), np.r_[clip])
        np.testing.assert_array_equal(motion.points, train.motion.points[rest])
        np.testing.assert_array_equal(skinning.transforms, train.skinning.transforms[rest])
        np.testing.assert_array_equal(database.poses.rotations, planted.poses([A, B, C]).rotations[rest])
        np.testing.assert_array_equal(database.poses.clip_start, motion.clip_start)
        np.testing.assert_array_equal(truth.points[25:], train.motion.points[clip])
        np.testing.assert_array_equal(asked.rotations[25:], planted.poses([A, B, C]).rotations[clip])
        np.testing.assert_array_equal(asked.clip_start, truth.clip_start)


def test_fewer_runs_than_clips_take_clips_that_lie_evenly(unseen):
    clips = [planted.gesture(10, seed) for seed in range(4)]
    train, query = planted.training(clips), planted.poses([UNSEEN])
    for run, clip in enumerate(("clip0", "clip2")):
        truth = leave_out(train.motion, unseen, train.skinning, planted.poses(clips), query, run=run, runs=2)[-1]
        assert truth.clip_names[-1] == f"{clip} (left out)"


def test_one_long_clip_gives_up_stretches(train, unseen):
    motion = train.motion.take_frames([slice(0, 90)], ["all"])
    poses = planted.poses([A, B, C])
    whole = type(poses)(poses.rotations, poses.translations, np.array([0, 90]))
    lengths = []
    for run in range(3):
        rest, *_, truth = leave_out(motion, unseen, train.skinning, whole, planted.poses([UNSEEN]), run=run, runs=3)
        lengths.append(np.diff(rest.clip_start).tolist())
        np.testing.assert_array_equal(truth.points[25:], motion.points[30 * run : 30 * run + 30])
    assert lengths == [[60], [30, 30], [60]]


def test_more_runs_than_clips_are_refused(train, unseen):
    with pytest.raises(InputError, match=r"evaluate\.left_out.*3 training clips.*4"):
        left_out(train, unseen, 0, runs=4)


def test_one_clip_has_no_more_stretches_than_frames_and_gives_up_no_more_than_it_has(train, unseen):
    lone = replace(train, motion=train.motion.take_clips([0]))
    for runs in (1, lone.motion.frames + 1):
        with pytest.raises(InputError, match=rf"evaluate\.left_out.*2 to {lone.motion.frames} stretches"):
            left_out(lone, unseen, 0, runs=runs)


def test_errors_of_the_unseen_and_of_the_clip_left_out_are_told_apart(unseen):
    held = np.zeros((10, *unseen.points.shape[1:]), np.float32)
    points = np.concatenate([unseen.points, held])
    truth = Motion("t", points, None, np.array([0, 25, 35]), ("unseen", "held"), 30.0)
    off = points.copy()
    off[:25, :, 0] += 0.3
    off[25:, :, 1] -= 0.4
    scores = evaluate_left_out(Animation(off), truth, unseen)
    np.testing.assert_allclose(scores.values, [0.3, 0.4], rtol=1e-5)
    other = Metrics(scores.names, scores.units, np.array([0.5, 0.8]))
    found = spread({"run_0": scores, "run_1": other})
    np.testing.assert_allclose(found.values, [0.2 / np.sqrt(2), 0.6, 0.4 / np.sqrt(2)], rtol=1e-4)


def test_the_floor_is_below_the_bones_own_error(train):
    floor = compression_floor(train.motion, train.skinning)
    assert vertex_rmse(floor.points, train.motion.points) < 1e-4  # the planted bones explain the motion exactly


def test_gains_are_of_means_over_seeds_and_printed_ones_of_printed_numbers():
    columns = ["dataset", "subject", "method", "variant", "metric", "value", "unit", "seed"]
    data = [("a", 0, 8.0), ("b", 0, 9.0), ("b", 1, 11.0), ("floor", 0, 1.0)]
    rows = pd.DataFrame([("d", "s", m, "", "rmse", v, "mm", seed) for m, seed, v in data], columns=columns)
    found = gains(rows, "a", without=["floor"])
    assert found[["method", "metric", "unit"]].values.tolist() == [["b", "gain_pct", "%"]]
    assert found["value"].tolist() == pytest.approx([20.0])
    cells = [PaperCell(3, m, "vto", "dress", "rmse", v, "mm", r) for m, v, r in (("a", 36.7, "clear"),
             ("b", 52.2, "clear"), ("c", None, "lost"))]  # fmt: skip
    made = printed_gains(Paper("p", {}, {}, {}, tuple(cells)), 3, "a").cells
    assert [(c.method, c.value) for c in made] == [("b", 29.7), ("c", None)]
