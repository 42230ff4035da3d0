"""A closed surface round the canonical shape, whatever the shape came as."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from tasks.errors import InputError
from tasks.skeleton import orient, remesh, solid
from tasks.skeleton.manifold import components_of, is_closed
from tasks.values import Canonical, Surface


def closed_surface(canonical: Canonical, *, vertices: int, cells: int, neighbours: int) -> Surface:
    """One closed component round the canonical shape, with about `vertices` vertices.

    A mesh that is closed, one component and already between half and twice that size is used as it is; another size
    is remeshed. Everything else (open, several components, bad triangles, bare points) is rebuilt: the border of the
    solid that the generalised winding number tells from its surroundings (Jacobson et al. 2013), on a grid with
    `cells` cells along the longest side. Bare points get normals from their `neighbours` nearest points.

    Raises InputError when the points span no volume or a setting is out of range.
    """
    _check_settings(vertices, cells, neighbours)
    points = canonical.points.astype(np.float64)
    position, faces = _mesh(canonical, points, cells, neighbours)
    if not vertices / 2 <= len(position) <= vertices * 2:
        position, faces = remesh.to_count(position, faces, vertices)
    of_point = cKDTree(position).query(points)[1]
    return Surface(position.astype(np.float32), faces.astype(np.int32), of_point.astype(np.int32))


def _mesh(canonical: Canonical, points: np.ndarray, cells: int, neighbours: int) -> tuple[np.ndarray, np.ndarray]:
    if np.linalg.matrix_rank(points - points.mean(0), tol=1e-4 * np.abs(points - points.mean(0)).max()) < 3:
        raise InputError("Canonical.points", expected="points that span a volume", found="points in a plane or line")
    if canonical.faces is None:
        soup, faces = orient.discs(points, neighbours)
        return solid.border(soup, faces, points, cells)
    faces = canonical.faces.astype(np.int64)
    if is_closed(faces, len(points)) and components_of(faces, len(points))[0] == 1:
        return (points, faces) if _volume(points, faces) > 0 else (points, faces[:, ::-1])
    return solid.border(points, faces, points, cells)


def _volume(vertices: np.ndarray, faces: np.ndarray) -> float:
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return float(np.einsum("ij,ij->", a, np.cross(b, c))) / 6.0


def _check_settings(vertices: int, cells: int, neighbours: int) -> None:
    for name, value, low, high in (
        ("vertices", vertices, 100, 1_000_000),
        ("cells", cells, 16, 1024),
        ("neighbours", neighbours, 4, 100),
    ):
        if not low <= value <= high:
            raise InputError(f"skeleton.surface.{name}", expected=f"{low} to {high}", found=str(value))
