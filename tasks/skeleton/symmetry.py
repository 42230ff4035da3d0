"""Left and right of a shape that is its own mirror image, as bodies at rest are."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree

from tasks.geometry.measure import diagonal
from tasks.skeleton.curve_weights import vertex_areas
from tasks.values import Surface

_ALIKE = 0.005  # of the diagonal: RMS distance of a mirrored shape from itself up to which it is symmetric
_PAIR = 0.05  # of the diagonal: how far a point's mirror image may lie from its partner


@dataclass(frozen=True)
class Mirror:
    """A plane of symmetry. centre: (3,) on it; normal: (3,) unit; size: the shape's diagonal."""

    centre: np.ndarray
    normal: np.ndarray
    size: float

    def image(self, points: np.ndarray) -> np.ndarray:
        """(..., 3) on the other side."""
        return points - 2.0 * ((points - self.centre) @ self.normal)[..., None] * self.normal

    def partners(self, points: np.ndarray) -> np.ndarray:
        """(K,) number of the point opposite each of points (K, 3), its own on the plane, -1 where none is near: one
        to one, of least summed distance."""
        apart = np.linalg.norm(self.image(points)[:, None] - points[None], axis=2)
        rows, columns = linear_sum_assignment(apart + apart.T)
        out = np.full(len(points), -1)
        near = (columns[columns] == rows) & (apart[rows, columns] < _PAIR * self.size)
        out[rows[near]] = columns[near]
        return out

    def even(self, points: np.ndarray) -> np.ndarray:
        """Every point (K, 3) halfway to where its partner's image is; those without a partner stay."""
        partners = self.partners(points)
        return np.where(partners[:, None] < 0, points, 0.5 * (points + self.image(points[partners])))


def find_mirror(surface: Surface) -> Mirror | None:
    """The plane through the centroid, across one of the surface's principal axes, that maps it best onto itself; None
    where none does to ``_ALIKE``."""
    vertices, areas = surface.vertices.astype(np.float64), vertex_areas(surface)
    centre = areas @ vertices / areas.sum()
    offset = vertices - centre
    axes = np.linalg.eigh((offset * areas[:, None]).T @ offset)[1].T
    size, tree = diagonal(vertices), cKDTree(vertices)
    mirrors = [Mirror(centre, axis, size) for axis in axes]
    errors = [np.sqrt(np.mean(tree.query(m.image(vertices))[0] ** 2)) for m in mirrors]
    best = int(np.argmin(errors))
    return mirrors[best] if errors[best] < _ALIKE * size else None
