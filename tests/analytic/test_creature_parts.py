"""The pieces the creature is made of, against closed forms."""

from dataclasses import replace

import igl
import numpy as np
import pytest
from scipy.sparse import csr_matrix

from tasks.datasets import creature_dynamics as dynamics
from tasks.datasets import creature_motion as motion
from tasks.datasets import creature_shape as shape
from tasks.datasets.creature_dynamics import Limbs, Masses
from tasks.errors import InputError
from tasks.geometry import kinematics, neighbours

FPS = 30.0
NO_LIMBS = Limbs(np.zeros((300, 0, 2, 3)), np.zeros((0, 2, 3)), np.zeros((0, 2)))


def one_mass(hertz: float, damping: float) -> Masses:
    """A mass tied to the only joint, followed by the only skin point."""
    return Masses(
        rest=np.array([[0.0, 1.0, 0.0]]),
        hold=np.ones((1, 1)),
        spread=csr_matrix(np.ones((1, 1))),
        tie=np.array([2.0 * np.pi * hertz]),
        damping=damping,
        limit=1e6,
        springs=np.zeros((0, 2), np.int64),
        length=np.zeros(0),
        stretch=np.zeros(0),
        drag=0.0,
        avoid=(),
        margin=0.0,
    )


def shaken(frames: int, hertz: float, amplitude: float) -> np.ndarray:
    """Bones (F, 1, 3, 4) that swing sideways."""
    bones = np.tile(np.eye(3, 4), (frames, 1, 1, 1))
    bones[:, 0, 0, 3] = amplitude * np.sin(2.0 * np.pi * hertz * np.arange(frames) / FPS)
    return bones


def swung(masses: Masses, bones: np.ndarray, limbs: Limbs = NO_LIMBS, softness: float = 1.0) -> np.ndarray:
    """Sideways path of the skin point."""
    skin = (masses.rest[None] + bones[:, 0, None, :, 3]).astype(np.float32)
    return dynamics.displace(masses, bones, skin, limbs, fps=FPS, softness=softness)


def test_a_shaken_mass_lags_as_the_driven_oscillator_does() -> None:
    """x'' = k (g - x) + c (g' - x'): gain and phase of (k + i w c) / (k - w^2 + i w c)."""
    frames, drive, own, damping = 300, 1.5, 1.8, 0.25
    x = swung(one_mass(own, damping), shaken(frames, drive, 0.05))[:, 0, 0].astype(np.float64)
    w, k = 2 * np.pi * drive, (2 * np.pi * own) ** 2
    c = 2 * damping * np.sqrt(k)
    answer = (k + 1j * w * c) / (k - w**2 + 1j * w * c)
    t = np.arange(frames)[-200:] / FPS  # ten whole periods, the start has died away
    got = 2.0 * np.mean(x[-200:] * np.exp(-1j * w * t)) / (0.05 * -1j)
    assert abs(got) == pytest.approx(abs(answer), rel=0.03)
    assert np.angle(got) == pytest.approx(np.angle(answer), abs=0.04)
    assert np.angle(got) < -0.3


def test_stiffer_ties_follow_closer() -> None:
    bones, masses = shaken(120, 1.5, 0.05), one_mass(2.0, 0.2)
    lag = [np.abs(swung(masses, bones, softness=s)[:, 0, 0] - bones[:, 0, 0, 3]).max() for s in (1.0, 0.1, 0.001)]
    assert lag[0] > 4 * lag[1] > 16 * lag[2]


def test_a_hanging_chain_rests_and_swings_with_gravity() -> None:
    """In balance at rest; moved aside by its upper end, it follows late and swings through to the other side."""
    count = 6
    rest = np.stack([np.zeros(count), 2.0 - 0.1 * np.arange(count), np.zeros(count)], axis=1)
    springs = np.stack([np.arange(count - 1), np.arange(1, count)], axis=1)
    stretch = np.full(count - 1, 2 * np.pi * 20.0)
    hung = 0.1 - np.arange(count - 1, 0, -1) * 9.81 / stretch**2
    tie = np.zeros(count)
    tie[0] = np.inf
    chain = replace(
        one_mass(1.0, 0.0), rest=rest, hold=np.ones((count, 1)), spread=csr_matrix(np.eye(count)), tie=tie,
        springs=springs, length=hung, stretch=stretch,
    )  # fmt: skip
    assert np.abs(dynamics.balance(chain)[1:]).max() < 1e-6
    still = np.tile(np.eye(3, 4), (40, 1, 1, 1))
    skin = np.tile(rest, (40, 1, 1)).astype(np.float32)
    assert np.abs(dynamics.displace(chain, still, skin, NO_LIMBS, fps=FPS, softness=1.0) - skin).max() < 1e-6
    pushed = still.copy()
    pushed[:5, 0, 0, 3] = 0.1
    skin = skin + pushed[:, 0, None, :, 3].astype(np.float32)
    x = dynamics.displace(chain, pushed, skin, NO_LIMBS, fps=FPS, softness=1.0)
    tip = x[:, -1, 0]
    assert tip[6] > 0.05
    assert tip.min() < -0.02  # a free tie would leave it hanging where it was pushed


def test_masses_stay_out_of_a_limb_that_sweeps_through_them() -> None:
    frames = 60
    x = np.linspace(-0.6, 0.6, frames)
    ends = np.zeros((frames, 1, 2, 3))
    ends[:, 0, :, 0], ends[:, 0, 0, 1], ends[:, 0, 1, 1] = x[:, None], 0.5, 1.5
    limbs = Limbs(ends, ends[0], np.array([[0.1, 0.1]]))
    masses = replace(one_mass(1.0, 0.2), margin=0.02)
    path = swung(masses, shaken(frames, 0.0, 0.0), limbs)[:, 0]
    away = np.hypot(path[:, 0] - x, path[:, 2])
    assert away.min() > 0.12 - 1e-5
    assert np.abs(path[:, 0]).max() > 0.1


def test_integrate_against_a_slow_reference() -> None:
    """Springs, ties, drag and gravity written out with numpy, step by step."""
    rng = np.random.default_rng(0)
    count, frames, substeps, dt, limit, drag = 5, 6, 4, 0.01, 0.3, 0.5
    goals = np.cumsum(rng.normal(size=(frames, count, 3)) * 0.03, axis=0) + rng.normal(size=(count, 3)) + (0, 5, 0)
    springs = np.array([[0, 1], [1, 2], [2, 3], [3, 4], [0, 2]])
    length, stretch = np.full(5, 0.8), np.full(5, 300.0)
    tie, damping, gravity = np.full(count, 80.0), np.full(count, 3.0), rng.normal(size=(frames, count, 3))
    pinned = np.array([True, False, False, False, False])
    got = dynamics.integrate(
        goals, gravity, tie, damping, pinned, limit, springs, length, stretch, drag, np.zeros((frames, 0, 2, 3)),
        np.zeros((0, 2)), np.zeros((count, 0)), dt, substeps,
    )  # fmt: skip
    x, v, before = goals[0].copy(), np.zeros((count, 3)), goals[0]
    for f in range(frames - 1):
        for s in np.arange(1, substeps + 1) / substeps:
            p0, p1, p2, p3 = (goals[np.clip(f + i, 0, frames - 1)] for i in (-1, 0, 1, 2))
            goal = p1 + 0.5 * s * (p2 - p0 + s * (2 * p0 - 5 * p1 + 4 * p2 - p3 + s * (3 * (p1 - p2) + p3 - p0)))
            force = (1 - s) * gravity[f] + s * gravity[f + 1] - drag * v
            for (i, j), rest, k in zip(springs, length, stretch, strict=True):
                d = (x[j] - x[i]) / np.linalg.norm(x[j] - x[i])
                push = k * (np.linalg.norm(x[j] - x[i]) - rest) + 0.4 * np.sqrt(k) * d @ (v[j] - v[i])
                force[i] += push * d
                force[j] -= push * d
            k = (tie * (1 + ((goal - x) ** 2).sum(1) / limit**2))[:, None]
            pace, c = (goal - before) / dt, damping[:, None]
            free = (v + dt * (force + k * (goal - x) + c * pace)) / (1 + dt * c + dt**2 * k)
            v = np.where(pinned[:, None], pace, free)
            x = np.where(pinned[:, None], goal, x + dt * v)
            before = goal
        np.testing.assert_allclose(got[f + 1], x, atol=1e-10)


def test_a_turned_cluster_gives_its_turn_back() -> None:
    rest = np.random.default_rng(1).normal(size=(6, 3))
    springs = neighbours.nearest_edges(rest, 5)
    turn = motion.about((1.0, 2.0, -1.0), np.array(0.6))
    got = dynamics.turns((rest @ turn.T)[None], rest[None], springs)
    np.testing.assert_allclose(got, np.tile(turn, (1, 6, 1, 1)), atol=0.06)


def test_one_round_cone_is_a_sphere() -> None:
    ball = [shape.Cone("a", (0.1, 0.2, 0.3), (0.1, 0.2, 0.3), 0.3, 0.3)]
    vertices, faces = shape.build_surface(ball, 2000)
    np.testing.assert_allclose(np.linalg.norm(vertices - (0.1, 0.2, 0.3), axis=1), 0.3, atol=1e-4)
    assert len(vertices) == pytest.approx(2000, rel=0.1)
    area = igl.doublearea(vertices, faces.astype(np.int64)).sum() / 2
    assert area == pytest.approx(4 * np.pi * 0.09, rel=0.01)
    a, b, c = (vertices[faces[:, i]] - (0.1, 0.2, 0.3) for i in range(3))
    assert np.einsum("ni,ni->n", a, np.cross(b, c)).min() > 0  # every face looks outwards


def test_too_few_vertices_for_a_thin_ring_are_refused() -> None:
    ring = [shape.Bell("a", ((0.3, 0.5), (0.3, 0.3)), 0.03, 1.0)]
    with pytest.raises(InputError, match=r"dataset\.vertices"):
        shape.build_surface(ring, 2000)  # a ring has a hole: Euler number 0


def test_weights_do_not_leak_to_a_near_but_unrelated_limb() -> None:
    """Two fingers side by side on one palm: neither holds the other's skin."""
    parts = [
        shape.Cone("palm", (0, 0, 0), (0, 0.1, 0), 0.08, 0.08),
        shape.Cone("left", (0.05, 0.15, 0), (0.05, 0.5, 0), 0.04, 0.04),
        shape.Cone("right", (-0.05, 0.15, 0), (-0.05, 0.5, 0), 0.04, 0.04),
    ]
    vertices, faces = shape.build_surface(parts, 3000)
    weights = shape.hold_of_joints(parts, vertices, ("palm", "left", "right"), np.array([-1, 0, 0]))
    weights = shape.smooth_weights(vertices, faces, weights, 0.02)
    np.testing.assert_allclose(weights.sum(1), 1.0, atol=1e-12)
    tip = vertices[:, 1] > 0.35
    assert weights[tip & (vertices[:, 0] > 0), 2].max() == 0.0
    assert weights[tip & (vertices[:, 0] > 0), 1].min() > 0.99
    assert weights[vertices[:, 1] < 0.0, 0].min() > 0.9


def test_a_leg_reaches_its_target_by_turns_alone() -> None:
    names, parents = ("hip", "thigh", "shin", "foot"), np.array([-1, 0, 1, 2])
    joints = np.array([[0.0, 1.0, 0.0], [0.1, 0.9, 0.0], [0.11, 0.5, 0.05], [0.1, 0.1, 0.0]])
    frames, tip = 20, np.array([0.1, 0.0, 0.1])
    p = motion.Puppet(names, parents, joints, frames)
    s = np.linspace(0, 1, frames)
    p.root[:] += motion.offset(0.1 * s, -0.1 - 0.1 * s, 0.3 * s)
    p.turn("hip", ("y", 0.6 * s), ("x", 0.3 * s))
    target = tip + motion.offset(0.05 * s, 0.2 * s, 0.35 * s)
    sole = motion.about("x", 0.5 * s)
    p.reach(("thigh", "shin", "foot"), tip, target, sole, np.array([0.0, 0.0, 1.0]))
    shift = np.zeros((frames, 4, 3))
    shift[:, 0] = p.root - joints[0]
    posed = kinematics.forward(parents, joints, p.rotations, shift)
    reached = (posed[:, 3, :, :3] @ tip) + posed[:, 3, :, 3]
    np.testing.assert_allclose(reached, target, atol=1e-9)
    np.testing.assert_allclose(posed[:, 3, :, :3], sole, atol=1e-9)
    square = p.rotations @ np.swapaxes(p.rotations, -1, -2)
    np.testing.assert_allclose(square, np.broadcast_to(np.eye(3), square.shape), atol=1e-9)
    knee = kinematics.joint_positions(posed, joints)[:, 2]
    ahead = (knee - posed[:, 1, :, 3] - posed[:, 1, :, :3] @ joints[1]) @ np.array([0.0, 0.0, 1.0])
    assert ahead.min() > 0  # the knee bends forward


def test_feet_stand_still_until_they_swing() -> None:
    t = np.arange(200) / 60.0
    home = np.array([0.1, 0.0, 0.2])
    bend = lambda s: (motion.offset(1 - np.cos(s), 0.0, np.sin(s)), np.asarray(s))  # noqa: E731
    foot, u = motion.footfalls(t, bend, home, phase=0.3, period=1.0, duty=0.6, lift=0.1)
    step = np.linalg.norm(np.diff(foot, axis=0), axis=1)
    down = (u[:-1] < 0.6) & (u[1:] < 0.6) & (u[:-1] < u[1:])
    assert step[down].max() < 1e-12
    assert foot[:, 1].max() == pytest.approx(0.1, rel=0.02)
    assert step.max() < 0.08  # it swings, it does not jump
    body, _ = bend(t)
    assert np.linalg.norm(foot - body, axis=1).max() < 0.75
