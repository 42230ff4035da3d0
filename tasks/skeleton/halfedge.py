"""Closed triangle meshes as half-edges in flat arrays, with the two local changes that curve flow needs.

Half-edge h is corner h % 3 of triangle h // 3: it starts at ``origin[h]`` and ends where the next corner starts;
``twin[h]`` is the same edge in the neighbouring triangle; ``first[v]`` is any half-edge that starts at v. Removed
triangles have ``origin`` -1, removed vertices ``first`` -1.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit


class Mesh(NamedTuple):
    """A closed mesh with room to grow. position: (V, 3) float64; origin, twin: (3T,) int64; first: (V,) int64;
    used: [vertices, triangles] ever used; stamp: (V+1,) scratch marks of the kernels, the last one is their clock."""

    position: np.ndarray
    origin: np.ndarray
    twin: np.ndarray
    first: np.ndarray
    used: np.ndarray
    stamp: np.ndarray


def build(vertices: np.ndarray, faces: np.ndarray, spare: int) -> Mesh:
    """A mesh with room for `spare` more vertices. vertices: (V, 3); faces: (T, 3), closed and consistently turned."""
    count, triangles = len(vertices), len(faces)
    position = np.zeros((count + spare, 3))
    position[:count] = vertices
    origin = np.full(3 * (triangles + 2 * spare), -1, np.int64)
    origin[: 3 * triangles] = faces.ravel()
    first = np.full(count + spare, -1, np.int64)
    first[faces.ravel()] = np.arange(3 * triangles)
    twin = np.full(len(origin), -1, np.int64)
    twin[: 3 * triangles] = _twins(faces, count)
    stamp = np.zeros(count + spare + 1, np.int64)
    return Mesh(position, origin, twin, first, np.array([count, triangles]), stamp)


def _twins(faces: np.ndarray, count: int) -> np.ndarray:
    start, end = faces.ravel().astype(np.int64), np.roll(faces, -1, axis=1).ravel().astype(np.int64)
    forward, backward = start * count + end, end * count + start
    order = np.argsort(forward)
    return order[np.searchsorted(forward, backward, sorter=order)]


@njit(cache=True, nogil=True)
def after(h):
    """The next half-edge of the same triangle."""
    return h - 2 if h % 3 == 2 else h + 1


@njit(cache=True, nogil=True)
def before(h):
    """The previous half-edge of the same triangle."""
    return h + 2 if h % 3 == 0 else h - 1


@njit(cache=True, nogil=True)
def can_collapse(mesh, h):
    """Link condition (Dey et al. 1999): the ends share the two opposite vertices and no other neighbour."""
    u, v = mesh.origin[h], mesh.origin[after(h)]
    mesh.stamp[-1] += 1
    clock = mesh.stamp[-1]
    degree = 0
    g = mesh.first[u]
    while True:
        mesh.stamp[mesh.origin[after(g)]] = clock
        degree += 1
        g = mesh.twin[before(g)]
        if g == mesh.first[u]:
            break
    shared = 0
    g = mesh.first[v]
    while True:
        if mesh.stamp[mesh.origin[after(g)]] == clock:
            shared += 1
        degree += 1
        g = mesh.twin[before(g)]
        if g == mesh.first[v]:
            break
    return shared == 2 and degree > 6


@njit(cache=True, nogil=True)
def collapse(mesh, h):
    """Pulls the end of h into its start, which keeps its number; the caller places it and checks the link."""
    origin, twin, first = mesh.origin, mesh.twin, mesh.first
    u, v = origin[h], origin[after(h)]
    g = first[v]
    while True:
        origin[g] = u
        g = twin[before(g)]
        if g == first[v]:
            break
    for side in (h, twin[h]):
        outer, inner = twin[after(side)], twin[before(side)]
        twin[outer], twin[inner] = inner, outer
        first[origin[outer]] = outer
        first[origin[inner]] = inner
        t = side // 3 * 3
        origin[t : t + 3] = -1
    first[v] = -1


@njit(cache=True, nogil=True)
def split(mesh, h, point):
    """Puts a new vertex at `point` on the edge of h and returns its number; -1 when the room is used up."""
    origin, twin, first, used = mesh.origin, mesh.twin, mesh.first, mesh.used
    m, t = used[0], 3 * used[1]
    if m >= len(mesh.position) or t + 6 > len(origin):
        return -1
    used[0] += 1
    used[1] += 2
    mesh.position[m] = point
    g = twin[h]
    u, v = origin[h], origin[after(h)]
    a, b = origin[before(h)], origin[before(g)]
    va, ub = after(h), after(g)  # h: u-v-a becomes u-m-a, the new triangle t is m-v-a; g: v-u-b keeps v-m-b
    origin[t], origin[t + 1], origin[t + 2] = m, v, a
    origin[t + 3], origin[t + 4], origin[t + 5] = m, u, b
    outer = twin[va]
    twin[t + 1], twin[outer] = outer, t + 1
    twin[va], twin[t + 2] = t + 2, va
    outer = twin[ub]
    twin[t + 4], twin[outer] = outer, t + 4
    twin[ub], twin[t + 5] = t + 5, ub
    origin[va], origin[ub] = m, m
    twin[h], twin[t + 3] = t + 3, h
    twin[g], twin[t] = t, g
    first[m], first[v], first[u] = t, g, h
    return m


def faces_of(mesh: Mesh) -> np.ndarray:
    """(T, 3) int64 triangles that are left."""
    triangles = mesh.origin.reshape(-1, 3)
    return triangles[triangles[:, 0] >= 0]
