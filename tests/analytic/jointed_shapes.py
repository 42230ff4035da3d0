"""Shapes with known joints: capsules that bend at planted places."""

from __future__ import annotations

import numpy as np

from tasks.geometry import kinematics
from tasks.geometry.rotations import from_rotation_vector
from tasks.geometry.skinning import skin
from tasks.values import Canonical, Curve, Motion, Skinning, Surface

RADIUS = 0.15


def capsule(length: float, rings: int, around: int) -> tuple[np.ndarray, np.ndarray]:
    """A closed tube along x from 0 to ``length``, ends capped by one point: vertices (V, 3), faces (T, 3) outward."""
    x = np.linspace(0.0, length, rings)
    turn = 2.0 * np.pi * np.arange(around) / around
    rim = np.stack([np.zeros(around), np.cos(turn), np.sin(turn)], axis=1) * RADIUS
    tube = (rim[None] + x[:, None, None] * [1.0, 0.0, 0.0]).reshape(-1, 3)
    ends = np.array([[-RADIUS, 0.0, 0.0], [length + RADIUS, 0.0, 0.0]])
    a = np.arange(around)
    b = (a + 1) % around
    faces = []
    for r in range(rings - 1):
        low, high = r * around, (r + 1) * around
        faces += [np.stack([low + a, low + b, high + a], 1), np.stack([low + b, high + b, high + a], 1)]
    last, first_end, last_end = (rings - 1) * around, len(tube), len(tube) + 1
    faces += [
        np.stack([np.full(around, first_end), b, a], 1),
        np.stack([last + a, last + b, np.full(around, last_end)], 1),
    ]
    return np.concatenate([tube, ends]), np.concatenate(faces).astype(np.int32)


def straight_curve(vertices: np.ndarray, length: float, nodes: int) -> Curve:
    """The capsule's axis with every vertex on the node at its own x."""
    x = np.linspace(0.0, length, nodes)
    of_vertex = np.abs(vertices[:, :1] - x).argmin(axis=1).astype(np.int32)
    line = np.stack([x, np.zeros(nodes), np.zeros(nodes)], axis=1).astype(np.float32)
    edges = np.stack([np.arange(nodes - 1), np.arange(1, nodes)], axis=1).astype(np.int32)
    return Curve(line, edges, of_vertex, of_vertex)


class Bending:
    """A capsule of ``length`` that bends at the planted ``joints_x`` by rotation vectors (F, J, 3), joint 0 the root at
    its first end; weights change over ``blend`` on either side of a joint."""

    def __init__(
        self, length: float, joints_x: list[float], turns: np.ndarray, shift: np.ndarray, blend: float
    ) -> None:
        vertices, faces = capsule(length, 61, 16)
        self.joints = np.array([[x, 0.0, 0.0] for x in joints_x])
        self.parents = np.arange(-1, len(joints_x) - 1).astype(np.int32)
        past = np.clip((vertices[:, :1] - np.array(joints_x) + blend) / (2.0 * blend), 0.0, 1.0)
        past[:, 0] = 1.0
        self.weights = (past - np.concatenate([past[:, 1:], np.zeros((len(past), 1))], axis=1)).astype(np.float32)
        translations = np.zeros_like(turns)
        translations[:, 0] = shift
        self.rotations = from_rotation_vector(turns)
        self.transforms = kinematics.forward(self.parents, self.joints, self.rotations, translations)
        rest = vertices.astype(np.float32)
        points = skin(rest, self.weights, self.transforms)
        self.motion = Motion("capsule", points, faces, np.array([0, len(points)]), ("bend",), 24.0)
        self.canonical = Canonical(rest, faces, -1, "planted")
        self.skinning = Skinning(rest, self.weights, self.transforms.astype(np.float32), np.zeros(1))
        self.surface = Surface(rest, faces, np.arange(len(rest), dtype=np.int32))
        self.curve = straight_curve(vertices, length, 81)


def ball_joint(frames: int = 40, seed: int = 0) -> Bending:
    """Two segments of one unit, ball joint at x = 1, random turns of up to a radian, root moving far."""
    rng = np.random.default_rng(seed)
    turns = rng.uniform(-0.6, 0.6, (frames, 2, 3))
    return Bending(2.0, [0.0, 1.0], turns, 5.0 * rng.normal(size=(frames, 3)), 0.05)
