"""A renderer of moving meshes that shares nothing with the splatter: rays against triangles, by Embree.

It makes test scenes: what is fitted to its pictures was never drawn by the code that fits.
"""

from __future__ import annotations

import numpy as np

from tasks.captures.cameras import project
from tasks.geometry.measure import diagonal

TO_LIGHT = (np.array([0.4, 0.8, 0.45]) / np.linalg.norm([0.4, 0.8, 0.45])).astype(np.float32)
WAVES = 4  # plane waves an octave
OCTAVES = ((2.0, 0.55), (5.0, 0.3), (10.0, 0.15))  # waves along the diagonal of the shape, share of the contrast


class Caster:
    """One frame of a mesh, ready to be seen from any camera."""

    def __init__(self, points: np.ndarray, faces: np.ndarray, rest: np.ndarray) -> None:
        """points: (N, 3); faces: (T, 3); rest: (N, 3), the shape that the colours lie on."""
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        self.points = np.ascontiguousarray(points, np.float32)
        self.faces = np.ascontiguousarray(faces, np.int32)
        self.rest = np.asarray(rest, np.float32)
        self._frame = (self.rest.mean(0), diagonal(self.rest))
        self.normals = vertex_normals(self.points, self.faces)
        self._scene = EmbreeScene(robust=True)  # no rays lost between neighbouring triangles
        TriangleMesh(self._scene, self.points, self.faces)

    def coverage(self, view: np.ndarray, intrinsics: np.ndarray, size: int, samples: int) -> np.ndarray:
        """Share of each pixel that the mesh covers, (size, size) in 0..1."""
        box, hit, _ = self._cast(view, intrinsics, size, samples)
        return _scatter(box, _per_pixel(hit["primID"] >= 0, box, samples), size)

    def image(self, view: np.ndarray, intrinsics: np.ndarray, size: int, *, samples: int, shading: float) -> np.ndarray:
        """(size, size, 4) uint8: colour, not multiplied by alpha, and alpha.

        view: (4, 4); intrinsics: (3, 3); samples: rays along each side of a pixel; shading: share of the light that
        comes from one side, 0 for a surface that glows. Both sides of a triangle are seen.
        """
        box, hit, ray = self._cast(view, intrinsics, size, samples)
        on = np.flatnonzero(hit["primID"] >= 0)
        colour = np.zeros((len(hit["primID"]), 3), np.float32)
        colour[on] = self._shade({k: v[on] for k, v in hit.items()}, ray[on], shading)
        alpha = _per_pixel(hit["primID"] >= 0, box, samples)
        total = np.stack([_per_pixel(colour[:, c], box, samples) for c in range(3)], axis=-1)
        straight = total / np.maximum(alpha, 1e-9)[..., None]
        rgba = np.concatenate([straight, alpha[..., None]], axis=-1)
        return np.rint(255 * _scatter(box, rgba, size)).astype(np.uint8)

    def _cast(self, view, intrinsics, size, samples):
        """Rays through the pixels of the mesh's box in the image: (box, hits, directions)."""
        box = _box(project(self.points, view, intrinsics), size)
        x, y = ((np.arange(a * samples, b * samples) + 0.5) / samples for a, b in box)
        grid = np.stack([*np.meshgrid(x, y), np.ones((len(y), len(x)))], axis=-1).reshape(-1, 3)
        local = grid @ np.linalg.inv(intrinsics).T
        ray = np.ascontiguousarray(local @ view[:3, :3], np.float32)
        eye = -view[:3, :3].T @ view[:3, 3]
        start = np.tile(eye.astype(np.float32), (len(ray), 1))
        if not len(ray):
            return box, {"primID": np.full(0, -1, np.int32)}, ray
        return box, self._scene.run(start, ray, output=True), ray

    def _shade(self, hit: dict[str, np.ndarray], ray: np.ndarray, shading: float) -> np.ndarray:
        corner = self.faces[hit["primID"]]
        u, v = hit["u"][:, None], hit["v"][:, None]
        normal, place = (
            (1 - u - v) * a[corner[:, 0]] + u * a[corner[:, 1]] + v * a[corner[:, 2]] for a in (self.normals, self.rest)
        )
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
        normal *= np.where((hit["Ng"] * ray).sum(1) > 0, np.float32(-1), np.float32(1))[:, None]  # towards the eye
        light = 0.5 + 0.5 * (normal @ TO_LIGHT)
        return solid_colour(place, *self._frame) * (1 - shading + shading * light[:, None])


def vertex_normals(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Unit normals of vertices, of the faces round them by area. -> (N, 3) float32"""
    a, b, c = (points[faces[:, k]].astype(np.float64) for k in range(3))
    of_face = np.cross(b - a, c - a)
    total = np.stack(
        [sum(np.bincount(faces[:, k], of_face[:, d], len(points)) for k in range(3)) for d in range(3)], axis=1
    )
    return (total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-30)).astype(np.float32)


def solid_colour(places: np.ndarray, centre: np.ndarray, length: float) -> np.ndarray:
    """The colour of the space that the shape at rest lies in: a sum of plane waves, always the same.

    places: (P, 3) points of the shape at rest; centre: (3,); length: its diagonal -> (P, 3) in 0..1, float32.
    """
    direction, phase, tint = _waves()
    wave = np.sin((places - centre) @ (direction / np.float32(length)) + phase)
    return np.clip(0.5 + wave @ tint, 0.0, 1.0)


def _waves() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Wave vectors (3, W), phases (W,) and what each adds to red, green and blue (W, 3)."""
    random = np.random.default_rng(0)
    count = WAVES * len(OCTAVES)
    direction = random.normal(size=(3, count))
    direction *= 2 * np.pi * np.repeat([f for f, _ in OCTAVES], WAVES) / np.linalg.norm(direction, axis=0)
    tint = random.normal(size=(count, 3))
    tint *= np.repeat([s for _, s in OCTAVES], WAVES)[:, None] / np.linalg.norm(tint, axis=1, keepdims=True)
    phase = random.uniform(0, 2 * np.pi, count)
    return direction.astype(np.float32), phase.astype(np.float32), tint.astype(np.float32) * np.float32(0.55)


def _box(pixels: np.ndarray, size: int) -> tuple[tuple[int, int], tuple[int, int]]:
    """Columns and rows that hold all pixels, cut at the image."""
    low = np.clip(np.floor(pixels.min(0)), 0, size).astype(int)
    high = np.clip(np.ceil(pixels.max(0)), low, size).astype(int)
    return (low[0], high[0]), (low[1], high[1])


def _per_pixel(values: np.ndarray, box, samples: int) -> np.ndarray:
    """The mean over the rays of each pixel of the box."""
    (left, right), (top, bottom) = box
    return values.reshape(bottom - top, samples, right - left, samples).mean((1, 3), dtype=np.float32)


def _scatter(box, values: np.ndarray, size: int) -> np.ndarray:
    """The box in an image of zeros."""
    (left, right), (top, bottom) = box
    out = np.zeros((size, size, *values.shape[2:]), np.float32)
    out[top:bottom, left:right] = values
    return out
