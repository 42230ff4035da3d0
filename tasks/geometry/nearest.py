"""The point of a moving surface that a free point belongs to."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Anchors:
    """Points on the triangles of a mesh. corners: (N, 3) int32 vertices; shares: (N, 3) barycentric coordinates."""

    corners: np.ndarray
    shares: np.ndarray

    def follow(self, points: np.ndarray) -> np.ndarray:
        """Where they are in every frame. points: (F, V, 3) -> (F, N, 3) float32."""
        shares = self.shares[..., None].astype(np.float32)
        return sum(points[:, self.corners[:, c]] * shares[:, c] for c in range(3))


def anchor(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> Anchors:
    """The surface points nearest to points (N, 3) on the mesh vertices (V, 3), faces (T, 3)."""
    import igl

    vertices, faces = vertices.astype(np.float64), faces.astype(np.int64)
    _, triangle, on_surface = igl.point_mesh_squared_distance(points.astype(np.float64), vertices, faces)
    corners = faces[np.ravel(triangle)]
    a, b, c = (np.ascontiguousarray(vertices[corners[:, i]]) for i in range(3))
    shares = igl.barycentric_coordinates(np.ascontiguousarray(on_surface), a, b, c)
    return Anchors(corners.astype(np.int32), np.nan_to_num(shares, nan=1.0 / 3.0))
