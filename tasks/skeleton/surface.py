"""A closed surface round the canonical shape, whatever the shape came as."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from scipy.spatial import cKDTree

from tasks.errors import InputError
from tasks.geometry.measure import diagonal
from tasks.skeleton import orient, solid
from tasks.skeleton.manifold import components_of, is_closed
from tasks.skeleton.mend import mend
from tasks.skeleton.remesh import by_edges, isotropic
from tasks.values import Canonical, Surface

_KEPT = 0.98  # of triangles and points must be left on a mended mesh for it to stand in for the shape
_NEAR = 0.01  # of the bounding-box diagonal
_FLAT = 1e-4  # least over largest singular value of points that span a volume


def closed_surface(
    canonical: Canonical,
    *,
    vertices: Annotated[int, "[100, 1000000]"],
    cells: Annotated[int, "[16, 1024]"],
    neighbours: Annotated[int, "[4, 100]"],
    remesh: Literal["edges", "isotropic"],
) -> Surface:
    """One closed component round the canonical shape, with about `vertices` vertices.

    A closed mesh of one component between half and twice that size is used as it is; another size is refined or
    decimated edge by edge, or remeshed isotropically. Holes are capped and a few bad triangles dropped. What is still
    not one closed component (separate parts, soups, bare points) is rebuilt: the border of the solid that the
    generalised winding number tells from its surroundings (Jacobson et al. 2013; Barill et al. 2018), on a grid of
    `cells` along the longest side. Bare points get their normals from `neighbours` nearest points.

    Raises InputError when the points enclose no volume.
    """
    _check(canonical)
    points = canonical.points.astype(np.float64)
    position, faces = _one_component(points, canonical.faces, cells, neighbours)
    if not vertices / 2 <= len(position) <= vertices * 2:
        to_count = isotropic if remesh == "isotropic" else by_edges
        position, faces = to_count(position, faces, vertices)
    if _volume(position, faces) < 0:
        faces = faces[:, ::-1]
    if not is_closed(faces, len(position)):
        raise InputError(
            "Canonical.points",
            expected="a shape that a closed surface can be put round",
            found="an open one",
            do="try another skeleton.surface.cells",
        )
    of_point = cKDTree(position).query(points)[1]
    return Surface(position.astype(np.float32), faces.astype(np.int32), of_point.astype(np.int32))


def _one_component(
    points: np.ndarray, faces: np.ndarray | None, cells: int, neighbours: int
) -> tuple[np.ndarray, np.ndarray]:
    if faces is None:
        return solid.border(*orient.tangent_cells(points, neighbours), points, cells)
    faces = faces.astype(np.int64)
    if is_closed(faces, len(points)) and components_of(faces, len(points))[0] == 1:
        return points, faces
    position, mended = mend(points, faces)
    if len(mended) < _KEPT * len(faces):  # a soup rather than a damaged mesh
        return solid.border(points, faces, points, cells)
    _, part = components_of(mended, len(position))
    used, largest = np.unique(mended[part == np.argmax(np.bincount(part))], return_inverse=True)
    distance = cKDTree(position[used]).query(points)[0]
    if np.mean(distance < _NEAR * diagonal(points)) >= _KEPT:
        return position[used], largest.reshape(-1, 3)
    return solid.border(position, mended, points, cells)


def _volume(vertices: np.ndarray, faces: np.ndarray) -> float:
    a, b, c = (vertices[faces[:, k]] - vertices[0] for k in range(3))
    return float(np.einsum("ij,ij->", a, np.cross(b, c))) / 6.0


def _check(canonical: Canonical) -> None:
    spread = canonical.points - canonical.points.mean(axis=0)
    extent = np.linalg.svd(spread.astype(np.float64), compute_uv=False)
    if len(spread) < 4 or not extent[2] > _FLAT * extent[0]:
        raise InputError(
            "Canonical.points", expected="points that span a volume", found=f"{len(spread)} points in a plane or a line"
        )
