"""Joint scores on sets worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest

from tasks.errors import InputError
from tasks.evaluation.joints import counting_joints, joint_scores, link_f1, sample_bones
from tasks.geometry.rotations import from_rotation_vector
from tasks.values import Rig

LINE = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]])
CHAIN = np.array([-1, 0, 1])


def test_the_truth_scores_full_marks():
    scores = joint_scores(LINE, CHAIN, LINE, CHAIN, 10.0)
    assert all(scores[k] == 1.0 for k in ("precision", "recall", "f1", "f1_fine", "link_f1"))
    assert scores["j2j"] == scores["j2b"] == scores["b2b"] == 0.0


def test_precision_recall_and_f1_by_hand():
    # two of four estimates lie within 5 % of 10 = 0.5 (at 0.3 and 0.4), one of those within 2.5 % = 0.25 does not
    estimate = np.array([[0.3, 0, 0], [1.4, 0, 0], [2, 3, 0], [2, 5, 0]])
    scores = joint_scores(estimate, np.array([-1, 0, 1, 2]), LINE, CHAIN, 10.0)
    assert scores["precision"] == pytest.approx(2 / 4)
    assert scores["recall"] == pytest.approx(2 / 3)
    assert scores["f1"] == pytest.approx(4 / 7)
    assert scores["f1_fine"] == 0.0


def test_two_estimates_cannot_share_one_joint():
    scores = joint_scores(np.array([[0.0, 0, 0], [0.01, 0, 0]]), np.array([-1, 0]), LINE[:1], CHAIN[:1], 10.0)
    assert scores["precision"] == 0.5
    assert scores["recall"] == 1.0


def test_chamfer_distances_by_hand():
    # estimate: the two ends of the line's first half; truth: the whole line
    scores = joint_scores(LINE[:2], CHAIN[:2], LINE, CHAIN, 10.0)
    assert scores["j2j"] == pytest.approx(10.0 * 0.5 * (0.0 + 1.0 / 3.0))
    assert scores["j2b"] == pytest.approx(10.0 * 0.5 * (0.0 + 1.0 / 3.0))
    # of the truth's points half are covered, the others lie 0..1 away, 0.5 in the mean
    assert scores["b2b"] == pytest.approx(10.0 * 0.5 * 0.25, rel=0.03)


def test_joint_to_bone_is_zero_for_a_joint_in_the_middle_of_a_bone():
    estimate = np.array([[0.0, 0, 0], [0.7, 0, 0], [2, 0, 0]])
    scores = joint_scores(estimate, CHAIN, LINE, CHAIN, 10.0)
    assert scores["j2b"] < 0.03
    assert scores["j2j"] > 0.5


def test_links_ignore_direction_and_unmatched_joints_between():
    everything = np.arange(3)
    assert link_f1(np.array([1, 2, -1]), CHAIN, everything, everything) == 1.0  # root at the other end
    assert link_f1(np.array([-1, 0, 0]), CHAIN, everything, everything) == pytest.approx(0.5)
    ends = np.array([0, 2])
    assert link_f1(CHAIN, CHAIN, ends, ends) == 1.0  # the middle joint is skipped on both sides


def test_bones_are_sampled_to_the_spacing():
    points = sample_bones(LINE[:2], CHAIN[:2], 0.3)
    assert np.diff(np.sort(points[:, 0])).max() <= 0.3
    assert len(sample_bones(LINE[:1], CHAIN[:1], 0.3)) == 1


def test_joints_that_do_not_turn_or_move_no_skin_do_not_count():
    turn = np.zeros((2, 5, 3))
    turn[1, :, 2] = np.radians([0.0, 20.0, 2.0, 20.0, 30.0])
    weights = np.eye(5)
    weights[3] = [1, 0, 0, 0, 0]
    rig = Rig(
        ("still", "turns", "turns too little", "moves no skin", "turns as well"),
        np.array([-1, 0, 1, 2, 3], np.int32),
        np.arange(15.0).reshape(5, 3),
        weights,
        from_rotation_vector(turn),
        np.zeros((2, 5, 3)),
    )
    joints, parents = counting_joints(rig, 5.0)
    assert joints.tolist() == [[3.0, 4.0, 5.0], [12.0, 13.0, 14.0]]
    assert parents.tolist() == [-1, 0]


def test_an_empty_skeleton_is_refused():
    with pytest.raises(InputError, match="at least one"):
        joint_scores(np.zeros((0, 3)), np.zeros(0, int), LINE, CHAIN, 1.0)
