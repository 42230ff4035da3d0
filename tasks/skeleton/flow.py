"""Mean curvature flow that shrinks a closed surface onto its inner curve (Tagliasacchi et al. 2012, CGAL's variant)."""

from __future__ import annotations

import numpy as np
from numba import njit
from scipy.spatial import Delaunay

from tasks.skeleton import halfedge
from tasks.skeleton.halfedge import Mesh, after, before

_LARGEST_COTANGENT = 1e3  # slivers must not drown the other rows of the system
_FLAT = 1e-6  # volume over the product of three edges
_SOLVER_ROUNDS = 200


def contract(
    vertices: np.ndarray,
    faces: np.ndarray,
    poles: np.ndarray,
    *,
    speed: float,
    medial: float,
    edge: float,
    angle: float,
    stop: float,
    rounds: int,
) -> tuple[Mesh, np.ndarray]:
    """Shrinks until a round takes less than `stop` of the first area away.

    vertices: (V, 3), faces: (T, 3) closed; poles: (V, 3), NaN where there is none; speed: w_H, small is fast; medial:
    w_M, pull towards the pole; edge: length under which edges collapse; angle: degrees above which triangles are split
    -> the thin mesh, into: for every vertex ever used, the vertex it was merged into (itself when still there).
    """
    mesh = halfedge.build(vertices, faces, spare=2 * len(vertices))
    room = len(mesh.position)
    pole = np.full((room, 3), np.nan)
    pole[: len(vertices)] = poles
    into = np.arange(room)
    frozen = np.zeros(room, np.bool_)
    first_area = last_area = _area(mesh)
    for _ in range(rounds):
        _solve(mesh, pole, frozen, speed, medial, 1e-3 * edge)
        _collapse_short(mesh, pole, frozen, into, edge)
        _split_wide(mesh, pole, frozen, edge, np.cos(np.deg2rad(angle)))
        _freeze(mesh, frozen, edge)
        area = _area(mesh)
        if last_area - area < stop * first_area:
            break
        last_area = area
    return mesh, into


def medial_poles(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """The farthest corner of each vertex's Voronoi cell on the inner side: (V, 3), near the medial axis.

    Amenta & Bern 1999; corners are circumcentres of Delaunay tetrahedra. A vertex without such a corner gets NaN.
    """
    tetrahedra = Delaunay(vertices).simplices
    centre = _circumcentres(vertices, tetrahedra)
    owner, centre = tetrahedra.ravel(), np.repeat(centre, 4, axis=0)
    arm = centre - vertices[owner]
    inside = np.einsum("ij,ij->i", arm, vertex_normals(vertices, faces)[owner]) < 0.0
    inside &= np.all((centre >= vertices.min(0)) & (centre <= vertices.max(0)), axis=1)
    owner, centre, reach = owner[inside], centre[inside], np.linalg.norm(arm[inside], axis=1)
    order = np.lexsort((reach, owner))
    last = order[np.append(np.flatnonzero(np.diff(owner[order])), len(order) - 1)] if len(order) else order
    pole = np.full((len(vertices), 3), np.nan)
    pole[owner[last]] = centre[last]
    return pole


def _circumcentres(vertices: np.ndarray, tetrahedra: np.ndarray) -> np.ndarray:
    """(T, 3); NaN for tetrahedra so flat that rounding would place the centre."""
    corner = vertices[tetrahedra[:, 0]]
    a, b, c = (vertices[tetrahedra[:, k]] - corner for k in (1, 2, 3))
    bc, ca, ab = np.cross(b, c), np.cross(c, a), np.cross(a, b)
    volume = np.einsum("ij,ij->i", a, bc)
    aa, bb, cc = (np.einsum("ij,ij->i", x, x) for x in (a, b, c))
    volume[np.abs(volume) < _FLAT * np.sqrt(aa * bb * cc)] = np.nan
    return corner + (aa[:, None] * bc + bb[:, None] * ca + cc[:, None] * ab) / (2.0 * volume[:, None])


def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Outward unit normals weighted by angle: (V, 3); zero where the triangles round a vertex have no area."""
    corners = vertices[faces]
    face_normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    face_normal /= np.maximum(np.linalg.norm(face_normal, axis=1, keepdims=True), 1e-300)
    out = np.zeros((len(vertices), 3))
    for c in range(3):
        a, b = corners[:, (c + 1) % 3] - corners[:, c], corners[:, (c + 2) % 3] - corners[:, c]
        turn = np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), np.einsum("ij,ij->i", a, b))
        for x in range(3):
            out[:, x] += np.bincount(faces[:, c], turn * face_normal[:, x], minlength=len(vertices))
    length = np.linalg.norm(out, axis=1, keepdims=True)
    return np.where(length > 1e-12, out / np.maximum(length, 1e-300), 0.0)


@njit(cache=True, nogil=True)
def _area(mesh):
    total = 0.0
    for t in range(mesh.used[1]):
        if mesh.origin[3 * t] >= 0:
            a, b, c = (
                mesh.position[mesh.origin[3 * t]],
                mesh.position[mesh.origin[3 * t + 1]],
                mesh.position[mesh.origin[3 * t + 2]],
            )
            total += 0.5 * np.sqrt(_cross_squared(a, b, c))
    return total


@njit(cache=True, nogil=True)
def _cross_squared(a, b, c):
    """Squared length of (b - a) x (c - a)."""
    p0, p1, p2 = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    q0, q1, q2 = c[0] - a[0], c[1] - a[1], c[2] - a[2]
    return (p1 * q2 - p2 * q1) ** 2 + (p2 * q0 - p0 * q2) ** 2 + (p0 * q1 - p1 * q0) ** 2


@njit(cache=True, nogil=True)
def _cotangents(mesh, weight):
    """weight[h]: sum of the cotangents on both sides of the edge; those of obtuse angles count as zero, so that no
    vertex can leave the hull of its neighbours, its pole and its place."""
    for t in range(mesh.used[1]):
        for h in range(3 * t, 3 * t + 3):
            if mesh.origin[h] < 0:
                continue
            b, c, a = (
                mesh.position[mesh.origin[h]],
                mesh.position[mesh.origin[after(h)]],
                mesh.position[mesh.origin[before(h)]],
            )
            dot = (b[0] - a[0]) * (c[0] - a[0]) + (b[1] - a[1]) * (c[1] - a[1]) + (b[2] - a[2]) * (c[2] - a[2])
            weight[h] = 0.0
            if dot > 0.0:
                sine = np.sqrt(_cross_squared(a, b, c))
                weight[h] = dot / max(sine, dot / _LARGEST_COTANGENT)
    for h in range(3 * mesh.used[1]):
        g = mesh.twin[h]
        if mesh.origin[h] >= 0 and h < g:
            weight[h] += weight[g]
            weight[g] = weight[h]


@njit(cache=True, nogil=True)
def _system(mesh, pole, frozen, speed, medial):
    """The sparse system of one implicit step over the vertices that still move.

    Rows (sum_j w_ij + w_H + w_M) x_i - sum_j w_ij x_j = w_H x_i + w_M pole_i; frozen neighbours go to the right side.
    """
    count = mesh.used[0]
    weight = np.zeros(3 * mesh.used[1])
    _cotangents(mesh, weight)
    row_of = np.full(count, -1, np.int64)
    rows = 0
    for v in range(count):
        if mesh.first[v] >= 0 and not frozen[v]:
            row_of[v] = rows
            rows += 1
    start = np.zeros(rows + 1, np.int64)
    column = np.empty(3 * mesh.used[1], np.int64)
    value = np.empty(3 * mesh.used[1])
    diagonal = np.empty(rows)
    right = np.empty((rows, 3))
    vertex = np.empty(rows, np.int64)
    used = 0
    for v in range(count):
        r = row_of[v]
        if r < 0:
            continue
        vertex[r] = v
        pull = 0.0 if np.isnan(pole[v, 0]) else medial
        diagonal[r] = speed + pull
        for x in range(3):
            right[r, x] = speed * mesh.position[v, x] + (pull * pole[v, x] if pull > 0.0 else 0.0)
        h = mesh.first[v]
        while True:
            other = mesh.origin[after(h)]
            diagonal[r] += weight[h]
            if row_of[other] >= 0:
                column[used] = row_of[other]
                value[used] = weight[h]
                used += 1
            else:
                for x in range(3):
                    right[r, x] += weight[h] * mesh.position[other, x]
            h = mesh.twin[before(h)]
            if h == mesh.first[v]:
                break
        start[r + 1] = used
    return vertex, start, column, value, diagonal, right


@njit(cache=True, nogil=True)
def _solve(mesh, pole, frozen, speed, medial, tolerance):
    """One implicit step by conjugate gradients with the diagonal as preconditioner, the three coordinates at once."""
    vertex, start, column, value, diagonal, right = _system(mesh, pole, frozen, speed, medial)
    rows = len(vertex)
    x = np.empty((rows, 3))
    residual = np.empty((rows, 3))
    search = np.zeros((rows, 3))
    image = np.empty((rows, 3))
    for r in range(rows):
        x[r] = mesh.position[vertex[r]]
    _multiply(start, column, value, diagonal, x, image)
    rho = np.zeros(3)
    for r in range(rows):
        for k in range(3):
            residual[r, k] = right[r, k] - image[r, k]
    for step in range(_SOLVER_ROUNDS):
        fresh = np.zeros(3)
        worst = 0.0
        for r in range(rows):
            for k in range(3):
                shift = residual[r, k] / diagonal[r]
                fresh[k] += residual[r, k] * shift
                worst = max(worst, abs(shift))
        if worst < tolerance:
            break
        for r in range(rows):
            for k in range(3):
                beta = fresh[k] / rho[k] if step > 0 and rho[k] > 0.0 else 0.0
                search[r, k] = residual[r, k] / diagonal[r] + beta * search[r, k]
        rho = fresh
        _multiply(start, column, value, diagonal, search, image)
        along = np.zeros(3)
        for r in range(rows):
            for k in range(3):
                along[k] += search[r, k] * image[r, k]
        for r in range(rows):
            for k in range(3):
                alpha = rho[k] / along[k] if along[k] > 0.0 else 0.0
                x[r, k] += alpha * search[r, k]
                residual[r, k] -= alpha * image[r, k]
    for r in range(rows):
        mesh.position[vertex[r]] = x[r]


@njit(cache=True, nogil=True)
def _multiply(start, column, value, diagonal, x, out):
    for r in range(len(diagonal)):
        a, b, c = diagonal[r] * x[r, 0], diagonal[r] * x[r, 1], diagonal[r] * x[r, 2]
        for i in range(start[r], start[r + 1]):
            j, w = column[i], value[i]
            a -= w * x[j, 0]
            b -= w * x[j, 1]
            c -= w * x[j, 2]
        out[r, 0], out[r, 1], out[r, 2] = a, b, c


@njit(cache=True, nogil=True)
def _length_squared(mesh, h):
    a, b = mesh.position[mesh.origin[h]], mesh.position[mesh.origin[after(h)]]
    return (a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 + (a[2] - b[2]) ** 2


@njit(cache=True, nogil=True)
def _collapse_short(mesh, pole, frozen, into, edge):
    """Collapses edges shorter than `edge`, in the order of their numbers, until none is left that may."""
    changed = True
    while changed:
        changed = False
        for h in range(3 * mesh.used[1]):
            if mesh.origin[h] < 0 or h > mesh.twin[h] or _length_squared(mesh, h) >= edge * edge:
                continue
            keep, gone = mesh.origin[h], mesh.origin[after(h)]
            if (frozen[keep] and frozen[gone]) or not halfedge.can_collapse(mesh, h):
                continue
            if frozen[gone]:
                mesh.position[keep] = mesh.position[gone]
                frozen[keep] = True
            elif not frozen[keep]:
                middle = 0.5 * (mesh.position[keep] + mesh.position[gone])
                if _nearer(pole[gone], pole[keep], middle):
                    pole[keep] = pole[gone]
                mesh.position[keep] = middle
            halfedge.collapse(mesh, h)
            into[gone] = keep
            changed = True


@njit(cache=True, nogil=True)
def _nearer(a, b, point):
    if np.isnan(a[0]):
        return False
    if np.isnan(b[0]):
        return True
    return np.sum((a - point) ** 2) < np.sum((b - point) ** 2)


@njit(cache=True, nogil=True)
def _split_wide(mesh, pole, frozen, edge, cosine):
    """Splits edges that face a wide angle on both sides, at the foot of the wider one."""
    for h in range(3 * mesh.used[1]):
        if mesh.origin[h] < 0 or h > mesh.twin[h] or _length_squared(mesh, h) <= edge * edge:
            continue
        here, there = _cosine_opposite(mesh, h), _cosine_opposite(mesh, mesh.twin[h])
        if here >= cosine or there >= cosine:
            continue
        a, b = mesh.position[mesh.origin[h]], mesh.position[mesh.origin[after(h)]]
        tip = mesh.position[mesh.origin[before(h if here < there else mesh.twin[h])]]
        along = np.dot(tip - a, b - a) / _length_squared(mesh, h)
        halfedge.split(mesh, h, a + along * (b - a))


@njit(cache=True, nogil=True)
def _cosine_opposite(mesh, h):
    a, b, c = _length_squared(mesh, h), _length_squared(mesh, after(h)), _length_squared(mesh, before(h))
    if b == 0.0 or c == 0.0:
        return 1.0
    return (b + c - a) / (2.0 * np.sqrt(b * c))


@njit(cache=True, nogil=True)
def _freeze(mesh, frozen, short):
    """A vertex stops where the surface round it has no width left: two of its edges are very short and yet cannot
    collapse, because they go round the curve."""
    for v in range(mesh.used[0]):
        if mesh.first[v] < 0 or frozen[v]:
            continue
        stuck = 0
        h = mesh.first[v]
        while True:
            if _length_squared(mesh, h) < short * short and not halfedge.can_collapse(mesh, h):
                stuck += 1
            h = mesh.twin[before(h)]
            if h == mesh.first[v]:
                break
        frozen[v] = stuck >= 2
