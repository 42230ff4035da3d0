"""Setting poses: turns of joints by curves of time, feet that stay where they are put, legs by inverse kinematics."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.interpolate import CubicSpline

from tasks.geometry import rotations

Path = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]  # times -> positions on the ground (..., 3), headings
AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
TAU = 2.0 * np.pi


def about(axis: str | tuple[float, float, float], angle: np.ndarray | float) -> np.ndarray:
    """Rotations about a fixed axis, named or given. angle: (F,) radians -> (F, 3, 3)."""
    direction = np.asarray(AXES[axis] if isinstance(axis, str) else axis)
    return rotations.from_rotation_vector(np.asarray(angle)[..., None] * (direction / np.linalg.norm(direction)))


def ease(s: np.ndarray) -> np.ndarray:
    """0 below 0, 1 above 1, smooth to the second derivative in between."""
    s = np.clip(s, 0.0, 1.0)
    return s**3 * (10.0 - 15.0 * s + 6.0 * s * s)


def rise(t: np.ndarray, start: float, stop: float) -> np.ndarray:
    """From 0 before ``start`` smoothly to 1 after ``stop``."""
    return ease((t - start) / (stop - start))


def bump(t: np.ndarray, start: float, top: float, stop: float) -> np.ndarray:
    """0 before ``start``, 1 at ``top``, 0 after ``stop``, smooth."""
    return rise(t, start, top) * (1.0 - rise(t, top, stop))


def mirrored(point: tuple[float, float, float], side: str) -> tuple[float, float, float]:
    """The point on the left ("l") or, across x = 0, on the right ("r")."""
    return point if side == "l" else (-point[0], point[1], point[2])


def offset(x: np.ndarray | float, y: np.ndarray | float, z: np.ndarray | float) -> np.ndarray:
    """Stacks coordinates, numbers or curves, to (F, 3)."""
    return np.stack(np.broadcast_arrays(np.asarray(x, float), y, z), axis=-1)


def straight(speed: float) -> Path:
    """A path along +z."""
    return lambda t: (offset(0.0 * t, 0.0, speed * t), 0.0 * t)


def standing(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The path of one who stays."""
    return offset(0.0 * t, 0.0, 0.0), 0.0 * t


def footfalls(
    t: np.ndarray, path: Path, home: np.ndarray, *, phase: float, period: float, duty: float, lift: float
) -> tuple[np.ndarray, np.ndarray]:
    """Where a foot is while its owner follows a path, (F, 3), and the fraction of its cycle, (F,).

    It stands still while the fraction is below ``duty``, at the place that is ``home`` when the path is at mid-stance,
    and then swings to its next place.
    """
    cycle = t / period - phase
    count = np.floor(cycle)
    fraction = cycle - count

    def place(k: np.ndarray) -> np.ndarray:
        position, heading = path((k + phase + 0.5 * duty) * period)
        return position + (about("y", heading) @ home)

    s = np.maximum(fraction - duty, 0.0) / (1.0 - duty)
    foot = place(count) + ease(s)[:, None] * (place(count + 1) - place(count))
    foot[:, 1] += lift * np.sin(np.pi * s) ** 2
    return foot, fraction


def raised(target: np.ndarray, pitch: np.ndarray, toe: float, heel: float) -> np.ndarray:
    """Foot targets lifted so that a foot pitched on its ball (> 0) or heel (< 0) stays above the ground; metres."""
    sine = np.sin(pitch)
    return target + offset(0.0, np.where(sine > 0, toe, heel) * sine**2, 0.0)


def cyclic(fraction: np.ndarray, *knots: tuple[float, float]) -> np.ndarray:
    """Smooth periodic curve through (fraction of the cycle, value) knots, fractions rising within 0..1."""
    at, value = np.array([*knots, (knots[0][0] + 1.0, knots[0][1])]).T
    return CubicSpline(at, value, bc_type="periodic")(fraction)


def frame_along(direction: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Rotations whose columns are the direction, the normal made square to it, and their cross product."""
    d = direction / np.linalg.norm(direction, axis=-1, keepdims=True)
    n = normal - d * np.sum(d * normal, axis=-1, keepdims=True)
    n = n / np.linalg.norm(n, axis=-1, keepdims=True)
    return np.stack([d, n, np.cross(d, n)], axis=-1)


class Puppet:
    """A tree of joints posed for all frames of a clip at once. rotations: (F, J, 3, 3); root: (F, 3) its position."""

    def __init__(self, names: tuple[str, ...], parents: np.ndarray, joints: np.ndarray, frames: int) -> None:
        self.names, self.parents, self.joints = names, parents, joints
        self.rotations = np.tile(np.eye(3), (frames, len(names), 1, 1))
        self.root = np.tile(joints[0], (frames, 1))

    def turn(self, joint: str, *turns: tuple) -> None:
        """Adds turns (axis, angle) to a joint, each inside the one before, the first in the parent's frame."""
        j = self.names.index(joint)
        for axis, angle in turns:
            self.rotations[:, j] = self.rotations[:, j] @ about(axis, angle)

    def world(self, joint: int) -> tuple[np.ndarray, np.ndarray]:
        """Rotation (F, 3, 3) and position (F, 3) of a joint in the world."""
        p = self.parents[joint]
        if p < 0:
            return self.rotations[:, joint], self.root
        r, x = self.world(p)
        return r @ self.rotations[:, joint], x + r @ (self.joints[joint] - self.joints[p])

    def reach(
        self, chain: tuple[str, str, str], tip: np.ndarray, target: np.ndarray, tip_world: np.ndarray, pole: np.ndarray
    ) -> None:
        """Bends a leg of three bones so that its tip comes to the target.

        tip: (3,) rest position moved by the last bone; target: (F, 3); tip_world: (F, 3, 3) world rotation of the last
        bone; pole: (3,) rest direction the middle joint points to, carried along by the parent of the leg.
        """
        upper, lower, last = (self.names.index(n) for n in chain)
        hip, knee, ankle = self.joints[[upper, lower, last]]
        base, start = self.world(self.parents[upper])
        start = start + base @ (hip - self.joints[self.parents[upper]])
        l1, l2 = np.linalg.norm(knee - hip), np.linalg.norm(ankle - knee)
        line = target - tip_world @ (tip - ankle) - start
        away = np.linalg.norm(line, axis=1, keepdims=True)
        longest = l1 + l2
        # near full stretch the leg gives in softly instead of snapping straight
        over = np.maximum(away / longest - 0.97, 0.0)
        away, line = np.minimum(away, longest * (0.97 + 0.028 * (1 - np.exp(-over / 0.028)))), line / away
        along = (l1**2 - l2**2 + away**2) / (2 * away)
        side = (base @ pole) - line * np.sum((base @ pole) * line, axis=1, keepdims=True)
        side = side / np.linalg.norm(side, axis=1, keepdims=True)
        bend = line * along + side * np.sqrt(np.maximum(l1**2 - along**2, 0.0))
        normal, rest_normal = np.cross(line, side), np.cross(ankle - hip, pole)
        thigh = frame_along(bend, normal) @ frame_along(knee - hip, rest_normal).T
        shin = frame_along(line * away - bend, normal) @ frame_along(ankle - knee, rest_normal).T
        back = np.swapaxes
        self.rotations[:, upper] = back(base, 1, 2) @ thigh
        self.rotations[:, lower] = back(thigh, 1, 2) @ shin
        self.rotations[:, last] = back(shin, 1, 2) @ tip_world


def carry(p: Puppet, t: np.ndarray, path: Path, *, shift: np.ndarray, turns: list[tuple]) -> np.ndarray:
    """Puts the pelvis at rest plus ``shift`` in the frame of the path, turned; returns the headings."""
    position, heading = path(t)
    p.root[:] = position + (about("y", heading) @ (p.joints[0] + shift)[..., None])[..., 0]
    p.turn("pelvis", ("y", heading), *turns)
    return heading
