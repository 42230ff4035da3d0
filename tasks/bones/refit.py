"""Bone transforms of given weights on any frames, from the raw points."""

from __future__ import annotations

import numpy as np
from numba import njit

from tasks.bones import transforms
from tasks.bones.trajectories import Alignment, align
from tasks.geometry import rigid
from tasks.geometry.parallel import for_chunks
from tasks.geometry.skinning import skin
from tasks.values import Animation, Motion, Skinning

_FRAMES = 8  # frames a thread takes at a time
_SAMPLE = 1000  # points from which the global motion is taken
_SWEEPS = 5  # sweeps between two looks at the error
_LOOKS = 40
_ENOUGH = 1e-5  # relative fall of the squared error between looks at which the fit stops


def refit_bones(motion: Motion, skinning: Skinning) -> np.ndarray:
    """Transforms (F, B, 3, 4) that bring the skinned rest shape closest to the motion's points, weights frozen.

    For frames that the weights were not made from (held-out error), and for the floor of what bones can express.
    """
    count = skinning.weights.shape[1]
    index, value = _sparse(skinning.weights)
    frame = _alignment(motion.points, skinning.rest)
    k, y, energy = _raw_sums(motion.points, skinning.rest, frame, index, value, count)
    offsets = _start(motion.points, skinning.rest, frame, index, value, count)
    last = np.inf
    for _ in range(_LOOKS):
        error = energy + transforms.sweep(k, y, offsets, _SWEEPS)
        if error >= (1.0 - _ENOUGH) * last:
            break
        last = error
    return frame.to_world(offsets).astype(np.float32)


def compression_floor(unseen: Motion, skinning: Skinning) -> Animation:
    """The unseen frames as the bones can show them at best: fitted to the truth itself, weights frozen.

    No method, for it sees what it is to predict: what the bones cannot express, no method on them can predict.
    """
    bones = refit_bones(unseen, skinning)
    return Animation(points=skin(skinning.rest, skinning.weights, bones), bones=bones)


def rigid_transforms(points: np.ndarray, canonical: np.ndarray, labels: np.ndarray, sound: np.ndarray) -> np.ndarray:
    """The best rigid motion of each group of points. points: (F, N, 3); canonical: (N, 3); labels: (N,) int32 in
    0..B-1; sound: (N,) bool, the points that count, at least one in each group -> (F, B, 3, 4) float32."""
    count = int(labels.max()) + 1
    frame = _alignment(points, canonical)
    index = np.where(sound, labels, -1).astype(np.int32)[:, None]
    k, y, _ = _raw_sums(points, canonical, frame, index, np.ones(index.shape), count)
    each = np.arange(count)
    return frame.to_world(transforms.rigid_fit(k[each, each], y)[0]).astype(np.float32)


def _alignment(points: np.ndarray, canonical: np.ndarray) -> Alignment:
    count = len(canonical)
    return align(points, canonical, np.unique(np.linspace(0, count - 1, min(count, _SAMPLE)).round().astype(int)))


def _sparse(weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(N, B) -> index (N, S) int32 with -1 for none, value (N, S) float64; S the most bones a point has."""
    slots = max(int((weights > 0).sum(1).max()), 1)
    index = np.argsort(-weights, axis=1, kind="stable")[:, :slots].astype(np.int32)
    value = np.take_along_axis(weights, index, axis=1).astype(np.float64)
    index[value <= 0] = -1
    return index, value


def _start(
    points: np.ndarray, canonical: np.ndarray, frame: Alignment, index: np.ndarray, value: np.ndarray, count: int
) -> np.ndarray:
    """Each bone by itself: the rigid motion of its points, each counted by its share of the bone."""
    flat = np.where(index >= 0, value, 0.0)
    k, y = np.zeros((count, 4, 4)), 0.0
    rest = frame.homogeneous(canonical)
    for s in range(index.shape[1]):
        part_index = np.ascontiguousarray(index[:, s : s + 1])
        _, part, _ = _raw_sums(points, canonical, frame, part_index, np.ascontiguousarray(flat[:, s : s + 1]), count)
        y = y + part
        used = index[:, s] >= 0
        moments = flat[used, s, None, None] * rest[used, :, None] * rest[used, None, :]
        np.add.at(k, index[used, s], moments)
    return transforms.rigid_fit(k, y)[0]


def _raw_sums(
    points: np.ndarray, canonical: np.ndarray, frame: Alignment, index: np.ndarray, value: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray, float]:
    """K (B, B, 4, 4), Y (B, 4, 3, F) and sum |u|^2 of all points without compression."""
    rest = frame.homogeneous(canonical)
    back = rigid.inverse(frame.motion)
    back[..., 3] -= frame.centre
    back /= frame.scale
    points = np.ascontiguousarray(points, np.float32)
    k, y = np.zeros((count, count, 4, 4)), np.zeros((count, 4, 3, len(points)))
    transforms.add_moments(rest, index, value, k)

    def work(start: int, stop: int) -> float:
        return _add_frames(points, rest, back, index, value, y, start, stop)

    return k, y, sum(for_chunks(work, len(points), _FRAMES))


@njit(cache=True, nogil=True)
def _add_frames(points, rest, back, index, value, y, start, stop):
    count, slots = len(y), index.shape[1]
    sums = np.empty((count, 4, 3))
    energy = 0.0
    for f in range(start, stop):
        sums[:] = 0.0
        a = back[f]
        for n in range(len(rest)):
            x, y1, z = np.float64(points[f, n, 0]), np.float64(points[f, n, 1]), np.float64(points[f, n, 2])
            u0 = a[0, 0] * x + a[0, 1] * y1 + a[0, 2] * z + a[0, 3] - rest[n, 0]
            u1 = a[1, 0] * x + a[1, 1] * y1 + a[1, 2] * z + a[1, 3] - rest[n, 1]
            u2 = a[2, 0] * x + a[2, 1] * y1 + a[2, 2] * z + a[2, 3] - rest[n, 2]
            energy += u0 * u0 + u1 * u1 + u2 * u2
            for s in range(slots):
                b = index[n, s]
                if b >= 0:
                    for i in range(4):
                        factor = value[n, s] * rest[n, i]
                        sums[b, i, 0] += factor * u0
                        sums[b, i, 1] += factor * u1
                        sums[b, i, 2] += factor * u2
        for b in range(count):
            for i in range(4):
                for d in range(3):
                    y[b, i, d, f] = sums[b, i, d]
    return energy
