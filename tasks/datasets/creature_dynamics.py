"""Soft parts that lag and swing: masses on springs, carried along by the bones (the truth that LBS cannot explain).

A soft region holds masses. Each is tied to where the skeleton would put it (its goal), to its neighbours, and feels
gravity beyond what the rest shape already bears; skirt and hair are kept out of limbs. The skin takes over the masses'
displacement from their goals, so with stiff enough ties, or softness 0, it is linear blend skinning again.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

SUBSTEPS = 16  # springs at 60 rad/s with a dozen neighbours stay stable up to about 8 ms; this is 2 ms at 30 fps
GRAVITY = np.array([0.0, -9.81, 0.0])


@dataclass(frozen=True)
class Masses:
    """Masses of one soft region, M of them, S springs.

    rest: (M, 3); tie: (M,) angular frequency of the tie to the goal in rad/s, inf for masses that sit on it;
    damping: share of critical; limit: metres at which the tie has become twice as stiff; springs: (S, 2);
    stretch: (S,) their angular frequency; drag: 1/s against still air; spread: (N, M) how the skin follows them;
    hold: (M, J) how they follow the joints;
    avoid: names of the parts it may not enter; margin: metres kept from them.
    """

    rest: np.ndarray
    tie: np.ndarray
    damping: float
    limit: float
    springs: np.ndarray
    stretch: np.ndarray
    drag: float
    spread: np.ndarray
    hold: np.ndarray
    avoid: tuple[str, ...]
    margin: float


def farthest_points(points: np.ndarray, first: int, spacing: float) -> np.ndarray:
    """Indices of points about ``spacing`` apart, each the farthest from those before it."""
    chosen = [first]
    gap = np.linalg.norm(points - points[first], axis=1)
    while gap.max() > spacing:
        chosen.append(int(gap.argmax()))
        gap = np.minimum(gap, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return np.array(chosen)


def near_pairs(points: np.ndarray, reach: float) -> np.ndarray:
    """(S, 2) pairs of points nearer to each other than ``reach``, each once."""
    d = np.linalg.norm(points[:, None] - points[None], axis=2)
    return np.argwhere(np.triu(d < reach, 1)).reshape(-1, 2)


def spread_over(points: np.ndarray, masses: np.ndarray, reach: float, mask: np.ndarray) -> np.ndarray:
    """(N, M) smooth interpolation from masses to skin points, rows sum to the mask (normalised Wendland C2)."""
    d = np.linalg.norm(points[:, None] - masses[None], axis=2)
    reach = np.maximum(reach, 1.5 * d.min(1, keepdims=True))
    q = np.minimum(d / reach, 1.0)
    kernel = (1 - q) ** 4 * (4 * q + 1)
    return kernel / kernel.sum(1, keepdims=True) * mask[:, None]


def swing(
    masses: Masses,
    goals: np.ndarray,
    turned: np.ndarray,
    limbs: np.ndarray,
    radii: np.ndarray,
    fps: float,
    softness: float,
) -> np.ndarray:
    """Displacement of the masses from their goals, (F, M, 3), starting at rest on the first goals.

    goals: (F, M, 3); turned: (F, M, 3) rest gravity turned with the bones; limbs: (F, C, 2, 3) ends of the capsules to
    stay out of, radii: (C, 2). Time steps are semi-implicit in ties and damping, so any tie is stable.
    """
    tie = np.where(np.isinf(masses.tie), 0.0, masses.tie)
    rest_length = np.linalg.norm(masses.rest[masses.springs[:, 0]] - masses.rest[masses.springs[:, 1]], axis=1)
    path = integrate(
        np.ascontiguousarray(goals, np.float64),
        np.ascontiguousarray(GRAVITY - turned, np.float64),
        tie**2 / softness,
        2.0 * masses.damping * tie / np.sqrt(softness),
        np.isinf(masses.tie),
        masses.limit,
        masses.springs.astype(np.int64),
        rest_length,
        masses.stretch**2,
        masses.drag,
        np.ascontiguousarray(limbs, np.float64),
        radii + masses.margin,
        1.0 / (fps * SUBSTEPS),
        SUBSTEPS,
    )
    return path - goals


@njit(cache=True, nogil=True)
def integrate(
    goals, gravity, tie, damping, pinned, limit, springs, length, stretch, drag, limbs, radii, dt, substeps
):  # fmt: skip
    """Positions of the masses at the frames, (F, M, 3); goals run along a cubic through the frames."""
    frames, count = goals.shape[0], goals.shape[1]
    out = np.empty_like(goals)
    x, goal, limb = goals[0].copy(), goals[0].copy(), limbs[0].copy()
    v, force, pace = np.zeros_like(x), np.zeros_like(x), np.zeros_like(x)
    out[0] = x
    for f in range(frames - 1):
        for step in range(1, substeps + 1):
            s = step / substeps
            new_goal = between(goals, f, s)
            pace = (new_goal - goal) / dt
            goal = new_goal
            new_limb = limbs[f] + s * (limbs[f + 1] - limbs[f])
            force[:] = gravity[f] + s * (gravity[f + 1] - gravity[f]) - drag * v
            pull(x, v, springs, length, stretch, force)
            for m in range(count):
                if pinned[m]:
                    x[m], v[m] = goal[m], pace[m]
                    continue
                away = np.sum((goal[m] - x[m]) ** 2) / limit**2
                k, c = tie[m] * (1.0 + away), damping[m]
                v[m] = (v[m] + dt * (force[m] + k * (goal[m] - x[m]) + c * pace[m])) / (1.0 + dt * c + dt * dt * k)
                x[m] = x[m] + dt * v[m]
                keep_out(x[m], v[m], limb, new_limb, radii, dt)
            limb = new_limb
        out[f + 1] = x
    return out


@njit(cache=True, nogil=True)
def between(goals, f, s):
    """Catmull-Rom between frames f and f + 1 at 0 < s <= 1."""
    a, b, last = goals[f], goals[f + 1], goals.shape[0] - 1
    ta, tb = 0.5 * (b - goals[max(f - 1, 0)]), 0.5 * (goals[min(f + 2, last)] - a)
    s2, s3 = s * s, s * s * s
    return (2 * s3 - 3 * s2 + 1) * a + (s3 - 2 * s2 + s) * ta + (3 * s2 - 2 * s3) * b + (s3 - s2) * tb


@njit(cache=True, nogil=True)
def pull(x, v, springs, length, stretch, force):
    """Adds the springs' pull, with a tenth of critical damping along them, to ``force``."""
    for e in range(len(springs)):
        i, j = springs[e, 0], springs[e, 1]
        d0, d1, d2 = x[j, 0] - x[i, 0], x[j, 1] - x[i, 1], x[j, 2] - x[i, 2]
        now = np.sqrt(d0 * d0 + d1 * d1 + d2 * d2) + 1e-12
        d0, d1, d2 = d0 / now, d1 / now, d2 / now
        closing = (v[j, 0] - v[i, 0]) * d0 + (v[j, 1] - v[i, 1]) * d1 + (v[j, 2] - v[i, 2]) * d2
        push = stretch[e] * (now - length[e]) + 0.2 * np.sqrt(stretch[e]) * closing
        force[i, 0] += push * d0
        force[i, 1] += push * d1
        force[i, 2] += push * d2
        force[j, 0] -= push * d0
        force[j, 1] -= push * d1
        force[j, 2] -= push * d2


@njit(cache=True, nogil=True)
def keep_out(x, v, before, after, radii, dt):
    """Moves one mass out of the floor and of the capsules, and takes from its speed what runs into them."""
    if x[1] < 0.01:
        x[1] = 0.01
        v[1] = max(v[1], 0.0)
    for c in range(len(radii)):
        a = after[c, 0]
        axis = after[c, 1] - a
        t = min(max(np.dot(x - a, axis) / max(np.dot(axis, axis), 1e-12), 0.0), 1.0)
        at = a + t * axis
        d = x - at
        far = np.sqrt(np.dot(d, d)) + 1e-12
        depth = radii[c, 0] + t * (radii[c, 1] - radii[c, 0]) - far
        if depth > 0.0:
            normal = d / far
            at_before = before[c, 0] + t * (before[c, 1] - before[c, 0])
            into = np.dot(normal, (at - at_before) / dt - v)
            x += depth * normal
            v += max(into, 0.0) * normal
