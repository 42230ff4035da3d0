"""The border of the solid that a triangle soup encloses, by winding number and marching cubes."""

from __future__ import annotations

import igl
import numpy as np
from scipy.sparse import csr_matrix, diags_array, eye_array

from tasks.errors import InputError
from tasks.geometry.neighbours import adjacency
from tasks.skeleton.manifold import components_of
from tasks.skeleton.mend import mend

_COARSE = 4  # fine cells along a coarse one
# passes of smoothing, cells the border moves out and what that costs, in half handles: smoothing closes tunnels that
# single wrong normals make, moving out joins parts and thickens sheets but swallows limbs
_ATTEMPTS = (
    (0, 0.0, 0.0),
    (1, 0.0, 1.0),
    (4, 0.0, 2.0),
    (4, 0.5, 3.0),
    (8, 0.5, 4.0),
    (8, 1.0, 8.0),
    (8, 2.0, 16.0),
    (8, 4.0, 32.0),
)
_ENOUGH = 0.98  # of the points, in or near the component that is kept
_PER_HANDLE, _PER_LOSS = 2.0, 1000.0  # on the scale of these costs: a handle, and all points lost
_CORNERS = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]])
_EDGES = [(a, b) for a in range(8) for b in range(a) if np.abs(_CORNERS[a] - _CORNERS[b]).sum() == 1]


def border(vertices: np.ndarray, faces: np.ndarray, points: np.ndarray, cells: int) -> tuple[np.ndarray, np.ndarray]:
    """The largest closed component round a soup of triangles -> vertices (V, 3), faces (T, 3).

    vertices: (S, 3); faces: (R, 3); points: (N, 3) that it should hold; cells: grid cells along the longest side.
    Inside is where the winding number exceeds one half. The signed distance is smoothed, and where the solid falls
    into parts, is too thin for the grid or riddled with tunnels, its border moves out: as little as gives one part
    that holds nearly all the points and has few handles.
    """
    size = float(np.ptp(points, axis=0).max()) / cells
    corners, cubes, distance = _sample(vertices, faces, points, size)
    smooth = None
    best, best_score, passed = None, np.inf, 0
    for passes, swell, cost in _ATTEMPTS:
        if cost >= best_score:
            break
        if passes > passed:
            smooth = _averaging(cubes, len(corners)) if smooth is None else smooth
        for _ in range(passes - passed):
            distance = smooth @ distance
        passed = passes
        mesh = _largest(distance - swell * size, corners, cubes)
        if mesh is not None:
            lost = max(0.0, _ENOUGH - _share(*mesh, points, 1.5 * size))
            score = cost + _PER_HANDLE * _handles(*mesh) + _PER_LOSS * lost
            if score < best_score:
                best, best_score = mesh, score
    if best is None:
        raise InputError("Canonical.points", expected="a shape that encloses a volume", found="none at this grid")
    return best


def _averaging(cubes: np.ndarray, count: int) -> csr_matrix:
    """Half the value of a corner and half the mean of its neighbours along the grid's edges."""
    near = adjacency(np.concatenate([cubes[:, pair] for pair in _EDGES]), count)
    degree = np.asarray(near.sum(axis=1)).ravel()
    return (0.5 * eye_array(count) + 0.5 * diags_array(1.0 / degree) @ near).tocsr()


def _handles(vertices: np.ndarray, faces: np.ndarray) -> float:
    """Genus of one closed component, from Euler's formula V - E + T = 2 - 2 g."""
    return 1.0 - (len(vertices) - 0.5 * len(faces)) / 2.0


def _sample(
    vertices: np.ndarray, faces: np.ndarray, points: np.ndarray, size: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Signed distance (negative inside) at the corners of the fine cubes that may hold the border.

    -> corners (K, 3), cubes (C, 8) of corner numbers, distance (K,).
    """
    step = _COARSE * size
    low = points.min(0) - 1.5 * step
    shape = np.ceil((points.max(0) + 1.5 * step - low) / step).astype(np.int64)
    coarse = _lattice(shape)
    corners, cubes = _cubes(coarse, low, step)
    sign = _winding(vertices, faces, corners) > 0.5
    mixed = sign[cubes].any(1) & ~sign[cubes].all(1)  # the border may span a hole, far from any triangle
    middle = low + (coarse + 0.5) * step
    squared, _, _ = igl.point_mesh_squared_distance(middle, vertices, faces)
    reach = 0.5 * np.sqrt(3.0) * step + (_ATTEMPTS[-1][1] + 1.0) * size
    chosen = coarse[mixed | (squared < reach**2)]
    fine = (chosen[:, None] * _COARSE + _lattice(np.full(3, _COARSE))).reshape(-1, 3)
    corners, cubes = _cubes(fine, low, size)
    squared, _, _ = igl.point_mesh_squared_distance(corners, vertices, faces)
    distance = np.maximum(np.sqrt(squared), 1e-6 * size)  # a corner on the border would give triangles without area
    return corners, cubes, np.where(_winding(vertices, faces, corners) > 0.5, -distance, distance)


def _lattice(shape: np.ndarray) -> np.ndarray:
    return np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=-1).reshape(-1, 3)


def _cubes(cells: np.ndarray, low: np.ndarray, size: float) -> tuple[np.ndarray, np.ndarray]:
    """Corners (K, 3) of grid cells (C, 3), each once, and the eight corners of each cell (C, 8)."""
    width = int(cells.max()) + 2
    key = (cells[:, None] + _CORNERS) @ np.array([1, width, width * width])
    unique, cubes = np.unique(key, return_inverse=True)
    corner = np.stack([unique % width, unique // width % width, unique // width**2], axis=1)
    return low + corner * size, cubes.reshape(-1, 8)


def _winding(vertices: np.ndarray, faces: np.ndarray, queries: np.ndarray) -> np.ndarray:
    return igl.fast_winding_number(vertices, faces, np.ascontiguousarray(queries))


def _largest(values: np.ndarray, corners: np.ndarray, cubes: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """The component of the zero surface that encloses most, turned outwards; None when there is none."""
    vertices, faces, _ = igl.marching_cubes(values, corners, cubes, 0.0)
    if not len(faces):
        return None
    number, part = components_of(faces, len(vertices))
    a, b, c = (vertices[faces[:, k]] - corners[0] for k in range(3))
    volume = np.bincount(part, np.einsum("ij,ij->i", a, np.cross(b, c)), minlength=number)
    return mend(vertices, faces[part == np.argmax(volume)])  # closed unless it ran out of the sampled cubes


def _share(vertices: np.ndarray, faces: np.ndarray, points: np.ndarray, near: float) -> float:
    """The part of the points that lies inside or near the surface."""
    squared, _, _ = igl.point_mesh_squared_distance(points, vertices, faces)
    return float(np.mean((squared < near**2) | (_winding(vertices, faces, points) > 0.5)))
