"""How well Gaussians keep to the surface that they stand for: what PSNR does not show."""

from __future__ import annotations

import numpy as np

from tasks.evaluation.metrics import declared
from tasks.geometry.measure import diagonal
from tasks.values import Metrics, Motion, Reconstruction

OPAQUE = 0.5  # opacity from which a Gaussian is seen and counts


def evaluate_paths(reconstruction: Reconstruction, truth: Motion) -> Metrics:
    """``path_pct``: mean distance between a Gaussian's path and that of the true surface point nearest to it at the
    reference time, in % of the diagonal of the true surface at that time; ``path_start_pct``: the same at the
    reference time alone, which is how far Gaussians lie off the surface.

    truth: the true surface, triangles, in the frames of the reconstruction; a point on it is held by its barycentric
    coordinates. The reference time is the frame whose points are nearest to the Gaussians at rest. Only Gaussians with
    an opacity of 0.5 or more count (the most opaque ones where there are none).
    Raises ValueError where the truth has other frames or no triangles.
    """
    import igl

    if truth.faces is None or len(truth.points) != len(reconstruction.points):
        raise ValueError(f"paths of {len(reconstruction.points)} frames need as many of a surface of triangles")
    opacities = reconstruction.gaussians.opacities
    seen = opacities >= min(OPAQUE, float(opacities.max()))
    points, rest = reconstruction.points[:, seen], reconstruction.gaussians.means[seen]
    frame = int(np.argmin([((p.astype(np.float64) - rest) ** 2).sum() for p in points]))
    surface, faces = truth.points[frame].astype(np.float64), truth.faces.astype(np.int64)
    _, of_face, nearest = igl.point_mesh_squared_distance(points[frame].astype(np.float64), surface, faces)
    corners = faces[of_face]
    share = _barycentric(nearest, *(surface[corners[:, k]] for k in range(3)))
    pairs = zip(points, truth.points, strict=True)
    far = np.array([np.linalg.norm(p - _at(t, corners, share), axis=1).mean() for p, t in pairs])
    percent = 100.0 / diagonal(truth.points[frame])
    return declared({"path_pct": far.mean() * percent, "path_start_pct": far[frame] * percent}, truth.unit)


def _at(surface: np.ndarray, corners: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Points held by corners (P, 3) and shares (P, 3) on a surface (V, 3) -> (P, 3)."""
    return np.einsum("pk,pkd->pd", share, surface[corners].astype(np.float64))


def _barycentric(points: np.ndarray, a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Shares of three corners in points of their triangles. (P, 3) each -> (P, 3), rows sum to one; a triangle without
    area gives all to its first corner."""
    u, v, w = b - a, c - a, points - a
    uu, uv, vv, wu, wv = ((x * y).sum(1) for x, y in ((u, u), (u, v), (v, v), (w, u), (w, v)))
    area = uu * vv - uv**2
    safe = np.where(area > 0, area, 1.0)
    second, third = (vv * wu - uv * wv) / safe, (uu * wv - uv * wu) / safe
    share = np.clip(np.stack([1 - second - third, second, third], axis=1), 0.0, 1.0)
    share[area <= 0] = [1.0, 0.0, 0.0]
    return share / share.sum(1, keepdims=True)
