"""From free-form bones to the few that turn about joints inside the body."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tasks.geometry import rigid
from tasks.geometry.measure import vertex_rmse
from tasks.geometry.moments import fit_rigid, skin_moments
from tasks.geometry.rotations import geodesic, project_so3
from tasks.geometry.skinning import skin
from tasks.geometry.sparse_weights import fit_weights

_EXCHANGES = 2
_SWEEPS = 2
_SUPPORT = 0.02  # bones that weigh more than this on a point that the dropped bone also held are looked at again
_TRACE = 1e-3  # weights below do not count
_SLOWEST, _FASTEST, _FASTER = 0.4, 0.95, 0.05  # Nesterov's extrapolation: start, most, growth a round
SMALLEST = 0.004  # of the diagonal: extent below which a bone's angle would be noise
_EXACT = 1e-4  # of the diagonal: errors below are as good as none


@dataclass(frozen=True)
class Bones:
    """Bones and the points they move. rest: (N, 3); paths: (F, N, 3); weights: (N, B); transforms: (F, B, 3, 4);
    influences: most bones a point may have."""

    rest: np.ndarray
    paths: np.ndarray
    weights: np.ndarray
    transforms: np.ndarray
    influences: int

    @property
    def count(self) -> int:
        """Number of bones B."""
        return self.weights.shape[1]

    def refit(self, transforms: np.ndarray, start: np.ndarray) -> Bones:
        """Other transforms; every point's weights fitted to them from the support of ``start``."""
        weights = fit_weights(
            self.rest, self.paths, transforms, influences=self.influences, exchanges=_EXCHANGES, start=start
        )
        return Bones(self.rest, self.paths, weights, transforms, self.influences)

    def keep(self, chosen: np.ndarray) -> Bones:
        """Only the chosen bones."""
        return self.refit(self.transforms[:, chosen], self.weights[:, chosen])

    def improve(self, rounds: int) -> Bones:
        """Rounds of SSDR (transforms, then weights) with Nesterov's extrapolation of the transforms between them."""
        bones, ahead, best, speed = self, self.transforms, np.inf, _SLOWEST
        for _ in range(rounds):
            moments = skin_moments(bones.rest, bones.weights, bones.paths)
            new = bones.refit(fit_rigid(moments, ahead, _SWEEPS), bones.weights)
            error = new.error()
            if error > best:
                ahead, speed = new.transforms, _SLOWEST
            else:
                ahead = new.beyond(bones.transforms, speed)
                speed, best = min(_FASTEST, speed + _FASTER), error
            bones = new
        return bones

    def beyond(self, before: np.ndarray, speed: float) -> np.ndarray:
        """Transforms extrapolated from others (F, B, 3, 4): each bone's turn, and the path of the centre of what it
        moves. About the origin instead, a small turn would be a long way off it."""
        mass = self.weights.sum(axis=0, dtype=np.float64)[:, None]
        centres = np.where(mass > 0.0, self.weights.T @ self.rest / np.where(mass > 0.0, mass, 1.0), 0.0)
        paths = rigid.apply(self.transforms, centres)
        paths = paths + speed * (paths - rigid.apply(before, centres))
        turns = project_so3(self.transforms[..., :3] + speed * (self.transforms[..., :3] - before[..., :3]))
        return rigid.make(turns, paths - (turns @ centres[..., None])[..., 0])

    def error(self) -> float:
        """Vertex RMSE."""
        return vertex_rmse(skin(self.rest, self.weights, self.transforms), self.paths)


def rigid_pieces(bones: Bones, labels: np.ndarray, least: int) -> Bones:
    """One bone for every piece of points (N,) of at least ``least`` points, moving as the piece moves as a whole: away
    from blends that fit the points but lie on no limb, and one bone no longer serves both ears."""
    sizes = np.bincount(labels)
    large = np.flatnonzero(sizes >= least)
    if len(large) == 0:
        large = np.array([int(np.argmax(sizes))])
    member = (labels[:, None] == large).astype(np.float32)
    start = rigid.identity(len(bones.paths), len(large), dtype=np.float64)
    transforms = fit_rigid(skin_moments(bones.rest, member, bones.paths), start, 1)
    return bones.refit(transforms, member)


def prune(bones: Bones, size: float, *, knee: float, angle: float, at_most: int) -> Bones:
    """Drops the bone whose absence the others make up for best (:func:`absence`), again and again, each time with a
    round of SSDR, down to the knee of error against count: as long as spare bones go, the error stays about where it
    was, and it leaps with the first that carries a limb.

    Stops before the error exceeds ``knee`` times the least so far (or times ``_EXACT``, where that is more), or when
    every bone carries its points more than ``angle`` degrees away from where the others could; but not above
    ``at_most`` bones. size: the shape's diagonal.
    """
    missed, least, kept = absence(bones, np.arange(bones.count), size), np.inf, bones
    while True:
        error = bones.error()
        least = min(least, error)
        if bones.count <= at_most:
            if kept.count <= at_most and error > knee * max(least, _EXACT * size):
                return kept
            kept = bones
            if missed[:, 0].min() >= np.radians(angle):
                return kept
        if bones.count == 1:
            return bones
        drop = int(np.argmin(missed[:, 1]))
        held = bones.weights[:, drop] > _SUPPORT
        near = ((bones.weights > _SUPPORT) & held[:, None]).any(axis=0)
        others = np.delete(np.arange(bones.count), drop)
        bones, missed, near = bones.keep(others).improve(1), missed[others], np.flatnonzero(near[others])
        missed[near] = absence(bones, near, size)


def absence(bones: Bones, which: np.ndarray, size: float) -> np.ndarray:
    """What the motion loses without a bone when its points may take other bones: (K, 2).

    First an angle in radians: the RMS distance by which its points then miss, over the extent of these points. It
    does not depend on how many points there are, so that an ear counts as much as a leg. Second the key by which
    bones are compared: the square of that angle times the root of the bone's share of the points.
    """
    now = np.sum((skin(bones.rest, bones.weights, bones.transforms) - bones.paths) ** 2, axis=(0, 2), dtype=np.float64)
    out = np.zeros((len(which), 2))
    for i, b in enumerate(which):
        held = np.flatnonzero(bones.weights[:, b] > _TRACE)
        others = np.delete(np.arange(bones.count), b)
        if len(held) == 0 or len(others) == 0:
            continue
        few = Bones(bones.rest[held], bones.paths[:, held], bones.weights[held], bones.transforms, bones.influences)
        few = few.keep(others)
        then = np.sum((skin(few.rest, few.weights, few.transforms) - few.paths) ** 2, axis=(0, 2), dtype=np.float64)
        mass = bones.weights[held, b].astype(np.float64) ** 2
        centre = mass @ few.rest / mass.sum()
        extent = np.sqrt(mass @ np.sum((few.rest - centre) ** 2, axis=1) / mass.sum())
        lost = max(float(np.sum(then - now[held])), 0.0) / len(bones.paths) / mass.sum()
        squared = lost / max(extent, SMALLEST * size) ** 2
        out[i] = np.sqrt(squared), squared * np.sqrt(mass.sum() / len(bones.rest))
    return out


def merge_alike(bones: Bones, overlap: np.ndarray, angle: float) -> Bones:
    """Joins bones that touch (overlap (B, B) > 0) and in 98 % of the frames turn less than ``angle`` degrees apart."""
    while bones.count > 1:
        turn = np.where(overlap > 0, relative_turn(bones.transforms), np.inf)
        np.fill_diagonal(turn, np.inf)
        a, b = np.unravel_index(int(np.argmin(turn)), turn.shape)
        if turn[a, b] > np.radians(angle):
            break
        weights = bones.weights.copy()
        weights[:, a] += weights[:, b]
        others = np.delete(np.arange(bones.count), b)
        joined = overlap.copy()
        joined[a] += overlap[b]
        joined[:, a] += overlap[:, b]
        overlap = joined[np.ix_(others, others)]
        moments = skin_moments(bones.rest, weights[:, others], bones.paths)
        bones = bones.refit(fit_rigid(moments, bones.transforms[:, others], _SWEEPS), weights[:, others])
    return bones


def relative_turn(transforms: np.ndarray) -> np.ndarray:
    """(B, B) angle in radians that two bones turn apart, its 98th percentile over the frames."""
    r = transforms[..., :3]
    count = r.shape[1]
    out = np.zeros((count, count))
    for b in range(count):
        out[b] = np.percentile(geodesic(r, r[:, b : b + 1]), 98.0, axis=0)
    return out
