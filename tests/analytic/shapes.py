"""Closed meshes whose curve skeleton is known."""

from __future__ import annotations

import igl
import numpy as np

from tasks.values import Surface


def surface(vertices: np.ndarray, faces: np.ndarray) -> Surface:
    """A Surface whose canonical points are its vertices."""
    count = np.arange(len(vertices), dtype=np.int32)
    return Surface(vertices.astype(np.float32), faces.astype(np.int32), count)


def capsules(
    segments: list[tuple[list[float], list[float]]], radius: float, cell: float
) -> tuple[np.ndarray, np.ndarray]:
    """Union of round-ended rods, by marching cubes. segments: pairs of end points."""
    ends = np.array(segments, float)
    low, high = ends.min((0, 1)) - radius - 2.01 * cell, ends.max((0, 1)) + radius + 2.01 * cell
    shape = np.ceil((high - low) / cell).astype(int)
    z, y, x = np.meshgrid(*(np.arange(n) for n in shape[::-1]), indexing="ij")
    corners = low + cell * np.stack([x.ravel(), y.ravel(), z.ravel()], axis=1)
    distance = np.min([_to_segment(corners, a, b) for a, b in ends], axis=0) - radius
    vertices, faces, _ = igl.marching_cubes(distance, corners, *map(int, shape), 0.0)
    return vertices, outward(vertices, faces)


def _to_segment(points: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    along = np.clip((points - a) @ (b - a) / ((b - a) @ (b - a)), 0.0, 1.0)
    return np.linalg.norm(points - a - along[:, None] * (b - a), axis=1)


def volume(vertices: np.ndarray, faces: np.ndarray) -> float:
    """Signed volume, positive when the triangles face outwards."""
    a, b, c = (np.asarray(vertices, float)[faces[:, k]] for k in range(3))
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0)


def outward(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """The triangles turned so that they face outwards."""
    return faces if volume(vertices, faces) > 0 else np.ascontiguousarray(faces[:, ::-1])


def sphere(rounds: int) -> tuple[np.ndarray, np.ndarray]:
    """Unit sphere: an icosahedron with its triangles quartered."""
    vertices, faces = igl.icosahedron()
    for _ in range(rounds):
        vertices, faces = igl.upsample(vertices, faces)
    vertices = vertices / np.linalg.norm(vertices, axis=1, keepdims=True)
    return vertices, outward(vertices, faces)


def torus(big: int, small: int) -> tuple[np.ndarray, np.ndarray]:
    """Radii 1 and 0.3."""
    u, v = np.meshgrid(np.arange(big), np.arange(small), indexing="ij")
    a, b = 2 * np.pi * u.ravel() / big, 2 * np.pi * v.ravel() / small
    ring = 1.0 + 0.3 * np.cos(b)
    vertices = np.stack([ring * np.cos(a), 0.3 * np.sin(b), ring * np.sin(a)], axis=1)
    here, right, up, both = (
        ((u + i) % big * small + (v + j) % small).ravel() for i, j in ((0, 0), (1, 0), (0, 1), (1, 1))
    )
    faces = np.concatenate([np.stack([here, right, both], 1), np.stack([here, both, up], 1)])
    return vertices, outward(vertices, faces)


def box(size: tuple[float, float, float] = (1.0, 1.0, 1.0), *, open_top: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """A box of twelve triangles, or of ten without its top."""
    corner = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (0, 2, 6, 4), (1, 5, 7, 3), (2, 3, 7, 6)]
    faces = np.array([t for a, b, c, d in quads[: 5 if open_top else 6] for t in ((a, b, c), (a, c, d))])
    return corner * size, faces


def degrees(nodes: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Number of edges at each node."""
    return np.bincount(edges.ravel(), minlength=len(nodes))
