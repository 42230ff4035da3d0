"""A tetrahedral lattice that holds a shape: the same for the same points, whatever their surface is like."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import permutations, product

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from tasks.geometry.measure import diagonal

FINEST, COARSEST = 0.002, 0.3  # of the diagonal: bounds of the cells' size
_CORNERS = np.array(list(product((0, 1), repeat=3)))  # (8, 3), the last axis fastest
_FACES = ndimage.generate_binary_structure(3, 1)  # cells that share a face are neighbours


@dataclass(frozen=True)
class Lattice:
    """vertices: (V, 3); tets: (6 C, 4) int64; corners: (C, 8) vertices of every cell; cells: (C, 3) their places on
    the grid; origin: (3,) and size: of a cell."""

    vertices: np.ndarray
    tets: np.ndarray
    corners: np.ndarray
    cells: np.ndarray
    origin: np.ndarray
    size: float

    def interpolate(self, values: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Values (V, K) at points (N, 3): trilinear in the cell that holds a point, or in the nearest one."""
        place = (points - self.origin) / self.size
        nearest = cKDTree(self.cells + 0.5).query(place, p=np.inf)[1]
        inside = np.clip(place - self.cells[nearest], 0, 1)  # (N, 3)
        share = np.prod(np.where(_CORNERS, inside[:, None], 1 - inside[:, None]), axis=2)  # (N, 8)
        return np.einsum("nc,nck->nk", share, values[self.corners[nearest]])


def lattice(points: np.ndarray, faces: np.ndarray | None, cells: int) -> Lattice:
    """The finest lattice of at most so many cells that covers a shape, hollows filled.

    points: (N, 3); faces: (T, 3) or None for bare points. Only its largest connected part is kept: what lies apart
    takes the values of the nearest cell. Every cell is cut into six tetrahedra, alike, so that neighbours fit.
    """
    points = np.asarray(points, np.float64)
    low, high = FINEST, COARSEST
    for _ in range(24):  # by bisection on the size
        middle = np.sqrt(low * high)
        full = _filled(points, faces, middle * diagonal(points))
        low, high = (middle, high) if full.sum() > cells else (low, middle)
    size = high * diagonal(points)
    return _cut(_filled(points, faces, size), points.min(0) - size, size)


def _filled(points: np.ndarray, faces: np.ndarray | None, size: float) -> np.ndarray:
    """Which cells of the grid the shape touches or encloses, of its largest connected part; one empty cell around."""
    samples = points if faces is None else np.concatenate([points, _on_faces(points, faces, 0.5 * size)])
    place = np.floor((samples - points.min(0)) / size).astype(np.int64) + 1
    grid = np.zeros(place.max(0) + 2, bool)
    grid[tuple(place.T)] = True
    grid = ndimage.binary_fill_holes(grid)
    label, count = ndimage.label(grid, _FACES)
    return grid if count < 2 else label == 1 + np.argmax(np.bincount(label.ravel())[1:])


def _on_faces(points: np.ndarray, faces: np.ndarray, spacing: float) -> np.ndarray:
    """Points on the triangles, nowhere farther apart than the spacing."""
    a, b, c = (points[faces[:, k]] for k in range(3))
    longest = np.max([np.linalg.norm(x - y, axis=1) for x, y in ((a, b), (b, c), (c, a))], axis=0)
    parts = np.ceil(longest / spacing).astype(np.int64)
    out = []
    for n in np.unique(parts[parts > 1]):
        some = parts == n
        u, v = (x.ravel() for x in np.meshgrid(np.arange(n + 1), np.arange(n + 1), indexing="ij"))
        u, v = (x[u + v <= n, None] / n for x in (u, v))
        out.append((a[some, None] * (1 - u - v) + b[some, None] * u + c[some, None] * v).reshape(-1, 3))
    return np.concatenate([np.zeros((0, 3)), *out])


def _cut(grid: np.ndarray, origin: np.ndarray, size: float) -> Lattice:
    cells = np.argwhere(grid)
    shape = np.array(grid.shape) + 1
    flat = np.ravel_multi_index(tuple((cells[:, None] + _CORNERS).reshape(-1, 3).T), shape)
    used, corners = np.unique(flat, return_inverse=True)
    corners = corners.reshape(-1, 8)
    vertices = np.stack(np.unravel_index(used, shape), axis=1) * size + origin
    tets = []
    for order in permutations(range(3)):  # Kuhn: one tetrahedron for every way along the edges from corner to corner
        steps = np.cumsum([np.zeros(3, int), *np.eye(3, dtype=int)[list(order)]], axis=0)
        path = steps @ [4, 2, 1]
        odd = np.linalg.det(np.diff(steps, axis=0)) < 0
        tets.append(corners[:, path[[0, 2, 1, 3]] if odd else path])
    return Lattice(vertices, np.concatenate(tets).astype(np.int64), corners, cells, origin, size)
