"""A body from a signed distance field: rounded cones along the bones, joined smoothly, made a mesh by marching cubes.

Every part belongs to a joint, so the true skin weights come out of the same description as the surface.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sparse
import scipy.sparse.linalg as linalg

from tasks.errors import InputError
from tasks.geometry import neighbours

Vec = tuple[float, float, float]


@dataclass(frozen=True)
class Cone:
    """A rounded cone from a (radius ra) to b (radius rb), moved by a joint.

    squash: factors on x, y, z that flatten it; blend: width in metres of the smooth union with what came before.
    """

    joint: str
    a: Vec
    b: Vec
    ra: float
    rb: float
    blend: float = 0.03
    squash: Vec = (1.0, 1.0, 1.0)

    @property
    def softening(self) -> float:
        """Length in metres over which its hold on the skin fades."""
        return 0.22 * min(self.ra, self.rb)

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Signed distance (a lower bound where squashed or steep). points: (N, 3) -> (N,)."""
        squash = np.asarray(self.squash)
        q = (points - self.a) / squash
        axis = (np.asarray(self.b) - self.a) / squash
        t = np.clip(q @ axis / max(axis @ axis, 1e-12), 0.0, 1.0)
        return (np.linalg.norm(q - t[:, None] * axis, axis=1) - (self.ra + t * (self.rb - self.ra))) * squash.min()

    def bounds(self) -> np.ndarray:
        """(2, 3) corners of a box around it."""
        reach = np.maximum(self.ra, self.rb) * np.asarray(self.squash)
        ends = np.array([self.a, self.b])
        return np.stack([ends.min(0) - reach, ends.max(0) + reach])


@dataclass(frozen=True)
class Bell:
    """A thick shell of revolution about the vertical axis: a skirt.

    profile: (radius, height) knots from waist to hem; half: half its thickness; depth: factor on z.
    """

    joint: str
    profile: tuple[tuple[float, float], ...]
    half: float
    depth: float
    blend: float = 0.03

    @property
    def softening(self) -> float:
        """Length in metres over which its hold on the skin fades."""
        return self.half

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Signed distance to the shell. points: (N, 3) -> (N,)."""
        radius = np.hypot(points[:, 0], points[:, 2] / self.depth)
        q = np.stack([radius, points[:, 1]], axis=1)
        knots = np.asarray(self.profile)
        best = np.full(len(q), np.inf)
        for a, b in itertools.pairwise(knots):
            t = np.clip((q - a) @ (b - a) / ((b - a) @ (b - a)), 0.0, 1.0)
            best = np.minimum(best, np.linalg.norm(q - a - t[:, None] * (b - a), axis=1))
        return (best - self.half) * self.depth

    def along(self, points: np.ndarray) -> np.ndarray:
        """How far down the skirt: 0 at the waist, 1 at the hem. points: (N, 3) -> (N,)."""
        top, hem = self.profile[0][1], self.profile[-1][1]
        return np.clip((top - points[:, 1]) / (top - hem), 0.0, 1.0)

    def bounds(self) -> np.ndarray:
        """(2, 3) corners of a box around it."""
        knots = np.asarray(self.profile)
        r = knots[:, 0].max() + self.half
        low, high = knots[:, 1].min() - self.half, knots[:, 1].max() + self.half
        return np.array([[-r, low, -r], [r, high, r]])


def field(parts: list[Cone | Bell], points: np.ndarray) -> np.ndarray:
    """Smooth union of the parts in their order (polynomial minimum, Quilez 2013). points: (N, 3) -> (N,)."""
    total = parts[0].distance(points)
    for part in parts[1:]:
        d = part.distance(points)
        overlap = np.maximum(part.blend - np.abs(total - d), 0.0) / part.blend
        total = np.minimum(total, d) - 0.25 * part.blend * overlap**2
    return total


def build_surface(parts: list[Cone | Bell], count: int) -> tuple[np.ndarray, np.ndarray]:
    """Closed surface of the parts: vertices (N, 3) float64, faces (T, 3) int32, one component without handles.

    count: how many vertices to aim for; too few tear thin parts and raise InputError.
    """
    # a surface has about as many vertices as its area has cells, so a coarse one tells how fine the grid must be
    coarse = 0.03
    cell = coarse * np.sqrt(len(marched(parts, coarse)[0]) / count)
    vertices, faces = marched(parts, cell)
    edges = neighbours.mesh_edges(faces)
    euler = len(vertices) - len(edges) + len(faces)
    if euler != 2:
        found = f"a surface of Euler number {euler} with {len(vertices)} vertices"
        raise InputError("dataset.vertices", expected="enough for a body without holes", found=found, do="ask for more")
    vertices = relax(parts, vertices, edges)
    return vertices, outward(vertices, faces)


def marched(parts: list[Cone | Bell], cell: float) -> tuple[np.ndarray, np.ndarray]:
    """Marching cubes of the parts on a grid of ``cell`` metres: vertices (N, 3), faces (T, 3) int32.

    Only the largest piece: between skirt and hip the grid can leave a bubble of a few cells.
    """
    import igl

    boxes = np.stack([p.bounds() for p in parts])
    low, high = boxes[:, 0].min(0) - 2 * cell, boxes[:, 1].max(0) + 2 * cell
    nx, ny, nz = (np.ceil((high - low) / cell).astype(int) + 1).tolist()
    z, y, x = np.meshgrid(np.arange(nz), np.arange(ny), np.arange(nx), indexing="ij")
    # libigl wants x to run fastest
    grid = low + cell * np.stack([x.ravel(), y.ravel(), z.ravel()], axis=1)
    value = field(parts, grid)
    # values too near zero put vertices on top of each other; relaxing brings them back to the true surface
    value = np.where(value < 0, np.minimum(value, -0.15 * cell), np.maximum(value, 0.15 * cell))
    vertices, faces, _ = igl.marching_cubes(value, grid, nx, ny, nz, 0.0)
    piece = neighbours.components(neighbours.mesh_edges(faces), len(vertices))[1]
    kept = piece == np.bincount(piece).argmax()
    number = np.cumsum(kept) - 1
    return vertices[kept], number[faces[kept[faces[:, 0]]]].astype(np.int32)


def relax(parts: list[Cone | Bell], vertices: np.ndarray, edges: np.ndarray, rounds: int = 12) -> np.ndarray:
    """Evens out marching-cubes slivers: every vertex to the mean of its neighbours, then back onto the field's zero."""
    matrix = neighbours.adjacency(edges, len(vertices)).astype(np.float64)
    mean = sparse.diags(1.0 / np.asarray(matrix.sum(1)).ravel()) @ matrix
    for _ in range(rounds):
        vertices = onto_zero(parts, 0.4 * vertices + 0.6 * (mean @ vertices))
    return vertices


def onto_zero(parts: list[Cone | Bell], points: np.ndarray) -> np.ndarray:
    """One Newton step along the field's gradient towards its zero set. points: (N, 3) -> (N, 3)."""
    h = 1e-4
    value = field(parts, points)
    slope = np.stack([(field(parts, points + h * e) - value) / h for e in np.eye(3)], axis=1)
    return points - slope * (value / np.maximum((slope**2).sum(1), 0.05))[:, None]


def outward(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Faces turned so that their normals point out of the body."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    volume = np.einsum("ni,ni->", a, np.cross(b, c))
    return faces if volume > 0 else np.ascontiguousarray(faces[:, ::-1])


def part_distances(parts: list[Cone | Bell], vertices: np.ndarray) -> np.ndarray:
    """(P, N) distance of every vertex to every part by itself."""
    return np.stack([p.distance(vertices) for p in parts])


def hold_of_joints(
    parts: list[Cone | Bell], vertices: np.ndarray, names: tuple[str, ...], parents: np.ndarray
) -> np.ndarray:
    """Skin weights by nearness to the joints' parts, (N, J), rows sum to one.

    A vertex follows the joint of its nearest part and that joint's neighbours in the tree, nothing else: a paw beside
    the belly does not pull on it.
    """
    scaled = np.full((len(names), len(vertices)), np.inf)
    nearest = np.full((len(names), len(vertices)), np.inf)
    for part, d in zip(parts, part_distances(parts, vertices), strict=True):
        j = names.index(part.joint)
        scaled[j] = np.minimum(scaled[j], np.maximum(d, 0.0) / part.softening)
        nearest[j] = np.minimum(nearest[j], d)
    linked = np.eye(len(names), dtype=bool)
    for j, p in enumerate(parents):
        if p >= 0:
            linked[j, p] = linked[p, j] = True
    weights = np.where(linked[np.argmin(nearest, axis=0)].T, np.exp(-scaled), 0.0)
    return (weights / weights.sum(0)).T


def smooth_weights(vertices: np.ndarray, faces: np.ndarray, weights: np.ndarray, width: float) -> np.ndarray:
    """Weights after diffusion over the surface by about ``width`` metres, at most four a vertex, rows sum to one.

    One implicit Euler step of the heat equation, (M + width^2 L) w = M w0, with libigl's cotangent Laplacian.
    """
    import igl

    laplacian = -igl.cotmatrix(vertices, faces.astype(np.int64))
    mass = igl.massmatrix(vertices, faces.astype(np.int64), igl.MASSMATRIX_TYPE_VORONOI)
    solve = linalg.splu((mass + width**2 * laplacian).tocsc())
    spread = np.clip(solve.solve(np.asarray(mass @ weights)), 0.0, None)
    kth = np.partition(spread, -4, axis=1)[:, -4:-3] if spread.shape[1] > 4 else 0.0
    spread = np.where((spread >= kth) & (spread > 1e-3), spread, 0.0)
    return spread / spread.sum(1, keepdims=True)
