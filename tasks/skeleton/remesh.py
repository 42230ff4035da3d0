"""More or fewer vertices on the same closed surface, its tips kept."""

from __future__ import annotations

import igl
import numpy as np
from numba import njit

from tasks.skeleton import halfedge
from tasks.skeleton.halfedge import after, before

_STEPS = 6  # thresholds on the way down, a factor of sqrt(2) apart
_LONGEST = 1.75  # of the edge of an even mesh with that many vertices


def by_edges(vertices: np.ndarray, faces: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """About `count` vertices. vertices: (V, 3) float64; faces: (T, 3) int64, closed -> the same.

    Fewer by collapsing the shortest edges, more by halving the longest. Isotropic remeshing gives evener triangles
    but rounds off thin tips such as ears, which the skeleton should keep.
    """
    if len(vertices) > count:
        vertices, faces, _, _ = igl.decimate(np.asfortranarray(vertices), np.asfortranarray(faces, np.int32), 2 * count)
        return np.ascontiguousarray(vertices), np.ascontiguousarray(faces, np.int64)
    longest = _LONGEST * np.sqrt(2.0 / np.sqrt(3.0) * _area(vertices, faces) / count)
    mesh = halfedge.build(vertices, faces, spare=2 * count)
    for step in range(_STEPS, -1, -1):
        _halve(mesh, longest * np.sqrt(2.0) ** step)
    return mesh.position[: mesh.used[0]], halfedge.faces_of(mesh)


def isotropic(vertices: np.ndarray, faces: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """About `count` vertices with even triangles (Botsch & Kobbelt 2004, as pymeshlab has it); rounds off thin tips.

    vertices: (V, 3) float64; faces: (T, 3) int64 -> the same.
    """
    import pymeshlab  # GPL-3: imported here and nowhere else

    meshes = pymeshlab.MeshSet(verbose=False)
    meshes.add_mesh(pymeshlab.Mesh(vertices, faces))
    edge = pymeshlab.PureValue(np.sqrt(2.0 / np.sqrt(3.0) * _area(vertices, faces) / count))
    meshes.meshing_isotropic_explicit_remeshing(targetlen=edge, iterations=5)
    made = meshes.current_mesh()
    return made.vertex_matrix(), made.face_matrix().astype(np.int64)


def _area(vertices: np.ndarray, faces: np.ndarray) -> float:
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return float(0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())


@njit(cache=True, nogil=True)
def _halve(mesh, longest):
    """Halves edges longer than `longest` that are the longest of both their triangles, until there are none."""
    changed = True
    while changed:
        changed = False
        for h in range(3 * mesh.used[1]):
            length = _length(mesh, h)
            if length <= longest or _side(mesh, h) > length or _side(mesh, mesh.twin[h]) > length:
                continue
            middle = 0.5 * (mesh.position[mesh.origin[h]] + mesh.position[mesh.origin[after(h)]])
            changed |= halfedge.split(mesh, h, middle) >= 0


@njit(cache=True, nogil=True)
def _length(mesh, h):
    a, b = mesh.position[mesh.origin[h]], mesh.position[mesh.origin[after(h)]]
    return np.sqrt((a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 + (a[2] - b[2]) ** 2)


@njit(cache=True, nogil=True)
def _side(mesh, h):
    """The longer of the other two edges of the triangle of h."""
    return max(_length(mesh, after(h)), _length(mesh, before(h)))
