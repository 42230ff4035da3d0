"""Cloth over a moving body, simulated in a small way: masses, threads, air, skin and friction (extended position based
dynamics with small steps: Macklin et al. 2016 and 2019), drawn to where regression foretells it.

What cloth does depends on what it did: a state carried from frame to frame, which poses alone do not tell.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numba import njit

from tasks.geometry.parallel import for_chunks
from tasks.motion.outline import Outline, nearest_bone, radius_at, seen_from_bone

GRAVITY = 9.81  # m/s^2
SEARCH = 4  # steps after which the nearest bone is looked for again


@dataclass(frozen=True)
class Fabric:
    """edges: (E, 2) int64; length: (E,) metres; mass: (N,) kg; stretch: N/m; drag: 1/s; friction: Coulomb's."""

    edges: np.ndarray
    length: np.ndarray
    mass: np.ndarray
    stretch: float
    drag: float
    friction: float


def fabric(
    rest: np.ndarray, faces: np.ndarray, *, density: float, stretch: float, drag: float, friction: float
) -> Fabric:
    """Cloth of ``density`` kg/m^2 whose stress-free shape is ``rest``, (N, 3) metres."""
    corners = rest[faces].astype(np.float64)
    edges = np.unique(np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1), axis=0)
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    mass = density * np.bincount(faces.ravel(), np.repeat(area / 3, 3), len(rest))
    mass = np.maximum(mass, 0.01 * mass.mean())  # points of no face, or of slivers
    length = np.linalg.norm(rest[edges[:, 0]].astype(np.float64) - rest[edges[:, 1]], axis=1)
    return Fabric(edges.astype(np.int64), length, mass, stretch, drag, friction)


def simulate(
    cloth: Fabric,
    body: Outline,
    world: np.ndarray,
    target: np.ndarray,
    pull: np.ndarray,
    clip_start: np.ndarray,
    *,
    fps: float,
    substeps: int,
) -> np.ndarray:
    """Points in every frame, (F, N, 3) float64, clip by clip from where they are foretold to begin.

    world: (F, J, 3, 4) of the joints; target: (F, N, 3) where the points are foretold; pull: (F, N) how stiffly they
    are drawn there, as the angular frequency in rad/s at which a point alone would swing about it. Metres.
    """
    bones, out = body.posed(world), np.empty(target.shape)
    clips = list(pairwise(clip_start))

    def work(first: int, last: int) -> None:
        for a, b in clips[first:last]:
            begin = target[a].astype(np.float64)
            speed = (target[min(a + 1, b - 1)] - begin) * fps
            _simulate(
                begin,
                speed,
                np.ascontiguousarray(bones[a:b]),
                body.length,
                body.radius,
                cloth.edges,
                cloth.length,
                1.0 / cloth.mass,
                1.0 / cloth.stretch,
                cloth.drag,
                cloth.friction,
                target[a:b],
                pull[a:b],
                fps,
                substeps,
                out[a:b],
            )

    for_chunks(work, len(clips), 1)
    return out


@njit(cache=True, nogil=True)
def _simulate(x, v, bones, length, radius, edges, rest, ease, give, drag, friction, target, pull, fps, substeps, out):
    """x, v: (N, 3) at the first frame, changed in place; ease: (N,) 1 / kg; give: m/N of an edge."""
    frames, step = len(bones), 1.0 / (fps * substeps)
    kept = np.exp(-drag * step)
    before, now, then = np.empty_like(x), bones[0].copy(), np.empty_like(bones[0])
    near = np.zeros(len(x), np.int64)
    out[0] = x
    for f in range(1, frames):
        e, h = max(f - 2, 0), min(f + 1, frames - 1)
        for k in range(1, substeps + 1):
            t = k / substeps
            # Catmull-Rom, so that velocities have no jumps
            a, b = 2 * t**3 - 3 * t**2 + 1, t**3 - 2 * t**2 + t
            c, d = 3 * t**2 - 2 * t**3, t**3 - t**2
            then[:] = now
            now[:] = (
                a * bones[f - 1] + 0.5 * b * (bones[f] - bones[e]) + c * bones[f] + 0.5 * d * (bones[h] - bones[f - 1])
            )
            for n in range(len(x)):
                v[n, 1] -= GRAVITY * step
                drawn = (((1.0 - t) * pull[f - 1, n] + t * pull[f, n]) * step) ** 2
                drawn /= 1.0 + drawn
                for i in range(3):
                    v[n, i] *= kept
                    before[n, i] = x[n, i]
                    x[n, i] += step * v[n, i]
                    last, this = target[f - 1, n, i], target[f, n, i]
                    goal = a * last + 0.5 * b * (this - target[e, n, i]) + c * this + 0.5 * d * (target[h, n, i] - last)
                    x[n, i] += drawn * (goal - x[n, i])
            _hold(x, edges, rest, ease, give / step**2)
            for n in range(len(x)):
                if k % SEARCH == 1:
                    near[n] = nearest_bone(x[n], now, length)
                s = near[n]
                if s >= 0:
                    _keep_out(x[n], before[n], now[s], then[s], length[s], radius[s], friction)
                for i in range(3):
                    v[n, i] = (x[n, i] - before[n, i]) / step
        out[f] = x


@njit(cache=True, nogil=True)
def _hold(x, edges, rest, ease, give):
    """Every edge in turn is brought to its length, as far as its stretch does not give."""
    for e in range(len(edges)):
        i, j = edges[e, 0], edges[e, 1]
        dx, dy, dz = x[i, 0] - x[j, 0], x[i, 1] - x[j, 1], x[i, 2] - x[j, 2]
        now = np.sqrt(dx * dx + dy * dy + dz * dz) + 1e-12
        share = (now - rest[e]) / (now * (ease[i] + ease[j] + give))
        a, b = share * ease[i], share * ease[j]
        x[i, 0] -= a * dx
        x[i, 1] -= a * dy
        x[i, 2] -= a * dz
        x[j, 0] += b * dx
        x[j, 1] += b * dy
        x[j, 2] += b * dz


@njit(cache=True, nogil=True)
def _keep_out(x, before, now, then, length, radius, friction):
    """A point inside the outline of a bone goes to its skin, which drags it along as far as friction holds."""
    along, within, y, z, distance = seen_from_bone(x, now, length)
    skin = radius_at(radius, within, length, y, z)
    if distance >= skin or distance < 1e-6:
        return
    out = skin / distance - 1.0
    u, v, w = along + out * (along - within), y + out * y, z + out * z
    slip = np.empty(3)
    normal = np.empty(3)
    into = 0.0
    for i in range(3):
        normal[i] = ((along - within) * now[1, i] + y * now[2, i] + z * now[3, i]) / distance
        here = now[0, i] + u * now[1, i] + v * now[2, i] + w * now[3, i]
        there = then[0, i] + u * then[1, i] + v * then[2, i] + w * then[3, i]
        slip[i] = (here - before[i]) - (here - there)
        into += slip[i] * normal[i]
        x[i] = here
    size = 0.0
    for i in range(3):
        slip[i] -= into * normal[i]
        size += slip[i] ** 2
    held = min(1.0, friction * (skin - distance) / (np.sqrt(size) + 1e-12))
    for i in range(3):
        x[i] -= held * slip[i]
