"""Skin weights of a body given to what it wears."""

from __future__ import annotations

import numpy as np
from scipy.sparse import diags
from scipy.sparse.linalg import splu
from scipy.spatial import cKDTree

NEAR = 0.05  # of the bounding box's diagonal: farther points are inpainted
ALIKE = 30.0  # degrees between normals: where they differ by more the closest point is not to be trusted


def nearest_weights(body: np.ndarray, weights: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Each point takes the weights of the nearest vertex. body: (V, 3); weights: (V, J); points: (N, 3) -> (N, J)."""
    _, nearest = cKDTree(body).query(points)
    return weights[nearest]


def robust_weights(
    body: np.ndarray, body_faces: np.ndarray, weights: np.ndarray, points: np.ndarray, faces: np.ndarray
) -> np.ndarray:
    """Robust skin weights transfer by inpainting (Abdrashitov et al. 2023).

    A point takes the weights at the closest point of the body where that is near (5 % of the diagonal) and faces the
    same way (30 degrees, either side of the cloth); the others are filled in smoothly, min w^T (-L + L M^-1 L) w with
    the cotangent Laplacian L and mass M. body: (V, 3); body_faces: (T, 3); weights: (V, J); points: (N, 3);
    faces: (S, 3) -> (N, J), rows sum to one, none negative. Without a single point to trust it is nearest_weights.
    """
    import igl

    body, points = body.astype(np.float64), points.astype(np.float64)
    body_faces, faces = body_faces.astype(np.int64), faces.astype(np.int64)
    squared, face, closest = igl.point_mesh_squared_distance(points, body, body_faces)[:3]
    corners = body_faces[face]
    share = igl.barycentric_coordinates(closest, *(np.ascontiguousarray(body[corners[:, k]]) for k in range(3)))
    share = np.clip(share, 0, 1)
    taken = (weights[corners] * (share / share.sum(1, keepdims=True))[..., None]).sum(1)
    normals = (_normals(body, body_faces)[corners] * share[..., None]).sum(1)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    cosine = np.abs((normals * _normals(points, faces)).sum(1))  # either side of the cloth
    near = np.sqrt(squared) <= NEAR * np.linalg.norm(np.ptp(body, axis=0))
    known = near & (cosine >= np.cos(np.radians(ALIKE)))
    if not known.any():
        return nearest_weights(body, weights, points)
    out = _inpaint(points, faces, taken, known)
    out = np.clip(out, 0, None)
    return out / np.maximum(out.sum(1, keepdims=True), 1e-12)


def _inpaint(points: np.ndarray, faces: np.ndarray, values: np.ndarray, known: np.ndarray) -> np.ndarray:
    import igl

    laplacian = igl.cotmatrix(points, faces)
    mass = np.maximum(igl.massmatrix(points, faces, igl.MASSMATRIX_TYPE_VORONOI).diagonal(), 1e-12)
    energy = (-laplacian + laplacian @ diags(1 / mass) @ laplacian).tocsr()
    free = np.flatnonzero(~known)
    out = values.astype(np.float64).copy()
    if len(free):
        system = energy[free][:, free].tocsc() + 1e-12 * diags(np.ones(len(free)))
        out[free] = splu(system.tocsc()).solve(-(energy[free][:, np.flatnonzero(known)] @ out[known]))
    return out


def _normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    area = np.cross(b - a, c - a)
    total = np.zeros_like(vertices)
    for k in range(3):
        np.add.at(total, faces[:, k], area)
    return total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-30)
