"""Soft parts that lag and swing: masses on springs, carried along by the bones (the truth that LBS cannot explain).

A soft region holds masses. Each is tied to where the skeleton would put it (its goal) and to its neighbours, and feels
gravity; the rest shape is in balance with gravity. Skirt and hair are kept out of limbs. The skin moves as the masses
move and turn against their goals, so with stiff enough ties, or softness 0, it is linear blend skinning again.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sparse
from numba import njit

from tasks.geometry import rigid, rotations

SUBSTEPS = 16  # springs at 12 Hz with a dozen neighbours stay stable up to about 6 ms; this is 2 ms at 30 fps
GRAVITY = np.array([0.0, -9.81, 0.0])


@dataclass(frozen=True)
class Masses:
    """Masses of one soft region, M of them, S springs; all weigh the same.

    rest: (M, 3); hold: (M, J) how they follow the joints; spread: (N, M) how the skin follows them;
    tie: (M,) angular frequency of the tie to the goal in rad/s, inf for masses that sit on it; damping: share of
    critical; limit: metres at which the tie has become twice as stiff; springs: (S, 2), length: (S,) at which they
    pull nothing, stretch: (S,) their angular frequency; drag: 1/s against still air; avoid: joints whose parts it may
    not enter; margin: metres kept from them.
    """

    rest: np.ndarray
    hold: np.ndarray
    spread: sparse.csr_matrix
    tie: np.ndarray
    damping: float
    limit: float
    springs: np.ndarray
    length: np.ndarray
    stretch: np.ndarray
    drag: float
    avoid: tuple[str, ...]
    margin: float


@dataclass(frozen=True)
class Limbs:
    """C capsules that masses stay out of. ends: (F, C, 2, 3), rest: (C, 2, 3) theirs at rest, radii: (C, 2)."""

    ends: np.ndarray
    rest: np.ndarray
    radii: np.ndarray


def displace(
    m: Masses,
    bones: np.ndarray,
    skin: np.ndarray,
    limbs: Limbs,
    *,
    fps: float,
    softness: float,
) -> np.ndarray:
    """The skin after the masses have swung, starting at rest in the first frame's pose.

    bones: (F, J, 3, 4); skin: (F, N, 3) as linear blend skinning puts it; -> (F, N, 3) float32.
    """
    blended = np.einsum("mj,fjab->fmab", m.hold, bones.astype(np.float64))
    goals = rigid.apply(blended, m.rest)
    # what the tie must bear for the rest shape to stand still, turned with the bones
    borne = (blended[..., :3] @ balance(m)[..., None])[..., 0]
    tie = np.where(np.isinf(m.tie), 0.0, m.tie)
    path = integrate(
        goals,
        GRAVITY + borne,
        tie**2 / softness,
        2.0 * m.damping * tie / np.sqrt(softness),
        np.isinf(m.tie),
        m.limit,
        m.springs,
        m.length,
        m.stretch**2,
        m.drag,
        limbs.ends,
        limbs.radii + m.margin,
        slack(m, limbs),
        1.0 / (fps * SUBSTEPS),
        SUBSTEPS,
    )
    turn = turns(path, goals, m.springs) - np.eye(3)
    shift = path - goals - (turn @ goals[..., None])[..., 0]
    out = skin.copy()
    for f, moves in enumerate(rigid.make(turn, shift)):
        blend = (m.spread @ moves.reshape(-1, 12)).reshape(-1, 3, 4)
        out[f] += rigid.apply(blend, skin[f]).astype(np.float32)
    return out


def balance(m: Masses) -> np.ndarray:
    """(M, 3) accelerations that hold the masses at rest against gravity and the springs' pull."""
    force = np.tile(GRAVITY, (len(m.rest), 1))
    pull(m.rest, np.zeros_like(m.rest), m.springs, m.length, m.stretch**2, force)
    return -force


def slack(m: Masses, limbs: Limbs) -> np.ndarray:
    """(M, C) metres by which masses are inside the capsules at rest, margin included: where cloth meets the hip."""
    a, axis = limbs.rest[:, 0], limbs.rest[:, 1] - limbs.rest[:, 0]
    away = m.rest[:, None] - a
    t = np.clip((away * axis).sum(2) / np.maximum((axis**2).sum(1), 1e-12), 0.0, 1.0)
    radius = limbs.radii[:, 0] + t * (limbs.radii[:, 1] - limbs.radii[:, 0]) + m.margin
    return np.maximum(radius - np.linalg.norm(away - t[..., None] * axis, axis=2), 0.0)


def turns(path: np.ndarray, goals: np.ndarray, springs: np.ndarray) -> np.ndarray:
    """Rotations that best carry each mass's springs from goal to path, (F, M, 3, 3).

    As in shape matching (Mueller et al. 2005); a little identity keeps a straight chain from rolling about itself.
    """
    frames, count = goals.shape[:2]
    i, j = springs.T
    ones = np.ones(2 * len(springs))
    incidence = sparse.csr_matrix((ones, (np.concatenate([i, j]), np.tile(np.arange(len(i)), 2))), (count, len(i)))
    new, old = path[:, j] - path[:, i], goals[:, j] - goals[:, i]
    out = np.empty((frames, count, 3, 3))
    for f in range(frames):
        h = (incidence @ (new[f, :, :, None] * old[f, :, None, :]).reshape(-1, 9)).reshape(-1, 3, 3)
        size = incidence @ (old[f] ** 2).sum(1)
        out[f] = rotations.project_so3(h + 0.02 * size[:, None, None] * np.eye(3))
    return out


@njit(cache=True, nogil=True)
def integrate(
    goals, gravity, tie, damping, pinned, limit, springs, length, stretch, drag, limbs, radii, slack, dt, substeps
):  # fmt: skip
    """Positions of the masses at the frames, (F, M, 3); goals run along a cubic through the frames.

    Symplectic Euler, implicit in ties and damping, so any tie is stable.
    """
    frames, count = goals.shape[0], goals.shape[1]
    out = np.empty_like(goals)
    x, goal, next_goal = goals[0].copy(), goals[0].copy(), goals[0].copy()
    limb, next_limb = limbs[0].copy(), limbs[0].copy()
    v, force = np.zeros_like(x), np.zeros_like(x)
    out[0] = x
    for f in range(frames - 1):
        for step in range(1, substeps + 1):
            s = step / substeps
            between(goals, f, s, next_goal)
            next_limb[:] = limbs[f] + s * (limbs[f + 1] - limbs[f])
            force[:] = gravity[f] + s * (gravity[f + 1] - gravity[f]) - drag * v
            pull(x, v, springs, length, stretch, force)
            for m in range(count):
                if pinned[m]:
                    for i in range(3):
                        v[m, i] = (next_goal[m, i] - goal[m, i]) / dt
                        x[m, i] = next_goal[m, i]
                    continue
                away = 0.0
                for i in range(3):
                    away += (next_goal[m, i] - x[m, i]) ** 2
                k, c = tie[m] * (1.0 + away / limit**2), damping[m]
                for i in range(3):
                    pace = (next_goal[m, i] - goal[m, i]) / dt
                    pushed = v[m, i] + dt * (force[m, i] + k * (next_goal[m, i] - x[m, i]) + c * pace)
                    v[m, i] = pushed / (1.0 + dt * c + dt * dt * k)
                    x[m, i] += dt * v[m, i]
                keep_out(x[m], v[m], limb, next_limb, radii, slack[m], dt)
            goal[:] = next_goal
            limb[:] = next_limb
        out[f + 1] = x
    return out


@njit(cache=True, nogil=True)
def between(goals, f, s, out):
    """Catmull-Rom between frames f and f + 1 at 0 < s <= 1, into ``out``."""
    before, after = max(f - 1, 0), min(f + 2, goals.shape[0] - 1)
    s2, s3 = s * s, s * s * s
    for m in range(goals.shape[1]):
        for i in range(3):
            a, b = goals[f, m, i], goals[f + 1, m, i]
            ta, tb = 0.5 * (b - goals[before, m, i]), 0.5 * (goals[after, m, i] - a)
            out[m, i] = (2 * s3 - 3 * s2 + 1) * a + (s3 - 2 * s2 + s) * ta + (3 * s2 - 2 * s3) * b + (s3 - s2) * tb


@njit(cache=True, nogil=True)
def pull(x, v, springs, length, stretch, force):
    """Adds the springs' pull, with a fifth of critical damping along them, to ``force``."""
    for e in range(len(springs)):
        i, j = springs[e, 0], springs[e, 1]
        d0, d1, d2 = x[j, 0] - x[i, 0], x[j, 1] - x[i, 1], x[j, 2] - x[i, 2]
        now = np.sqrt(d0 * d0 + d1 * d1 + d2 * d2) + 1e-12
        d0, d1, d2 = d0 / now, d1 / now, d2 / now
        closing = (v[j, 0] - v[i, 0]) * d0 + (v[j, 1] - v[i, 1]) * d1 + (v[j, 2] - v[i, 2]) * d2
        push = stretch[e] * (now - length[e]) + 0.4 * np.sqrt(stretch[e]) * closing
        force[i, 0] += push * d0
        force[i, 1] += push * d1
        force[i, 2] += push * d2
        force[j, 0] -= push * d0
        force[j, 1] -= push * d1
        force[j, 2] -= push * d2


@njit(cache=True, nogil=True)
def keep_out(x, v, before, after, radii, slack, dt):
    """Moves one mass out of the floor and of the capsules, and takes from its speed what runs into them."""
    if x[1] < 0.02:
        x[1] = 0.02
        v[1] = max(v[1], 0.0)
    for c in range(len(radii)):
        a, b = after[c, 0], after[c, 1]
        along = size = 0.0
        for i in range(3):
            along += (x[i] - a[i]) * (b[i] - a[i])
            size += (b[i] - a[i]) ** 2
        t = min(max(along / max(size, 1e-12), 0.0), 1.0)
        far = 0.0
        for i in range(3):
            far += (x[i] - a[i] - t * (b[i] - a[i])) ** 2
        far = np.sqrt(far) + 1e-12
        depth = radii[c, 0] + t * (radii[c, 1] - radii[c, 0]) - slack[c] - far
        if depth <= 0.0:
            continue
        into = 0.0
        for i in range(3):
            at = a[i] + t * (b[i] - a[i])
            was = before[c, 0, i] + t * (before[c, 1, i] - before[c, 0, i])
            into += (x[i] - at) / far * ((at - was) / dt - v[i])
        for i in range(3):
            normal = (x[i] - a[i] - t * (b[i] - a[i])) / far
            x[i] += depth * normal
            v[i] += max(into, 0.0) * normal
