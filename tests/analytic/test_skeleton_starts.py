"""Where poses and owners start from in cases that leave something open."""

from __future__ import annotations

import numpy as np

from tasks.geometry import kinematics
from tasks.geometry.moments import skin_moments
from tasks.geometry.rotations import from_rotation_vector, geodesic
from tasks.geometry.skinning import skin
from tasks.skeleton.inverse_kinematics import warm_start
from tasks.skeleton.joints_gradient import owners
from tasks.skeleton.refit import fit_joints


def test_a_rod_that_does_not_tell_its_turn_about_itself_turns_with_its_parent():
    """A block with a rod of points on one line: any turn about the line fits the rod as well."""
    rng = np.random.default_rng(0)
    block = rng.uniform(-0.5, 0.5, (200, 3))
    rod = np.stack([np.linspace(0.5, 1.5, 50), np.zeros(50), np.zeros(50)], axis=1)
    rest, weights = np.concatenate([block, rod]), np.repeat(np.eye(2), (200, 50), axis=0)
    turns = from_rotation_vector(np.array([[0.0, 0.0, 0.0], [1.2, 0.3, -0.4], [0.2, -2.0, 0.9]]))
    shift = np.array([[0.0, 0.0, 0.0], [1.0, 2.0, 0.5], [-3.0, 0.0, 1.0]])
    points = rest @ np.swapaxes(turns, 1, 2) + shift[:, None]
    joints = np.array([[0.0, 0.0, 0.0], [0.5, 0.0, 0.0]])
    world, root = warm_start(np.array([-1, 0]), joints, skin_moments(rest, weights, points), 0.01)
    assert np.degrees(geodesic(world, turns[:, None])).max() < 0.1
    np.testing.assert_allclose(root, shift, atol=1e-6)


def test_of_one_joint_that_is_all_there_is_every_node_is_its_own():
    nodes = np.stack([np.arange(4.0), np.zeros(4), np.zeros(4)], axis=1)
    edges = np.array([[0, 1], [1, 2], [2, 3]])
    assert owners(nodes, edges, np.array([2]), np.array([-1], np.int32)).tolist() == [0, 0, 0, 0]


def test_joints_come_back_for_true_rotations_from_wrong_places():
    rng = np.random.default_rng(1)
    parents = np.array([-1, 0, 1])
    true = np.array([[0.0, 0.0, 0.0], [1.0, 0.1, 0.0], [2.0, -0.2, 0.1]])
    rest = rng.uniform([-0.5, -0.3, -0.3], [3.0, 0.3, 0.3], (300, 3))
    weights = np.eye(3)[np.clip(rest[:, 0], 0, 2).astype(int)]
    local = from_rotation_vector(rng.normal(0, 0.7, (40, 3, 3)))
    shift = np.zeros((40, 3, 3))
    shift[:, 0] = rng.normal(size=(40, 3))
    transforms = kinematics.forward(parents, true, local, shift)
    moments = skin_moments(rest, weights, skin(rest, weights, transforms))
    wrong = true + np.array([[0.0, 0.0, 0.0], [0.1, -0.2, 0.1], [-0.15, 0.1, 0.2]])
    how = {"anchor": wrong, "reach": 1.0, "hold": 1e-6}
    found, root = fit_joints(parents, wrong, moments, transforms[..., :3], shift[:, 0] + 0.3, **how)
    np.testing.assert_allclose(found, true, atol=2e-3)
    np.testing.assert_allclose(root, shift[:, 0], atol=2e-3)
