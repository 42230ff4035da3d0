"""Numbers that say whether simulated cloth is usable: depth inside the body, stretch, speed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tasks.garments.simulate import body_points, collision_faces
from tasks.geometry.neighbours import mesh_edges
from tasks.values import Motion, Poses


@dataclass(frozen=True)
class Quality:
    """Of one clip. depth: (some F, N) metres inside the body, negative outside; strain: (F, E) change of edges over
    those at rest; speed: (F - 1, N) metres a second."""

    depth: np.ndarray
    strain: np.ndarray
    speed: np.ndarray

    def numbers(self) -> dict[str, float]:
        """deep: share of vertices more than 2 mm inside; depth_995: mm that 99.5 % stay below; stretch and squeeze of
        edges at 99 %; the greatest speed."""
        return {
            "deep_share": float((self.depth > 0.002).mean()),
            "depth_995_mm": float(1000 * np.percentile(self.depth, 99.5)),
            "strain_abs_p99": float(np.percentile(np.abs(self.strain), 99)),
            "stretch_p99": float(np.percentile(self.strain, 99)),
            "squeeze_p99": float(-np.percentile(self.strain, 1)),
            "speed_max": float(self.speed.max()) if self.speed.size else 0.0,
        }


def quality(
    body: Motion, poses: Poses, points: np.ndarray, rest: np.ndarray, faces: np.ndarray, *, fps: float, every: int
) -> Quality:
    """points: (F, N, 3) the cloth at the poses' frames; rest: (N, 3) its stress-free shape; every: depth, which takes a
    tenth of a second a frame, is measured at each `every`-th frame only."""
    some = slice(None, None, every)
    at = Poses(poses.rotations[some], poses.translations[some], poses.clip_start)
    hard = collision_faces(body)
    depth = [depth_in(skin, hard, cloth) for skin, cloth in zip(body_points(body, at), points[some], strict=True)]
    return Quality(
        depth=np.stack(depth),
        strain=strain(points, rest, faces),
        speed=np.linalg.norm(np.diff(points, axis=0), axis=2) * fps,
    )


def strain(points: np.ndarray, rest: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Relative change of every edge's length. (F, N, 3) -> (F, E)"""
    a, b = mesh_edges(faces).T
    length = np.linalg.norm(rest[a].astype(np.float64) - rest[b], axis=1)
    return np.linalg.norm(points[:, a].astype(np.float64) - points[:, b], axis=2) / length - 1


def depth_in(vertices: np.ndarray, faces: np.ndarray, points: np.ndarray) -> np.ndarray:
    """How deep points lie inside a mesh: distance to the surface where the winding number says inside, minus the
    distance elsewhere. (N,)"""
    import igl

    vertices, points, faces = vertices.astype(np.float64), points.astype(np.float64), faces.astype(np.int64)
    squared, *_ = igl.point_mesh_squared_distance(points, vertices, faces)
    inside = igl.fast_winding_number(vertices, faces, points) > 0.5
    return np.where(inside, 1.0, -1.0) * np.sqrt(squared)
