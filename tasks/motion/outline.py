"""The body beneath a garment, as the garment's own training frames outline it.

No method is given the body. But every point of the skin that cloth ever lay on shows in some frame: seen from the
nearest bone of the skeleton, the lowest places that points of the garment come to are where the body begins.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from tasks.geometry.parallel import for_chunks
from tasks.values import Skeleton

ALONG, AROUND = 10, 24  # cells of a bone's outline
SHORT = 0.03  # metres: joints that lie closer have no body between them
BIN, BINS = 0.002, 250  # metres, how finely distances are counted
LOWEST, SEEN = 0.01, 50  # share of a cell's points that may lie deeper, and how many points tell of a cell
BULGE = 1.6  # a cell sticks out at most so much more than the slimmer quarter of its ring: hanging cloth is no body
FRAMES = 256


@dataclass(frozen=True)
class Outline:
    """A body of bones, each with its distance to the skin. joint: (S,) that each moves with; at: (S, 4, 3) where it
    begins, its direction and two more that span its cross-section, at rest; length: (S,); radius: (S, ALONG, AROUND),
    0 where no cloth came. Metres."""

    joint: np.ndarray
    at: np.ndarray
    length: np.ndarray
    radius: np.ndarray

    def posed(self, world: np.ndarray) -> np.ndarray:
        """(F, J, 3, 4) of the joints -> (F, S, 4, 3) the bones, as ``at``."""
        return _posed(self.joint, self.at, world)


def find_outline(skeleton: Skeleton, joints: np.ndarray, world: np.ndarray, points: np.ndarray) -> Outline:
    """joints: (J, 3) at rest; world: (F, J, 3, 4); points: (F, N, 3) of the garment. Metres."""
    parents = np.asarray(skeleton.parents)
    ends = np.flatnonzero(parents >= 0)
    ends = ends[np.linalg.norm(joints[ends] - joints[parents[ends]], axis=1) > SHORT]
    begin = joints[parents[ends]].astype(np.float64)
    along = joints[ends] - begin
    length = np.linalg.norm(along, axis=1)
    along = along / length[:, None]
    other = np.where(np.abs(along[:, 2:]) < 0.9, [0.0, 0.0, 1.0], [1.0, 0.0, 0.0])
    across = other - (other * along).sum(1)[:, None] * along
    across /= np.linalg.norm(across, axis=1)[:, None]
    joint, at = parents[ends], np.stack([begin, along, across, np.cross(along, across)], axis=1)
    bones = _posed(joint, at, world)

    def work(a: int, b: int) -> np.ndarray:
        counts = np.zeros((len(ends), ALONG, AROUND, BINS), np.int32)
        _count(points[a:b].astype(np.float64), bones[a:b], length, counts)
        return counts

    counts = sum(for_chunks(work, len(points), FRAMES))
    below = counts.cumsum(3)
    total = below[..., -1]
    radius = BIN * (below <= LOWEST * total[..., None]).sum(3)
    seen = total > SEEN
    slim = _slim(radius, seen)
    return Outline(joint, at, length, np.where(seen, np.minimum(radius, BULGE * slim[..., None]), 0.0))


def _slim(radius: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """The lower quartile of each ring's cells that were seen; 0 where none was."""
    ranked = np.sort(np.where(seen, radius, np.inf), axis=2)
    at = np.maximum(seen.sum(2) - 1, 0) // 4
    found = np.take_along_axis(ranked, at[..., None], axis=2)[..., 0]
    return np.where(np.isfinite(found), found, 0.0)


def _posed(joint: np.ndarray, at: np.ndarray, world: np.ndarray) -> np.ndarray:
    carried = world[:, joint]
    bones = np.einsum("fsij,skj->fski", carried[..., :3], at)
    bones[:, :, 0] += carried[..., 3]
    return bones


@njit(cache=True, nogil=True)
def nearest_bone(x, bones, length):
    """The bone (S, 4, 3) whose axis lies nearest to the point x (3,); -1 where there is none."""
    best, found = np.inf, -1
    for s in range(len(length)):
        d = seen_from_bone(x, bones[s], length[s])[4]
        if d < best:
            best, found = d, s
    return found


@njit(cache=True, nogil=True)
def seen_from_bone(x, bone, length):
    """How far along the bone x lies, the same kept within the bone, its place across, and its distance from it."""
    dx, dy, dz = x[0] - bone[0, 0], x[1] - bone[0, 1], x[2] - bone[0, 2]
    along = dx * bone[1, 0] + dy * bone[1, 1] + dz * bone[1, 2]
    y = dx * bone[2, 0] + dy * bone[2, 1] + dz * bone[2, 2]
    z = dx * bone[3, 0] + dy * bone[3, 1] + dz * bone[3, 2]
    within = min(max(along, 0.0), length)
    return along, within, y, z, np.sqrt((along - within) ** 2 + y * y + z * z)


@njit(cache=True, nogil=True)
def radius_at(radius, within, length, y, z):
    """The outline (ALONG, AROUND) of one bone there, between the cells' middles by both directions."""
    row = within / length * ALONG - 0.5
    column = (np.arctan2(z, y) / (2.0 * np.pi) + 0.5) * AROUND - 0.5
    i, k = int(np.floor(row)), int(np.floor(column))
    u, v = row - i, column - k
    above, below = min(max(i, 0), ALONG - 1), min(max(i + 1, 0), ALONG - 1)
    left, right = k % AROUND, (k + 1) % AROUND
    first = (1.0 - v) * radius[above, left] + v * radius[above, right]
    return (1.0 - u) * first + u * ((1.0 - v) * radius[below, left] + v * radius[below, right])


@njit(cache=True, nogil=True)
def _count(points, bones, length, counts):
    for f in range(len(points)):
        for n in range(points.shape[1]):
            s = nearest_bone(points[f, n], bones[f], length)
            if s < 0:
                continue
            _, within, y, z, distance = seen_from_bone(points[f, n], bones[f, s], length[s])
            i = min(int(within / length[s] * ALONG), ALONG - 1)
            k = int((np.arctan2(z, y) / (2.0 * np.pi) + 0.5) * AROUND) % AROUND
            q = int(distance / BIN)
            if q < BINS:
                counts[s, i, k, q] += 1
