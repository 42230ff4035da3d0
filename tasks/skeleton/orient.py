"""Bare points as a soup of little cells that face outwards."""

from __future__ import annotations

import numpy as np
from numba import njit
from scipy import ndimage
from scipy.spatial import cKDTree

_CELLS = 64  # of the flooded grid along the longest side
_BALLS = (0.5, 0.75, 1.0, 1.5)  # radii tried, of the distance to the last neighbour
_ROUNDS = 20


def tangent_cells(points: np.ndarray, neighbours: int) -> tuple[np.ndarray, np.ndarray]:
    """A soup of triangles that nearly tiles the surface the points lie on, facing outwards.

    points: (N, 3) -> vertices (V, 3), faces (T, 3): for each point the Voronoi cell among its neighbours in its
    tangent plane, as a fan. Its winding number is that of oriented points with their areas (Barill et al. 2018).
    """
    points = np.unique(points, axis=0)
    distance, near = cKDTree(points).query(points, k=min(neighbours, len(points) - 1) + 1)
    normal = outward_normals(points, near, distance[:, -1])
    across = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal), axis=1)])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    rims, sides = _cells(points, normal, across, near, distance[:, -1])
    owner = np.repeat(np.arange(len(points)), sides)
    first = np.cumsum(sides) - sides
    rim = np.arange(len(owner))
    following = np.where(rim + 1 < (first + sides)[owner], rim + 1, first[owner])
    rims = rims[np.arange(rims.shape[1]) < sides[:, None]]
    faces = np.stack([owner, len(points) + rim, len(points) + following], axis=1)
    return np.concatenate([points, rims]), faces


@njit(cache=True, nogil=True)
def _cells(points, normal, across, near, reach):
    """Corners (N, k+4, 3) of each cell, in turn about its normal, and how many there are (N,)."""
    room = near.shape[1] + 3
    rims, sides = np.zeros((len(points), room, 3)), np.zeros(len(points), np.int64)
    x, y, u, v = np.empty(room), np.empty(room), np.empty(room), np.empty(room)
    for i in range(len(points)):
        up = np.cross(normal[i], across[i])
        x[:4] = np.array([-1.0, 1.0, 1.0, -1.0]) * reach[i]
        y[:4] = np.array([-1.0, -1.0, 1.0, 1.0]) * reach[i]
        count = 4
        for j in near[i, 1:]:
            if np.dot(normal[i], normal[j]) <= 0.0:  # the other side of a thin part
                continue
            way = points[j] - points[i]
            a, b = np.dot(way, across[i]), np.dot(way, up)
            kept = 0
            for c in range(count):  # Sutherland & Hodgman 1974: keep the half plane nearer to i than to j
                d = (c + 1) % count
                over, next_over = a * x[c] + b * y[c] - (a * a + b * b) / 2, a * x[d] + b * y[d] - (a * a + b * b) / 2
                if over <= 0.0:
                    u[kept], v[kept] = x[c], y[c]
                    kept += 1
                if (over <= 0.0) != (next_over <= 0.0):
                    t = over / (over - next_over)
                    u[kept], v[kept] = x[c] + t * (x[d] - x[c]), y[c] + t * (y[d] - y[c])
                    kept += 1
            count = kept
            x[:count], y[:count] = u[:count], v[:count]
        sides[i] = count
        for c in range(count):
            rims[i, c] = points[i] + x[c] * across[i] + y[c] * up
    return rims, sides


def outward_normals(points: np.ndarray, near: np.ndarray, reach: np.ndarray) -> np.ndarray:
    """Unit normals that look outwards. points: (N, 3); near: (N, k+1) nearest points, itself first; reach: (N,)
    distance to the last of them -> (N, 3).

    The line of each normal is the least axis of the neighbours' scatter. Its side comes from where a flood from
    outside gets to between balls round the points; balls are as large as decides most points. Points that the
    flood leaves open (thin parts) and strays follow those neighbours whose offset lies in both tangent planes.
    """
    offset = points[near] - points[near].mean(axis=1, keepdims=True)
    normal = np.linalg.eigh(np.einsum("nki,nkj->nij", offset, offset))[1][:, :, 0]
    vote = _flood(points, normal, reach)
    others = near[:, 1:]
    way = points[others] - points[:, None]
    way /= np.maximum(np.linalg.norm(way, axis=2, keepdims=True), 1e-30)
    here, there = (
        np.abs(np.einsum(how, way, n)) for how, n in (("nki,ni->nk", normal), ("nki,nki->nk", normal[others]))
    )
    alike = np.maximum(0.0, 1.0 - 2.0 * np.maximum(here, there)) * np.einsum("ni,nki->nk", normal, normal[others])
    side = vote.astype(np.float64)
    for _ in range(_ROUNDS):
        side = np.sign(vote + np.einsum("nk,nk->n", alike, side[others]))
    return normal * np.where(side < 0, -1.0, 1.0)[:, None]


def _flood(points: np.ndarray, normal: np.ndarray, reach: np.ndarray) -> np.ndarray:
    """(N,) 1 where only the normal's side is reached from outside, -1 where only the other one is, else 0."""
    size = float(np.ptp(points, axis=0).max()) / _CELLS
    least = 0.5 * np.sqrt(3.0) * size  # a ball no cell slips through
    margin = max(_BALLS[-1] * float(reach.max()), least) + 2.0 * size
    low = points.min(0) - margin
    shape = np.ceil((points.max(0) + margin - low) / size).astype(np.int64)
    middle = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=-1) + 0.5
    distance, nearest = cKDTree(points).query(low + middle * size)
    votes = []
    for ball in _BALLS:
        radius = np.maximum(ball * reach, least)
        part, _ = ndimage.label(distance > radius[nearest])
        reached = part == part[0, 0, 0]
        step = (radius + size)[:, None] * normal
        fore, aft = (reached[tuple(((x - low) / size).astype(np.int64).T)] for x in (points + step, points - step))
        votes.append(fore.astype(np.int64) - aft.astype(np.int64))
    return votes[int(np.argmax([np.count_nonzero(vote) for vote in votes]))]
