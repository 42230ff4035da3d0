"""What is said about a pose before any method answers it."""

from __future__ import annotations

import numpy as np
import pytest

from tasks.drawing.confidence import confidence_picture
from tasks.evaluation.confidence import confidence_file, evaluate_confidence
from tasks.methods import partmm
from tasks.motion import confidence as module
from tasks.motion.confidence import confidence
from tasks.values import Animation, Confidence, Poses
from tests.analytic import planted
from tests.analytic.test_methods import PAPER

CLIPS = [planted.gesture(60, seed, amplitude) for seed, amplitude in ((1, 0.3), (2, 0.4), (3, 0.5), (4, 0.4))]
SETTINGS = {"k": 3, "patch": 5, "dynamics": 0.0}


@pytest.fixture(scope="module")
def train():
    return planted.training(CLIPS)


def test_training_frames_are_their_own_sources_and_nothing_lies_farther_than_a_wild_pose(train):
    same = confidence(train, planted.poses(CLIPS), **SETTINGS)
    np.testing.assert_array_equal(same.windows[:, :, 0], np.arange(240)[:, None].repeat(len(train.parts.names), 1))
    assert same.distance[:, :, 0].max() < 1e-5
    assert same.parts == train.parts.names
    wild = confidence(train, planted.poses([planted.gesture(30, 9, 2.0)]), **SETTINGS)
    assert wild.outside.mean() > 0.95 > same.outside.mean()
    assert wild.expected.min() > np.median(same.expected)


def test_a_frame_is_judged_by_the_window_with_it_in_the_middle(train):
    """30 frames of training and then wild ones: with windows of 5, the first 28 frames see none of the wild."""
    mixed = np.concatenate([CLIPS[0][:30], planted.gesture(30, 9, 2.0)])
    nearest = confidence(train, planted.poses([mixed]), **SETTINGS).distance[:, :, 0]
    assert nearest[:28].max() < 1e-5 < nearest[28:].min()


def test_it_is_calibrated_by_clips_left_out(train):
    """Motions of the training's own kind spread over the whole scale."""
    query = planted.poses([planted.gesture(60, seed, 0.4) for seed in range(20, 28)])
    found = confidence(train, query, **SETTINGS)
    assert 0.3 < found.outside.mean() < 0.8
    true = np.sqrt(
        ((partmm.animate(train, query, **PAPER | {"represent": "residual"}).points - planted.truth(train, query)) ** 2)
        .sum(2)
        .mean(1)
    )
    assert 0.5 < np.median(found.expected) / np.median(true) < 2.0


def test_its_rank_correlation_is_reported_and_files_name_the_sources(train):
    test = planted.training([planted.gesture(30, 9, 0.8), planted.gesture(20, 8, 0.4)]).motion
    query = planted.poses([planted.gesture(30, 9, 0.8), planted.gesture(20, 8, 0.4)])
    found = confidence(train, query, **SETTINGS)
    off = test.points + found.expected[:, None, None] * np.array([0.0, 1.0, 0.0], np.float32)
    named = dict(zip(*(lambda m: (m.names, m.values))(evaluate_confidence(found, Animation(off), test)), strict=True))
    assert named["confidence_spearman"] == pytest.approx(1.0, abs=1e-3)  # float32 points
    assert {"outside_pct", "outside_pct@clip0", "outside_pct@clip1"} < set(named)
    apart = [named[f"query_distance@clip1, {part}"] for part in found.parts]
    np.testing.assert_allclose(apart, np.degrees(found.distance[30:].mean((0, 2))), rtol=1e-5)
    text = bytes(confidence_file(found, test, train.motion, name="planted").content).decode().splitlines()
    assert len(text) == 1 + 50 * len(train.parts.names)
    first = dict(zip(text[0].split(","), text[1].split(","), strict=True))
    clip, frame = first["source_1"].split(":")
    assert 60 * int(clip.removeprefix("clip")) + int(frame) == found.windows[0, 0, 0]
    assert "expected" in confidence_picture(found, {"mine": Animation(off)}, test).svg


def test_clips_shorter_than_a_window_calibrate_nothing(train):
    """Where all other clips are too short there is nothing to be matched with: the long clip is left aside."""
    short = planted.training([CLIPS[0], CLIPS[1][:3], CLIPS[2][:2]])
    query = planted.poses([planted.gesture(30, 9)])
    found = confidence(short, query, **SETTINGS)
    assert np.isfinite(found.expected).all()
    assert found.expected.min() > 0  # the short clips were judged by the long one
    for few in ([CLIPS[0]], [CLIPS[0], CLIPS[1][:1]]):
        assert not confidence(planted.training(few), query, **SETTINGS).expected.any()


def test_where_near_matches_were_worse_than_far_ones_distance_is_no_warning(train, monkeypatch):
    """An error that falls with the distance would promise that the wildest pose is met best."""

    def backwards(training, known, windows, frames):
        clips = range(len(known.poses.clip_start) - 1)
        apart = [module._look(known, known.poses, c, SETTINGS["k"], SETTINGS["patch"], 0.0, c)[1] for c in clips]
        return 0.01 / np.concatenate(apart).mean((1, 2))

    query = planted.poses([planted.gesture(30, 9, 0.4), planted.gesture(30, 9, 2.0)])
    monkeypatch.setattr(module, "_errors", backwards)
    expected = confidence(train, query, **SETTINGS).expected
    assert np.ptp(expected) == 0
    assert expected[0] > 0


def test_one_clip_leaves_nothing_to_judge_by(train):
    alone = planted.training(CLIPS[:1])
    found = confidence(alone, planted.poses(CLIPS[1:2]), **SETTINGS)
    assert not found.expected.any()
    said = evaluate_confidence(found, Animation(train.motion.points[60:120]), train.motion.take_clips([1])).names
    assert all(name.startswith("query_distance@") for name in said)


def test_clips_shorter_than_a_patch_are_padded(train):
    poses = planted.poses(CLIPS)
    short = Poses(poses.rotations[:3], poses.translations[:3], np.array([0, 3]))
    assert len(confidence(train, short, **SETTINGS).expected) == 3


def test_outside_counts_the_frames_beyond_95_percent_clip_by_clip(train):
    test = train.motion.take_frames([slice(0, 4), slice(60, 66)], ["near", "far"])
    outside = np.array([0.0, 0.5, 0.95, 0.96, 1.0, 1.0, 0.99, 0.2, 0.94, 1.0], np.float32)
    told = Confidence(
        np.zeros((10, 1, 1), np.int32), np.full((10, 1, 1), 0.5, np.float32), np.ones(10, np.float32), outside, ("all",)
    )
    found = evaluate_confidence(told, Animation(test.points), test)
    named = dict(zip(found.names, found.values, strict=True))
    assert named["outside_pct"] == pytest.approx(50.0)
    assert named["outside_pct@near"] == pytest.approx(25.0)
    assert named["outside_pct@far"] == pytest.approx(100.0 * 4 / 6)
    assert named["query_distance@far, all"] == pytest.approx(np.degrees(0.5), rel=1e-6)
    assert "confidence_spearman" not in named  # an expectation that never changes ranks nothing
