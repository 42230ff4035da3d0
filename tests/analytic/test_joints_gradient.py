"""The paper's joints (GA eq. 5) on curves worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest

from tasks.geometry import kinematics
from tasks.geometry.measure import vertex_rmse
from tasks.geometry.skinning import skin
from tasks.skeleton.curve_weights import node_weights, onto_surface, thin, vertex_areas
from tasks.skeleton.joints_gradient import joints_by_gradient, maxima, owners, transition
from tasks.skeleton.poses import fit_poses
from tasks.values import Canonical, Curve
from tests.analytic.jointed_shapes import RADIUS, ball_joint, straight_curve
from tests.shipped import shipped

SETTINGS = shipped("skeleton.gradient")


def find(shape, **changed):
    inputs = (shape.motion, shape.canonical, shape.skinning, shape.surface, shape.curve)
    return joints_by_gradient(*inputs, **(SETTINGS | changed))


def test_a_hard_change_has_gradient_one_and_a_slow_one_its_slope():
    hard = np.repeat([[1.0, 0.0], [0.0, 1.0]], 5, axis=0)
    assert transition(hard).tolist() == [0, 0, 0, 0, 1, 1, 0, 0, 0, 0]
    ramp = np.linspace(0.0, 1.0, 11)
    np.testing.assert_allclose(transition(np.stack([ramp, 1 - ramp], 1))[1:-1], 0.2)


def test_a_plateau_gives_one_joint_in_its_middle():
    assert maxima(np.array([0.0, 0.5, 0.9, 0.9, 0.9, 0.5, 0.0]), 0.3).tolist() == [3]
    assert maxima(np.array([0.0, 0.5, 0.2, 0.4, 0.2, 0.25, 0.0]), 0.3).tolist() == [1, 3]
    assert len(maxima(np.array([0.0, 0.2, 0.0]), 0.3)) == 0


def test_the_bend_of_a_capsule_is_a_joint_between_two_end_effectors():
    shape = ball_joint()
    skeleton = find(shape)
    assert sorted(np.round(skeleton.joints[:, 0], 1).tolist()) == [0.0, 1.0, 2.0]
    middle = np.abs(skeleton.joints[:, 0] - 1.0).argmin()
    np.testing.assert_allclose(skeleton.joints[middle], [1.0, 0.0, 0.0], atol=0.03)
    assert middle == 0  # nearest the centroid
    assert skeleton.parents.tolist() == [-1, 0, 0]


def test_the_root_turns_one_side_only_and_leaves_own_nothing():
    """The root lies at the bend, both its children are leaves: one rigid piece remains, as in the paper."""
    skeleton = find(ball_joint())
    assert (skeleton.weights.sum(axis=0) > 0).tolist() == [True, False, False]
    np.testing.assert_allclose(skeleton.weights.sum(axis=1), 1.0, atol=1e-6)


def test_poses_of_a_skeleton_with_end_effectors_stay_finite():
    shape = ball_joint()
    skeleton = find(shape)
    poses = fit_poses(shape.motion, shape.canonical, skeleton, **shipped("skeleton.poses"))
    assert np.isfinite(poses.rotations).all()
    transforms = kinematics.forward(skeleton.parents, skeleton.joints, poses.rotations, poses.translations)
    still = vertex_rmse(np.broadcast_to(shape.motion.points.mean(0), shape.motion.points.shape), shape.motion.points)
    assert vertex_rmse(skin(shape.canonical.points, skeleton.weights, transforms), shape.motion.points) < 0.2 * still


def test_every_node_belongs_to_the_joint_above_it():
    nodes = np.stack([np.arange(7.0), np.zeros(7), np.zeros(7)], axis=1)
    edges = np.stack([np.arange(6), np.arange(1, 7)], axis=1)
    # joints at 3 (root), 5, 0 and 6: 0 and 6 are leaves
    owner = owners(nodes, edges, np.array([3, 5, 0, 6]), np.array([-1, 0, 0, 1]))
    assert owner.tolist() == [0, 0, 0, 0, 0, 1, 1]


def test_weights_reach_the_surface_and_the_curve():
    shape = ball_joint()
    carry = onto_surface(shape.canonical, shape.surface)
    np.testing.assert_allclose(carry.carry(shape.weights), shape.weights, atol=1e-6)
    bare = Canonical(shape.canonical.points, None, -1, "planted")
    np.testing.assert_allclose(onto_surface(bare, shape.surface).carry(shape.weights), shape.weights, atol=1e-3)
    on_curve = node_weights(shape.curve, shape.weights)
    assert on_curve[10].tolist() == [1.0, 0.0]
    assert on_curve[70].tolist() == [0.0, 1.0]


def test_nodes_that_nothing_collapsed_onto_take_their_neighbours_weights():
    points = np.zeros((2, 3))
    curve = straight_curve(points, 2.0, 5)
    of = np.array([0, 4], np.int32)
    curve = Curve(curve.nodes, curve.edges, of, of)
    on_curve = node_weights(curve, np.eye(2))
    np.testing.assert_allclose(on_curve[:, 0], [1.0, 1.0, 0.5, 0.0, 0.0])


def test_areas_sum_to_the_tube_and_thinning_covers_the_curve():
    shape = ball_joint()
    chord = 2.0 * RADIUS * np.sin(np.pi / 16)
    tube, cap = 16 * chord * 2.0, 0.5 * 16 * chord * np.hypot(RADIUS, RADIUS * np.cos(np.pi / 16))
    assert vertex_areas(shape.surface).sum() == pytest.approx(tube + 2.0 * cap, rel=1e-3)
    chosen = thin(shape.canonical, shape.surface, shape.curve, 100)
    assert len(chosen) <= 100
    gaps = np.diff(np.sort(shape.canonical.points[chosen, 0]))
    assert gaps.max() < 1.1 * RADIUS  # the tips are the farthest from their neighbours
