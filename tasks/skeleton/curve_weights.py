"""Weights carried from the points to the surface and over the correspondence onto the curve."""

from __future__ import annotations

from dataclasses import dataclass

import igl
import numpy as np
from scipy.spatial import cKDTree

from tasks.geometry.neighbours import adjacency
from tasks.values import Canonical, Curve, Surface

_NEAREST = 4


@dataclass(frozen=True)
class Interpolation:
    """How the surface's vertices hang on the canonical points. corner: (V, k) point numbers; share: (V, k), rows sum
    to one."""

    corner: np.ndarray
    share: np.ndarray

    def carry(self, values: np.ndarray) -> np.ndarray:
        """Values of the points (N, ...) onto the vertices (V, ...), float64."""
        return np.einsum("vk,vk...->v...", self.share, values[self.corner].astype(np.float64))


def onto_surface(canonical: Canonical, surface: Surface) -> Interpolation:
    """On a mesh the closest point of its triangles, on bare points the inverse-distance mean of the nearest."""
    vertices = surface.vertices.astype(np.float64)
    if canonical.faces is None:
        distance, near = cKDTree(canonical.points).query(vertices, k=[*range(1, _NEAREST + 1)])
        share = 1.0 / np.maximum(distance, 1e-9)
        return Interpolation(near, share / share.sum(axis=1, keepdims=True))
    points, faces = canonical.points.astype(np.float64), canonical.faces.astype(np.int64)
    _, triangle, closest = igl.point_mesh_squared_distance(vertices, points, faces)
    corner = faces[triangle]
    return Interpolation(corner, _barycentric(closest, points[corner]))


def thin(canonical: Canonical, surface: Surface, curve: Curve, most: int) -> np.ndarray:
    """Numbers of at most ``most`` canonical points, spread evenly along the curve; all where there are no more."""
    count = len(canonical.points)
    if count <= most:
        return np.arange(count)
    along = np.argsort(curve.of_vertex, kind="stable")
    chosen = along[np.unique(np.linspace(0, len(along) - 1, most).round().astype(np.int64))]
    return np.unique(cKDTree(canonical.points).query(surface.vertices[chosen])[1])


def sampled(canonical: Canonical, chosen: np.ndarray) -> Canonical:
    """The chosen points as bare points; the whole shape where all are chosen."""
    if len(chosen) == len(canonical.points):
        return canonical
    return Canonical(canonical.points[chosen], None, canonical.frame, canonical.source)


def node_weights(curve: Curve, on_surface: np.ndarray) -> np.ndarray:
    """Weights of the curve's nodes: the mean over the vertices that collapsed there (V, B) -> (M, B); nodes that
    none collapsed onto take the mean of their neighbours along the curve."""
    count = len(curve.nodes)
    hits = np.bincount(curve.of_vertex, minlength=count).astype(np.float64)
    total = np.zeros((count, on_surface.shape[1]))
    np.add.at(total, curve.of_vertex, on_surface)
    near = adjacency(curve.edges, count).astype(np.float64)
    known = hits > 0
    out = np.where(known[:, None], total / np.maximum(hits, 1.0)[:, None], 0.0)
    while not known.all():
        given = near @ known.astype(np.float64)
        fill = ~known & (given > 0)
        if not fill.any():
            out[~known] = out[known].mean(axis=0)
            break
        out[fill] = (near @ (out * known[:, None]))[fill] / given[fill, None]
        known = known | fill
    return out


def node_lengths(curve: Curve) -> np.ndarray:
    """(M,) length of curve that belongs to each node: half of every edge at it, and never nought (a ball's curve is one
    point)."""
    size = np.linalg.norm(curve.nodes[curve.edges[:, 0]].astype(np.float64) - curve.nodes[curve.edges[:, 1]], axis=1)
    half = np.bincount(curve.edges.ravel(), weights=np.repeat(size / 2.0, 2), minlength=len(curve.nodes))
    return np.maximum(half, 1e-12)


def vertex_areas(surface: Surface) -> np.ndarray:
    """(V,) area round every vertex: a third of its triangles'."""
    a, b, c = (surface.vertices[surface.faces[:, k]].astype(np.float64) for k in range(3))
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    return np.bincount(surface.faces.ravel(), weights=np.repeat(area / 3.0, 3), minlength=len(surface.vertices))


def _barycentric(point: np.ndarray, corner: np.ndarray) -> np.ndarray:
    """point: (V, 3) on triangles with corners (V, 3, 3) -> (V, 3); a triangle without area gives its first corner."""
    u, v, w = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0], point - corner[:, 0]
    uu, uv, vv = (u * u).sum(1), (u * v).sum(1), (v * v).sum(1)
    wu, wv = (w * u).sum(1), (w * v).sum(1)
    area = uu * vv - uv * uv
    safe = np.where(area > 0, area, 1.0)
    b = np.where(area > 0, (vv * wu - uv * wv) / safe, 0.0)
    c = np.where(area > 0, (uu * wv - uv * wu) / safe, 0.0)
    share = np.clip(np.stack([1.0 - b - c, b, c], axis=1), 0.0, 1.0)
    return share / share.sum(axis=1, keepdims=True)
