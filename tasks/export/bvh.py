"""Biovision hierarchies: a skeleton and one clip as text, as animation programs read it."""

from __future__ import annotations

import numpy as np

from tasks.values import Poses, Skeleton

MOVES = 1e-5  # of the skeleton's size: joints that leave their place by more get channels for it
TURN = ("Zrotation", "Xrotation", "Yrotation")  # applied in this order: R = Rz Rx Ry
PLACE = ("Xposition", "Yposition", "Zposition")
TIP = 0.3  # of the bone before it: how far an end site stands off


def write_bvh(skeleton: Skeleton, poses: Poses, frames: slice, *, fps: float) -> str:
    """The skeleton at rest and its poses in those frames. The root's OFFSET is zero, and its position absolute."""
    parents = np.asarray(skeleton.parents)
    moved = poses.translations[frames].astype(np.float64)
    size = max(float(np.ptp(skeleton.joints, axis=0).max()), 1e-9)
    free = np.abs(moved).max((0, 2)) > MOVES * size
    free[0] = True
    offsets = skeleton.joints - skeleton.joints[np.maximum(parents, 0)]
    order: list[int] = []
    lines = ["HIERARCHY", *_joint(skeleton, offsets, free, 0, 0, order)]
    angles = np.degrees(euler_zxy(poses.rotations[frames].astype(np.float64)))
    places = moved + offsets
    places[:, 0] += skeleton.joints[0]
    columns = []
    for j in order:
        columns += [places[:, j]] * bool(free[j]) + [angles[:, j]]
    rows = np.concatenate(columns, axis=1)
    lines += ["MOTION", f"Frames: {len(rows)}", f"Frame Time: {1 / fps:.8f}"]
    lines += [" ".join(f"{v:.6f}" for v in row) for row in rows]
    return "\n".join(lines) + "\n"


def euler_zxy(rotations: np.ndarray) -> np.ndarray:
    """Angles z, x, y in radians with R = Rz Rx Ry. (..., 3, 3) -> (..., 3)"""
    r = rotations
    x = np.arcsin(np.clip(r[..., 2, 1], -1, 1))
    straight = np.abs(r[..., 2, 1]) > 1 - 1e-9  # z and y turn about one axis: all of it is given to z
    z = np.where(straight, np.arctan2(r[..., 1, 0], r[..., 0, 0]), np.arctan2(-r[..., 0, 1], r[..., 1, 1]))
    y = np.where(straight, 0.0, np.arctan2(-r[..., 2, 0], r[..., 2, 2]))
    return np.stack([z, x, y], axis=-1)


def _joint(
    skeleton: Skeleton, offsets: np.ndarray, free: np.ndarray, joint: int, depth: int, order: list[int]
) -> list[str]:
    """The lines of a joint and all below it; order collects the joints as they come."""
    order.append(joint)
    pad = "  " * depth
    channels = (PLACE if free[joint] else ()) + TURN
    offset = np.zeros(3) if joint == 0 else offsets[joint]
    lines = [
        f"{pad}{'JOINT' if depth else 'ROOT'} {_name(skeleton.names[joint])}",
        pad + "{",
        f"{pad}  OFFSET {_numbers(offset)}",
        f"{pad}  CHANNELS {len(channels)} {' '.join(channels)}",
    ]
    children = np.flatnonzero(np.asarray(skeleton.parents) == joint)
    for child in children:
        lines += _joint(skeleton, offsets, free, int(child), depth + 1, order)
    if len(children) == 0:
        lines += [f"{pad}  End Site", pad + "  {", f"{pad}    OFFSET {_numbers(TIP * offset)}", pad + "  }"]
    return [*lines, pad + "}"]


def _name(name: str) -> str:
    return "_".join(name.split()) or "joint"


def _numbers(values: np.ndarray) -> str:
    return " ".join(f"{v:.6f}" for v in values)
