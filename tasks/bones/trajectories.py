"""Point trajectories, freed of the global motion and compressed: what clustering and SSDR work on.

Every point's path over F frames is a vector of 3F numbers; paths of one body span far fewer dimensions. The stages
need only products of paths with bone motions, so a path is replaced by its P coefficients in an orthonormal basis.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numba import njit

from tasks.bones.products import orthonormalise, product
from tasks.geometry import rigid
from tasks.geometry.parallel import for_chunks

_BLOCK = 32  # vectors added to the basis at a time
_JUDGES = 500  # points from which the global motion is taken
_TILE = 16  # points whose coefficients are kept in the first-level cache


@dataclass(frozen=True)
class Alignment:
    """Coordinates in which the global motion is gone: x = R_f (scale h + centre + scale u) + t_f.

    motion: (F, 3, 4) float64, the rigid motion of the whole shape; centre: (3,); scale: RMS distance to the centre.
    """

    motion: np.ndarray
    centre: np.ndarray
    scale: float

    def homogeneous(self, canonical: np.ndarray) -> np.ndarray:
        """(N, 3) canonical points -> (N, 4) float64, centred, scaled, with a one."""
        centred = (np.asarray(canonical, np.float64) - self.centre) / self.scale
        return np.concatenate([centred, np.ones((len(centred), 1))], axis=1)

    def canonical(self, homogeneous: np.ndarray) -> np.ndarray:
        """The way back: (N, 4) -> (N, 3)."""
        return self.centre + self.scale * homogeneous[:, :3]

    def to_world(self, offsets: np.ndarray) -> np.ndarray:
        """(B, 4, 3, F) bone offsets, see :mod:`tasks.bones.transforms` -> (F, B, 3, 4) float64 on canonical points."""
        local = np.moveaxis(offsets, (3, 0, 2, 1), (0, 1, 2, 3)).copy()  # (F, B, 3, 4)
        local[..., :3] += np.eye(3)
        shift = self.scale * local[..., 3] + self.centre - local[..., :3] @ self.centre
        return rigid.compose(self.motion[:, None], rigid.make(local[..., :3], shift))


@dataclass(frozen=True)
class Trajectories:
    """Compressed displacements u of all points from the moving canonical shape.

    rest: (N, 4) float64 homogeneous points h; path: (N, P) float32 coefficients of u; basis: (3F, P) float64,
    orthonormal columns, row d F + f is coordinate d of frame f; energy: sum of |u|^2 before compression;
    alignment: the way back.
    """

    rest: np.ndarray
    path: np.ndarray
    basis: np.ndarray
    energy: float
    alignment: Alignment

    @property
    def frames(self) -> int:
        """Number of frames F."""
        return len(self.basis) // 3

    @cached_property
    def lengths(self) -> np.ndarray:
        """|u|^2 of each point that is left after compression, (N,)."""
        each = for_chunks(
            lambda a, b: np.sum(np.square(self.path[a:b], dtype=np.float64), axis=1), len(self.path), 4096
        )
        return np.concatenate([np.zeros(0), *each])

    @cached_property
    def squared(self) -> float:
        """Sum of |u|^2 that is left after compression."""
        return float(np.sum(self.lengths))

    def rmse(self, objective: float) -> float:
        """Sum of squared differences among coefficients -> vertex RMSE in the unit of the data.

        What compression dropped is added as if no bone could explain any of it.
        """
        total = max(objective, 0.0) + max(self.energy - self.squared, 0.0)
        return self.alignment.scale * float(np.sqrt(total / (self.frames * len(self.rest))))

    def take(self, chosen: np.ndarray) -> Trajectories:
        """Some of the points, with their share of what compression dropped."""
        dropped = max(self.energy - self.squared, 0.0) * len(chosen) / len(self.rest)
        part = replace(self, rest=self.rest[chosen], path=self.path[chosen])
        return replace(part, energy=part.squared + dropped)


def align(points: np.ndarray, canonical: np.ndarray, sample: np.ndarray) -> Alignment:
    """Frees the motion of its rigid part. points: (F, N, 3); canonical: (N, 3); sample: indices of points to judge by.

    The centre is a median and the scale is capped by one, so that a few stray points cannot shrink the shape to a dot.
    """
    judges = sample[:: math.ceil(len(sample) / _JUDGES)]
    chosen = np.asarray(canonical[judges], np.float64)
    motion = rigid.procrustes(chosen, points[:, judges])
    centre = np.median(chosen, axis=0)
    distance = np.linalg.norm(chosen - centre, axis=1)
    scale = min(float(np.sqrt(np.mean(distance**2))), 3.0 * float(np.median(distance)))
    return Alignment(motion, centre, scale if scale > 0 else 1.0)


def compress(points: np.ndarray, canonical: np.ndarray, *, tolerance: float, sample: np.ndarray) -> Trajectories:
    """Aligned trajectories in a basis that loses at most `tolerance` (vertex RMSE, unit of the data) on the sample.

    points: (F, N, 3); canonical: (N, 3); sample: (S,) indices. Cost: linear in N and in F.
    """
    frame = align(points, canonical, sample)
    rest = frame.homogeneous(canonical)
    paths = aligned_paths(points[:, sample], rest[sample, :3], frame)
    basis = _basis(paths, (tolerance / frame.scale) ** 2 * len(points) * len(sample))
    return project(points, rest, basis, frame)


def aligned_paths(points: np.ndarray, rest: np.ndarray, frame: Alignment) -> np.ndarray:
    """(F, S, 3) points and their (S, 3) rest -> (S, 3F) float64 displacements u, coordinate by coordinate."""
    still = rigid.apply(rigid.inverse(frame.motion)[:, None], points.astype(np.float64))
    offset = (still - frame.centre) / frame.scale - rest
    return np.ascontiguousarray(offset.transpose(1, 2, 0).reshape(len(rest), -1))


def project(points: np.ndarray, rest: np.ndarray, basis: np.ndarray, frame: Alignment) -> Trajectories:
    """Coefficients of all points in a given basis. points: (F, N, 3); rest: (N, 4); basis: (3F, P)."""
    path = np.empty((len(rest), basis.shape[1]), np.float32)
    back = rigid.inverse(frame.motion)
    back[..., 3] -= frame.centre
    back /= frame.scale
    by_frame = np.ascontiguousarray(basis.reshape(3, len(points), -1).transpose(1, 0, 2))
    points = np.ascontiguousarray(points, np.float32)

    def work(start: int, stop: int) -> float:
        return _project(points, rest, back, by_frame, path, start, stop)

    energy = sum(for_chunks(work, len(rest), 1024))
    return Trajectories(rest, path, basis, energy, frame)


@njit(cache=True, nogil=True)
def _project(points, rest, back, basis, path, start, stop):
    width = basis.shape[2]
    sums = np.zeros((_TILE, width))
    energy = 0.0
    for low in range(start, stop, _TILE):
        high = min(low + _TILE, stop)
        sums[:] = 0.0
        for f in range(len(points)):
            a = back[f]
            b0, b1, b2 = basis[f, 0], basis[f, 1], basis[f, 2]
            for n in range(low, high):
                x, y, z = np.float64(points[f, n, 0]), np.float64(points[f, n, 1]), np.float64(points[f, n, 2])
                u0 = a[0, 0] * x + a[0, 1] * y + a[0, 2] * z + a[0, 3] - rest[n, 0]
                u1 = a[1, 0] * x + a[1, 1] * y + a[1, 2] * z + a[1, 3] - rest[n, 1]
                u2 = a[2, 0] * x + a[2, 1] * y + a[2, 2] * z + a[2, 3] - rest[n, 2]
                energy += u0 * u0 + u1 * u1 + u2 * u2
                row = sums[n - low]
                for j in range(width):
                    row[j] += u0 * b0[j] + u1 * b1[j] + u2 * b2[j]
        for n in range(low, high):
            for j in range(width):
                path[n, j] = sums[n - low, j]
    return energy


def _basis(paths: np.ndarray, allowed: float) -> np.ndarray:
    """Orthonormal columns that leave at most `allowed` of the squared length of paths (S, 3F) unexplained.

    The first three are shifts that last: with them a rest point can be moved (:mod:`tasks.bones.rest`).

    Randomised block range finder with one power iteration (Martinsson & Voronin 2016, randQB_EI), grown block by block
    so that the rank need not be known. Short sequences keep all their dimensions: there is nothing to win.
    """
    count, width = paths.shape
    if width <= 3 * _BLOCK:
        return np.eye(width)
    rng = np.random.default_rng(0)  # probes of a subspace, not a setting: the result is the same for any good seed
    basis = np.zeros((min(count + 3, width), width))
    basis[:3] = np.repeat(np.eye(3), width // 3, axis=1) / math.sqrt(width // 3)
    left = paths - product(product(paths, basis[:3].T), basis[:3])
    found = 3
    while found < len(basis) and np.sum(left**2) > allowed:
        size = min(_BLOCK, len(basis) - found)
        block = product(rng.standard_normal((size, count)), left)
        orthonormalise(block, basis, found)
        block = product(product(block, left.T), left)
        orthonormalise(block, basis, found)
        left -= product(product(left, block.T), block)
        basis[found : found + size] = block
        found += size
    kept = basis[:found][np.sum(basis[:found] ** 2, axis=1) > 0.5]
    return np.ascontiguousarray(kept.T) if len(kept) else np.eye(width)[:, :1]
