"""What poses are told by: velocities of a known motion, distances in radians."""

from __future__ import annotations

import numpy as np
import pytest

from tasks.geometry import rigid
from tasks.geometry.rotations import from_rotation_vector, to_quaternion
from tasks.motion import affine, kernel
from tasks.motion.blending import gather
from tasks.motion.dynamics import root_dynamics
from tasks.motion.matching import Way, prepare
from tasks.motion.online import DELAY, Online, _delayed
from tasks.motion.posed import DYNAMICS, Posed
from tasks.motion.regression import bone_radii, features
from tasks.motion.search import Keys, Matches
from tasks.values import Poses
from tests.analytic import planted
from tests.analytic.test_methods import PAPER


@pytest.mark.parametrize("fps", [30.0, 60.0, 1.0])
def test_dynamics_of_an_even_spin_on_a_parabola(fps):
    """Turning once in two seconds about the upright while being thrown: all in the root's own axes."""
    frames = 24
    time, spin = np.arange(2 * frames) / fps, np.pi / fps  # rad a frame, up to half a turn
    turn = from_rotation_vector(np.arange(2 * frames)[:, None] * np.array([0.0, min(spin, 0.5), 0.0]))
    pivot = np.array([0.2, 1.0, -0.1])
    place = np.stack([0.7 * time, 3.0 * time - 4.9 * time**2, 0 * time], axis=1)
    root = rigid.make(turn, place + pivot - (turn @ pivot[:, None])[..., 0])
    found = root_dynamics(root, pivot, np.array([0, frames, 2 * frames]), fps)
    inner = np.r_[2 : frames - 2, frames + 2 : 2 * frames - 2]
    np.testing.assert_allclose(found[:, 0], np.broadcast_to([0.0, 1.0, 0.0], (2 * frames, 3)), atol=1e-9)
    velocity = np.stack([0 * time + 0.7, 3.0 - 9.8 * time, 0 * time], axis=1)
    np.testing.assert_allclose((turn @ found[:, 1, :, None])[inner, :, 0], velocity[inner], atol=1e-8)
    np.testing.assert_allclose((turn @ found[:, 2, :, None])[inner, :, 0], [[0.0, -9.8, 0.0]] * len(inner), atol=1e-7)
    np.testing.assert_allclose(found[:, 3], [[0.0, fps * min(spin, 0.5), 0.0]] * (2 * frames), atol=1e-8)


def test_squared_distances_of_features_are_mean_squared_angles():
    train = planted.training([planted.gesture(20, 1)], affinity=0.0)
    turns = np.tile(np.eye(3, dtype=np.float32), (2, len(planted.NAMES), 1, 1))
    joints, weights = np.array([4, 5, 10]), np.array([1.0, 3.0, 2.0])
    angles = np.array([0.02, 0.05, 0.03])
    turns[1, joints] = from_rotation_vector(angles[:, None] * np.array([[1.0, 0, 0], [0, 1.0, 0], [0, 0.6, 0.8]]))
    still = Poses(turns, np.zeros((2, len(planted.NAMES), 3), np.float32), np.array([0, 1, 2]))  # two clips: no motion
    x = features(Posed(train, still), joints, weights, dynamics=1.0, lags=[0, 1, 4])
    apart = ((x[0] - x[1]) ** 2).sum()
    assert apart == pytest.approx(float(weights @ angles**2 / weights.sum()), rel=2e-3)


def test_a_push_sideways_counts_by_the_size_of_the_body():
    """Body diagonals a second and a second squared, whatever the unit: faster by half a diagonal a second."""
    train = planted.training([planted.gesture(20, 1)], affinity=0.0)
    size = np.linalg.norm(np.ptp(train.canonical.points, axis=0))
    rest = np.tile(np.eye(3, dtype=np.float32), (20, len(planted.NAMES), 1, 1))
    time, shift = np.arange(20) / train.database.fps, np.zeros((20, len(planted.NAMES), 3), np.float32)
    shift[:, 0, 0] = 0.25 * size * time**2
    posed = Posed(train, Poses(rest, shift, np.array([0, 20])))
    wanted = np.zeros((20, 4, 3))
    wanted[:, 0, 1], wanted[:, 1, 0], wanted[:, 2, 0] = DYNAMICS[0], 0.5 * DYNAMICS[1] * time, 0.5 * DYNAMICS[2]
    np.testing.assert_allclose(posed.dynamics[2:-2], wanted[2:-2], atol=2e-4)


def test_a_bone_s_radius_is_the_root_of_its_mean_squared_distance():
    ring = np.stack([np.cos(np.arange(12)), np.sin(np.arange(12)), np.zeros(12)], axis=1)
    ring -= ring.mean(0)
    rest = np.concatenate([2.0 * ring, 3.0 * ring + 10.0]).astype(np.float32)
    weights = np.repeat(np.eye(2), 12, axis=0)
    spread = np.sqrt((ring**2).sum(1).mean())
    np.testing.assert_allclose(bone_radii(rest, weights), [2.0 * spread, 3.0 * spread], rtol=1e-5)


@pytest.mark.parametrize("helps", [True, False])
def test_images_are_learnt_from_only_where_left_out_clips_are_met_better(helps):
    """An odd function known on its right half but for one clip: images tell of the left one, or lie."""
    rng = np.random.default_rng(0)
    x = np.concatenate([rng.uniform(a, b, (30, 1)) for a, b in ((0.5, 3), (0.5, 3), (-3, -0.5))])
    y = np.concatenate([np.sin(x), x], axis=1)
    clip = np.repeat(np.arange(3), 30)
    image = -x, (-y if helps else rng.normal(0, 2, y.shape))
    model = kernel.fit(x, y, clip, width=1.0, ridge=0.01, tune=True, landmarks=1000, more=image)
    assert len(model.centres) == (180 if helps else 90)
    if helps:
        asked = np.linspace(-2.5, 2.5, 9)[:, None]
        np.testing.assert_allclose(model(asked), np.concatenate([np.sin(asked), asked], axis=1), atol=0.1)


def test_every_level_has_its_share_of_a_frame_however_many_windows_cover_it():
    """Ten frames in windows of three: at the ends fewer windows cover a frame, on both levels."""
    start = np.full((2, 8, 1), -1, np.int32)
    start[0, :6, 0], start[1, :, 0] = np.arange(6), 100 + np.arange(8)
    found = gather(
        Matches(np.zeros((2, 8, 1), np.float32), start, np.array([6, 8])),
        [2, 1],
        patch=3,
        lambda_=0.7,
        temperature=1.0,
    )
    assert len(found.frame) == 10
    for frame, share, count in zip(found.frame, found.share, found.count, strict=True):
        coarse = frame[:count] < 100
        assert share[:count][coarse].sum() == pytest.approx(0.3)
        assert share[:count][~coarse].sum() == pytest.approx(0.7)


def test_moments_are_apart_by_angles_and_dynamics_alike():
    angle, push = 0.04, np.array([0.01, -0.03, 0.02])
    turns = np.stack([from_rotation_vector(np.array([[a, 0.0, 0.0], [0.0, 0.0, 0.0]])) for a in (0.0, angle)])
    keys = Keys(
        to_quaternion(turns).astype(np.float32),
        np.stack([np.zeros((1, 3)), push[None]]).astype(np.float32),
        np.array([0, 1, 2]),
    )
    now = affine._now(keys, np.array([3.0, 1.0]))
    apart = len(affine.LAGS) * ((now[0] - now[1]) ** 2).sum()
    assert apart == pytest.approx(0.75 * angle**2 + push @ push, rel=1e-3)


def test_a_stream_compares_dynamics_as_they_were_when_they_became_known():
    clips = [planted.gesture(30, 1)]
    train = planted.training(clips, affinity=0.0)
    ready = prepare(train, Way(**PAPER | {"dynamics": 1.0, "levels": 1}))
    stream, wanted = Online(ready), _delayed(ready.known.keys(0, 1.0)).extra
    poses = train.database.poses
    for frame in range(30):
        stream.pose(poses.rotations[frame], poses.translations[frame])
        if frame >= 2 * DELAY:
            np.testing.assert_allclose(stream._keys[-1][1], wanted[frame], atol=1e-5)
