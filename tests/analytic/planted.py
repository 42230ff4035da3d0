"""A planted character: a body with two arms and two legs, whose free-form bones are a known function of its pose."""

from __future__ import annotations

import numpy as np

from tasks.geometry import kinematics, rigid
from tasks.geometry.rotations import from_rotation_vector
from tasks.geometry.skinning import skin
from tasks.motion.database import build_database
from tasks.motion.parts import find_parts
from tasks.values import Canonical, Motion, Poses, Skeleton, Skinning, Training

# name, parent, position
TREE = [
    ("pelvis", -1, (0.0, 1.0, 0.0)),
    ("spine", 0, (0.0, 1.2, 0.0)),
    ("chest", 1, (0.0, 1.4, 0.0)),
    ("head", 2, (0.0, 1.6, 0.0)),
    ("arm_l", 2, (0.2, 1.4, 0.0)),
    ("elbow_l", 4, (0.5, 1.4, 0.0)),
    ("hand_l", 5, (0.75, 1.4, 0.0)),
    ("arm_r", 2, (-0.2, 1.4, 0.0)),
    ("elbow_r", 7, (-0.5, 1.4, 0.0)),
    ("hand_r", 8, (-0.75, 1.4, 0.0)),
    ("leg_l", 0, (0.1, 0.95, 0.0)),
    ("knee_l", 10, (0.1, 0.5, 0.0)),
    ("foot_l", 11, (0.1, 0.1, 0.0)),
    ("leg_r", 0, (-0.1, 0.95, 0.0)),
    ("knee_r", 13, (-0.1, 0.5, 0.0)),
    ("foot_r", 14, (-0.1, 0.1, 0.0)),
]
NAMES = [name for name, _, _ in TREE]
ARMS = [j for j, name in enumerate(NAMES) if name.split("_")[0] in ("arm", "elbow", "hand")]
LEGS = [j for j, name in enumerate(NAMES) if name.split("_")[0] in ("leg", "knee", "foot")]


def skeleton(points_per_joint: int = 12, seed: int = 0) -> tuple[Skeleton, np.ndarray]:
    """The skeleton and points scattered round its joints, each moved by its own joint and a little by the parent."""
    rng = np.random.default_rng(seed)
    parents = np.array([p for _, p, _ in TREE], np.int32)
    joints = np.array([x for _, _, x in TREE], np.float32)
    owner = np.repeat(np.arange(len(TREE)), points_per_joint)
    points = (joints[owner] + rng.normal(0, 0.06, (len(owner), 3))).astype(np.float32)
    weights = np.zeros((len(owner), len(TREE)), np.float32)
    weights[np.arange(len(owner)), owner] = 0.8
    weights[np.arange(len(owner)), np.maximum(parents[owner], 0)] += 0.2
    return Skeleton(tuple(NAMES), parents, joints, weights), points


def gesture(frames: int, seed: int, amplitude: float = 0.5) -> np.ndarray:
    """Smooth local rotations of every joint, (F, J, 3, 3)."""
    rng = np.random.default_rng(seed)
    time = np.linspace(0, 1, frames)[:, None, None]
    phase, axis = rng.uniform(0, 6.28, (2, len(TREE), 1)), rng.normal(0, amplitude, (2, len(TREE), 3))
    turns = sum(axis[i] * np.sin(2 * np.pi * (i + 1) * time + phase[i]) for i in range(2))
    return from_rotation_vector(turns).astype(np.float32)


def poses(clips: list[np.ndarray], drift: float = 0.3) -> Poses:
    """Clips of local rotations -> poses whose root also wanders."""
    rotations = np.concatenate(clips)
    translations = np.zeros((len(rotations), len(TREE), 3), np.float32)
    translations[:, 0] = drift * np.sin(np.arange(len(rotations))[:, None] * np.array([0.11, 0.05, 0.07]))
    start = np.concatenate([[0], np.cumsum([len(c) for c in clips])]).astype(np.int64)
    return Poses(rotations, translations, start)


def soft_bones(tree: Skeleton, pose: Poses) -> np.ndarray:
    """True bones: one a joint, riding on it but swelling out and twisting as its own joint bends, so that linear blend
    skinning cannot explain them. A function of the joint's local rotation alone. (F, J, 3, 4) float32."""
    world = kinematics.forward(tree.parents, tree.joints, pose.rotations, pose.translations).astype(np.float64)
    bend = np.arccos(np.clip((np.trace(pose.rotations, axis1=-2, axis2=-1) - 1) / 2, -1, 1))
    bend[:, 0] = 0  # the root's turn is global motion, not a pose
    twist = from_rotation_vector(bend[..., None] * np.array([0.0, 0.4, 0.2]))
    push = bend[..., None] * np.array([0.0, 0.03, 0.05])
    local = rigid.make(twist, push + tree.joints - (twist @ tree.joints[..., None].astype(float))[..., 0])
    return rigid.compose(world, local).astype(np.float32)


def training(clips: list[np.ndarray], kind: str = "auto", affinity: float = 0.15, **parts) -> Training:
    """Everything that a method may learn from, with exact bones."""
    tree, rest = skeleton()
    known = poses(clips)
    bones = soft_bones(tree, known)
    skinning = Skinning(rest, tree.weights, bones, np.zeros((0, 2)))
    points = skin(rest, tree.weights, bones)
    motion = Motion("planted", points, None, known.clip_start, tuple(f"clip{c}" for c in range(len(clips))), 30.0)
    return Training(
        motion=motion,
        canonical=Canonical(rest, None, -1, "rest"),
        skinning=skinning,
        skeleton=tree,
        database=build_database(motion, skinning, known),
        parts=find_parts(tree, skinning, kind=kind, affinity=affinity, **({"named": [], "overlap": 1} | parts)),
    )


def truth(train: Training, query: Poses) -> np.ndarray:
    """Points that the query's poses would really give."""
    return skin(train.skinning.rest, train.skinning.weights, soft_bones(train.skeleton, query))
