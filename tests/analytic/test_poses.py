"""Inverse kinematics against planted poses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tasks.errors import InputError
from tasks.geometry import kinematics, rigid
from tasks.geometry.measure import diagonal, vertex_rmse
from tasks.geometry.moments import fit_rigid, skin_error, skin_moments
from tasks.geometry.rotations import from_rotation_vector, geodesic
from tasks.geometry.skinning import skin
from tasks.skeleton.given import given_poses, given_skeleton
from tasks.skeleton.inverse_kinematics import solve_poses, transforms_of, world_moments
from tasks.skeleton.poses import fit_poses
from tasks.values import Canonical, Motion, Rig, Skeleton
from tests.analytic.jointed_shapes import Bending, ball_joint

SETTINGS = {"steps": 6, "damping": 1e-4, "stiffness": 0.01}


def chain(seed: int = 0, amplitude: float = 0.5) -> Bending:
    rng = np.random.default_rng(seed)
    turns = rng.uniform(-amplitude, amplitude, (30, 4, 3))
    return Bending(4.0, [0.0, 1.0, 2.0, 3.0], turns, rng.normal(size=(30, 3)), 0.1)


def skeleton_of(shape: Bending) -> Skeleton:
    names = tuple(f"joint_{j:02d}" for j in range(len(shape.parents)))
    return Skeleton(names, shape.parents, shape.joints.astype(np.float32), shape.weights)


@pytest.mark.parametrize("amplitude", [0.1, 0.5, 0.8])
def test_planted_poses_come_back(amplitude):
    shape = chain(amplitude=amplitude)
    poses = fit_poses(shape.motion, shape.canonical, skeleton_of(shape), **SETTINGS)
    assert np.degrees(geodesic(poses.rotations, shape.rotations)).max() < 0.5
    transforms = kinematics.forward(shape.parents, shape.joints, poses.rotations, poses.translations)
    posed = skin(shape.canonical.points, shape.weights, transforms)
    assert vertex_rmse(posed, shape.motion.points) < 1e-4 * diagonal(shape.canonical.points)


def test_a_translation_of_the_whole_is_carried_by_the_root_alone():
    shape = chain(amplitude=0.0)
    poses = fit_poses(shape.motion, shape.canonical, skeleton_of(shape), **SETTINGS)
    shift = shape.motion.points.mean(axis=1) - shape.canonical.points.mean(axis=0)
    np.testing.assert_allclose(poses.translations[:, 0], shift, atol=1e-4)
    assert np.all(poses.translations[:, 1:] == 0.0)
    assert np.degrees(geodesic(poses.rotations, np.eye(3, dtype=np.float32))).max() < 0.1


def test_poses_far_from_the_origin_are_as_good():
    shape = chain()
    far = np.array([300.0, -200.0, 100.0], np.float32)
    motion = Motion("far", shape.motion.points + far, None, shape.motion.clip_start, shape.motion.clip_names, 24.0)
    canonical = Canonical(shape.canonical.points + far, None, -1, "planted")
    skeleton = skeleton_of(shape)
    skeleton = Skeleton(skeleton.names, skeleton.parents, skeleton.joints + far, skeleton.weights)
    poses = fit_poses(motion, canonical, skeleton, **SETTINGS)
    assert np.degrees(geodesic(poses.rotations, shape.rotations)).max() < 0.5


def test_slow_motion_does_not_flip_between_frames():
    angle = np.linspace(0.0, 2.0 * np.pi, 60)
    turns = np.zeros((60, 4, 3))
    turns[:, 0, 1] = angle  # the root turns right round, through the half turn where Procrustes could change its mind
    turns[:, 1:, 2] = 0.4 * np.sin(3.0 * angle)[:, None]
    shape = Bending(4.0, [0.0, 1.0, 2.0, 3.0], turns, np.zeros((60, 3)), 0.1)
    poses = fit_poses(shape.motion, shape.canonical, skeleton_of(shape), **SETTINGS)
    step = np.degrees(geodesic(poses.rotations[1:], poses.rotations[:-1]))
    assert step.max() < 9.0


def test_gauss_newton_step_agrees_with_differences_of_the_error():
    shape = chain()
    rest = shape.canonical.points.astype(np.float64)
    moments = skin_moments(rest, shape.weights, shape.motion.points[:3])
    rng = np.random.default_rng(1)
    world = from_rotation_vector(rng.uniform(-0.3, 0.3, (3, 4, 3)))
    root = rng.normal(size=(3, 3))
    transforms = transforms_of(shape.parents, shape.joints, world, root)
    a, c = world_moments(shape.parents, moments, transforms)
    place = kinematics.joint_positions(transforms, shape.joints)
    g = c[:, :, :3] - place[..., None] * c[:, :, 3:]
    turn = np.stack([g[..., 1, 2] - g[..., 2, 1], g[..., 2, 0] - g[..., 0, 2], g[..., 0, 1] - g[..., 1, 0]], axis=-1)
    h = 1e-5
    for j in range(4):
        for axis in range(3):
            error = []
            for sign in (1.0, -1.0):
                small = np.zeros(3)
                small[axis] = sign * h
                moved = world.copy()
                moved[:, j:] = from_rotation_vector(small) @ moved[:, j:]  # a chain: the subtree is what follows
                error.append(skin_error(moments, transforms_of(shape.parents, shape.joints, moved, root)))
            slope = (error[0] - error[1]) / (2.0 * h)
            np.testing.assert_allclose(2.0 * turn[:, j, axis], slope, rtol=1e-4, atol=1e-3)
    np.testing.assert_allclose(a[:, 0, 0, 3, 3], np.sum(shape.weights.sum(1) ** 2), rtol=1e-6)


def test_moments_give_the_same_error_as_the_points():
    shape = chain()
    rng = np.random.default_rng(2)
    wrong = shape.transforms + 0.1 * rng.normal(size=shape.transforms.shape)
    moments = skin_moments(shape.canonical.points, shape.weights, shape.motion.points)
    posed = skin(shape.canonical.points, shape.weights, wrong)
    plain = np.sum((posed.astype(np.float64) - shape.motion.points) ** 2, axis=(1, 2))
    np.testing.assert_allclose(skin_error(moments, wrong), plain, rtol=1e-4)
    assert skin_error(moments, shape.transforms).max() < 1e-6 * plain.min()


def test_rigid_sweeps_reach_planted_transforms():
    shape = chain()
    moments = skin_moments(shape.canonical.points, shape.weights, shape.motion.points)
    start = np.tile(np.eye(3, 4), (30, 4, 1, 1))
    found = fit_rigid(moments, start, 200)
    assert skin_error(moments, found).max() < 1e-3 * skin_error(moments, start).max()


def test_more_steps_never_raise_the_error():
    shape = ball_joint()
    moments = skin_moments(shape.canonical.points, shape.weights, shape.motion.points)
    world = np.tile(np.eye(3), (40, 2, 1, 1))
    root = np.zeros((40, 3))
    error = []
    for steps in range(6):
        w, r = solve_poses(shape.parents, shape.joints, moments, world, root, steps=steps, damping=1e-4)
        error.append(skin_error(moments, transforms_of(shape.parents, shape.joints, w, r)))
    assert np.all(np.diff(error, axis=0) <= 1e-9 * error[0])
    assert np.max(error[-1]) < 1e-4 * np.max(error[0])


def test_points_of_another_shape_are_refused():
    shape = chain()
    fewer = Canonical(shape.canonical.points[:-1], None, -1, "other")
    with pytest.raises(InputError, match="points as in the canonical shape"):
        fit_poses(shape.motion, fewer, skeleton_of(shape), **SETTINGS)


def test_a_given_skeleton_is_passed_on_and_a_missing_one_is_named():
    shape = chain()
    names = ("a", "b", "c", "d")
    zeros = np.zeros((30, 4, 3), np.float32)
    rig = Rig(names, shape.parents, shape.joints.astype(np.float32), shape.weights, shape.rotations, zeros)
    plain = shape.motion
    motion = Motion("given", plain.points, plain.faces, plain.clip_start, plain.clip_names, 24.0, rig=rig)
    skeleton = given_skeleton(motion, shape.canonical)
    assert skeleton.names == names
    assert given_poses(motion, motion, shape.canonical, skeleton).rotations is rig.rotations
    with pytest.raises(InputError, match="none"):
        given_skeleton(plain, shape.canonical)
    with pytest.raises(InputError, match="2 joints"):
        given_poses(motion, motion, shape.canonical, skeleton_of(ball_joint()))


@pytest.mark.parametrize(("frame", "told"), [(-1, True), (7, True), (7, False)])
def test_a_given_skeleton_without_weights_is_bound_to_the_points_it_moves(frame, told):
    """The weights that made the motion come back, at rest exactly, from a posed frame as well as skinning allows; also
    where that frame is not named."""
    shape = chain()
    _, shifts = kinematics.local_poses(shape.parents, shape.joints, shape.transforms)
    names, joints = ("a", "b", "c", "d"), shape.joints.astype(np.float32)
    rig = Rig(names, shape.parents, joints, np.zeros((0, 4), np.float32), shape.rotations, shifts)
    motion = replace(shape.motion, rig=rig)
    at = shape.canonical if frame < 0 else Canonical(motion.points[frame], None, frame if told else -1, "posed")
    skeleton = given_skeleton(motion, at)
    poses = given_poses(motion, motion, at, skeleton)
    world = kinematics.forward(skeleton.parents, skeleton.joints, poses.rotations, poses.translations)
    size = diagonal(shape.canonical.points)
    assert vertex_rmse(skin(at.points, skeleton.weights, world), motion.points) < (1e-4 if frame < 0 else 2e-3) * size
    if frame < 0:
        np.testing.assert_allclose(skeleton.weights, shape.weights, atol=0.02)


def test_a_given_skeleton_may_start_from_a_posed_frame():
    """Joints lie where they are in that frame, its pose is the identity, and the world's motion is the same."""
    shape = chain()
    rng = np.random.default_rng(0)
    shifts = rng.normal(0, 0.1, (30, 4, 3)).astype(np.float32)
    names = ("a", "b", "c", "d")
    rig = Rig(names, shape.parents, shape.joints.astype(np.float32), shape.weights, shape.rotations, shifts)
    plain = shape.motion
    motion = Motion("given", plain.points, plain.faces, plain.clip_start, plain.clip_names, 24.0, rig=rig)
    posed = Canonical(plain.points[7], None, 7, "frame 7")
    skeleton = given_skeleton(motion, posed)
    test = motion.take_frames([slice(20, 30)], ["late"])
    poses = given_poses(test, motion, posed, skeleton)
    np.testing.assert_allclose(
        given_poses(motion, motion, posed, skeleton).rotations[7], np.eye(3)[None].repeat(4, 0), atol=1e-6
    )
    true = kinematics.forward(rig.parents, rig.joints, rig.rotations, rig.translations)
    found = kinematics.forward(skeleton.parents, skeleton.joints, poses.rotations, poses.translations)
    at_rest = rng.normal(size=(5, 3))
    for j in range(4):
        there = rigid.apply(true[7, j], at_rest)
        np.testing.assert_allclose(
            rigid.apply(found[:, j, None], there), rigid.apply(true[20:, j, None], at_rest), atol=1e-5
        )
