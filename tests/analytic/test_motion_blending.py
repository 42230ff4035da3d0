"""Blend weights, the alignment rotation and dynamics, each against its definition."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tasks.geometry import rigid
from tasks.geometry.rotations import from_rotation_vector, project_so3, to_quaternion
from tasks.motion.blending import PartMotion, Sources, blend, level_shares, window_weights
from tasks.motion.dynamics import root_dynamics
from tasks.motion.matching import _strides
from tasks.motion.posed import Posed, centroids
from tasks.motion.projection import mean_turn, project
from tests.analytic import planted


def test_level_shares_follow_the_recursion():
    value, matched = None, np.array([5.0, -2.0, 3.0, 7.0])
    for x in matched:
        value = x if value is None else (1 - 0.7) * value + 0.7 * x
    assert np.isclose(level_shares(4, 0.7) @ matched, value)
    assert np.isclose(level_shares(5, 0.7).sum(), 1)


def test_window_weights_collapse_on_an_exact_match_and_ignore_missing_windows():
    exact = window_weights(np.array([0.0, 0.01, 0.2]), 1.0)
    np.testing.assert_allclose(exact, [1, 0, 0], atol=1e-6)
    np.testing.assert_allclose(window_weights(np.array([0.3, 0.3, np.inf]), 1.0), [0.5, 0.5, 0])
    assert np.all(window_weights(np.full(3, np.inf), 1.0) == 0)


def test_mean_turn_is_the_projected_sum_of_rotations():
    rng = np.random.default_rng(0)
    turn = from_rotation_vector(rng.normal(size=3))
    b = from_rotation_vector(rng.normal(size=(6, 3)))
    a = turn @ b @ from_rotation_vector(0.3 * rng.normal(size=(6, 3)))
    out = np.empty((3, 3))
    mean_turn(to_quaternion(a), to_quaternion(b), out)
    np.testing.assert_allclose(out, project_so3((a @ b.swapaxes(-1, -2)).sum(0)), atol=1e-6)


def test_projection_is_the_nearest_rotation():
    rng = np.random.default_rng(3)
    turns = from_rotation_vector(rng.normal(size=(50, 3)))
    blends = np.concatenate([turns + 0.3 * rng.normal(size=turns.shape), 1e-3 * turns, rng.normal(size=turns.shape)])
    clear = np.linalg.svd(blends, compute_uv=False)[:, 1] > 0.05 * np.linalg.norm(blends, axis=(1, 2))
    np.testing.assert_allclose(project(blends)[clear], project_so3(blends)[clear], atol=1e-6)
    np.testing.assert_allclose(project(turns), turns, atol=1e-12)
    np.testing.assert_allclose(project(turns + 1e-3 * blends[:50]), project_so3(turns + 1e-3 * blends[:50]), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(project(np.zeros((1, 3, 3)))), 1)  # no answer: still a rotation


def test_alignment_turns_about_the_anchor_and_carries_it_along():
    rng = np.random.default_rng(1)
    joints = from_rotation_vector(rng.normal(size=(1, 3, 3)))
    turn, anchor, moved = from_rotation_vector(rng.normal(size=3)), rng.normal(size=3), rng.normal(size=3)
    bones = rigid.make(from_rotation_vector(rng.normal(size=(1, 2, 3))), rng.normal(size=(1, 2, 3)))
    source = Sources(np.zeros((1, 1), np.int32), np.ones((1, 1)), np.ones(1, np.int64))
    got = blend(
        source,
        bones,
        np.arange(2),
        PartMotion(to_quaternion(turn @ joints), moved[None]),
        PartMotion(to_quaternion(joints), anchor[None]),
    )
    want = rigid.make(turn @ bones[0, :, :, :3], (bones[0, :, :, 3] - anchor) @ turn.T + moved)
    np.testing.assert_allclose(got[0], want, atol=1e-9)


@pytest.mark.parametrize("represent", ["root", "residual"])
def test_frames_of_bones_go_back_to_the_same_transforms(represent):
    train = planted.training([planted.gesture(20, 1)])
    posed = Posed(train, train.database.poses)
    frames = posed.encode(train.database.bones, represent)
    np.testing.assert_allclose(posed.decode(frames, represent), train.database.bones, atol=1e-5)


def test_bones_that_follow_the_skin_have_no_residual():
    train = planted.training([planted.gesture(20, 1)])
    eye = np.eye(16, dtype=np.float32)[np.repeat(np.arange(16), 12)]
    stiff = replace(train, skeleton=replace(train.skeleton, weights=eye), skinning=replace(train.skinning, weights=eye))
    posed = Posed(stiff, train.database.poses)
    residual = posed.encode(posed.world, "residual")
    np.testing.assert_allclose(residual, np.broadcast_to(np.eye(3, 4), residual.shape), atol=1e-6)


def test_a_centroid_is_the_mean_of_the_points_that_a_bone_moves():
    rng = np.random.default_rng(2)
    rest, weights = rng.normal(size=(20, 3)), rng.dirichlet(np.ones(4), 20)
    weights[:, 3] = 0
    centres = centroids(rest, weights)
    np.testing.assert_allclose(centres[1], (weights[:, 1] @ rest) / weights[:, 1].sum())
    np.testing.assert_allclose(centres[3], rest.mean(0))


def test_dynamics_of_a_falling_spinning_root():
    fps, frames = 50.0, 40
    time = np.arange(frames) / fps
    spin = np.array([0.0, 2.0, 0.0])  # rad/s about the axis up
    rotation = from_rotation_vector(time[:, None] * spin)
    pivot = np.array([0.3, 1.0, 0.2])
    position = np.stack([0 * time, 5 - 4.905 * time**2, 0 * time], -1)
    root = rigid.make(rotation, position - rotation @ pivot)
    got = root_dynamics(root, pivot, np.array([0, frames]), fps)
    np.testing.assert_allclose(got[:, 0], np.tile([0.0, 1, 0], (frames, 1)), atol=1e-12)
    np.testing.assert_allclose(got[1:-1, 1, 1], -9.81 * time[1:-1], atol=1e-9)
    np.testing.assert_allclose(got[2:-2, 2], np.tile([0, -9.81, 0], (frames - 4, 1)), atol=1e-9)
    np.testing.assert_allclose(got[:, 3], np.tile(spin, (frames, 1)), atol=1e-9)


def test_angular_velocity_is_central_where_a_spin_speeds_up():
    fps, frames = 50.0, 20
    time = np.arange(frames) / fps
    rotation = from_rotation_vector(3.0 * time[:, None] ** 2 * np.array([0.0, 0.0, 1.0]))  # 6 t rad/s
    root = rigid.make(rotation, np.zeros((frames, 3)))
    got = root_dynamics(root, np.zeros(3), np.array([0, frames]), fps)[:, 3, 2]
    np.testing.assert_allclose(got[1:-1], 6.0 * time[1:-1], atol=1e-9)


def test_dynamics_do_not_reach_over_a_cut():
    root = rigid.identity(6, dtype=float)
    root[3:, 0, 3] = 100.0  # a jump exactly at the cut
    assert np.all(root_dynamics(root, np.zeros(3), np.array([0, 3, 6]), 30.0)[:, 1:] == 0)


@pytest.mark.parametrize("patch", [1, 3, 7])
def test_the_coarsest_windows_still_reach_every_frame(patch):
    """min(levels, 1 + floor(log2(F / p))) levels (eq. 10): windows fit into the clip, and none of its frames is left
    out between them."""
    for frames in range(patch, 150):
        strides = _strides(frames, patch, 5)
        assert strides == sorted((2**i for i in range(len(strides))), reverse=True)
        assert 2 ** (len(strides) - 1) * patch <= frames
        assert len(strides) == 5 or 2 ** len(strides) * patch > frames
        for stride in strides:
            first = np.arange(frames - (patch - 1) * stride)
            assert len(np.unique(first[:, None] + stride * np.arange(patch))) == frames


def test_dynamics_count_in_the_body_s_own_size():
    """A character ten times as large that does the same is no different to matching."""
    train = planted.training([planted.gesture(30, 1)])
    known = train.database.poses
    larger = replace(
        train,
        canonical=replace(train.canonical, points=10 * train.canonical.points),
        skeleton=replace(train.skeleton, joints=10 * train.skeleton.joints),
        skinning=replace(train.skinning, rest=10 * train.skinning.rest),
    )
    moved = replace(known, translations=10 * known.translations)
    found = Posed(larger, moved).dynamics
    np.testing.assert_allclose(found, Posed(train, known).dynamics, rtol=1e-4, atol=1e-5)
    assert np.abs(found[:, 1:]).max((0, 2)).min() > 1e-3  # and none of them is zero
