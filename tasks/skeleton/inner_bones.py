"""From free-form bones to the few that turn about joints inside the body.

Everything works on the vertices of the closed surface: they are even, of one piece and of one number, whatever the
data's points are like.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse.csgraph import connected_components

from tasks.geometry.moments import fit_rigid, skin_moments
from tasks.geometry.neighbours import adjacency, mesh_edges
from tasks.geometry.rotations import geodesic
from tasks.geometry.sparse_weights import fit_weights
from tasks.skeleton.curve_weights import node_lengths, node_weights
from tasks.values import Curve, Surface

_SUPPORT = 0.1  # a bone holds the vertices where it weighs more than this
_EXCHANGES = 2
_SWEEPS = 2


@dataclass(frozen=True)
class Bones:
    """Bones on the surface. rest: (V, 3), paths: (F, V, 3) where its vertices are and go; weights: (V, B);
    transforms: (F, B, 3, 4); influences: most bones a vertex may have."""

    rest: np.ndarray
    paths: np.ndarray
    weights: np.ndarray
    transforms: np.ndarray
    influences: int

    def keep(self, chosen: np.ndarray) -> Bones:
        """Only the chosen bones, every vertex's weights fitted anew."""
        return self.with_transforms(self.transforms[:, chosen], self.weights[:, chosen])

    def with_transforms(self, transforms: np.ndarray, start: np.ndarray) -> Bones:
        """Other transforms, every vertex's weights fitted to them."""
        weights = fit_weights(
            self.rest, self.paths, transforms, influences=self.influences, exchanges=_EXCHANGES, start=start
        )
        return Bones(self.rest, self.paths, weights, transforms, self.influences)

    def improve(self, rounds: int) -> Bones:
        """Rounds of SSDR: transforms, then weights."""
        bones = self
        for _ in range(rounds):
            moments = skin_moments(bones.rest, bones.weights, bones.paths)
            bones = bones.with_transforms(fit_rigid(moments, bones.transforms, _SWEEPS), bones.weights)
        return bones


def inner_bones(
    bones: Bones, surface: Surface, curve: Curve, *, least: float, rounds: int, angle: float, at_most: int
) -> Bones:
    """Bones that dominate some piece of the curve, none twice, none split over the body.

    least: share of the vertices below which a bone is dust; rounds: rounds of SSDR between the two filters;
    angle: bones that touch and never (98 % of the frames) turn more than this many degrees apart are one;
    at_most: bones left; where there are more, the pairs most alike are joined too.
    """
    bones = clean(split(bones, surface.faces, least), least)
    bones = bones.keep(dominant_on_curve(bones, curve)).improve(rounds)
    bones = bones.keep(dominant_on_curve(bones, curve)).improve(2)
    bones = merge(bones, curve, angle, at_most)
    return bones.keep(dominant_on_curve(bones, curve))


def split(bones: Bones, faces: np.ndarray, least: float) -> Bones:
    """A bone whose support falls into several pieces of the surface (two ears that move alike) becomes several."""
    near = adjacency(mesh_edges(faces), len(bones.rest))
    weights, origin = [], []
    for b in range(bones.weights.shape[1]):
        w = bones.weights[:, b]
        held = np.flatnonzero(w > _SUPPORT)
        if len(held) == 0:
            continue
        count, label = connected_components(near[held][:, held], directed=False)
        sizes = np.bincount(label, minlength=count)
        large = np.flatnonzero(sizes >= max(3, least * len(w)))
        for piece in large if len(large) else [int(np.argmax(sizes))]:
            column = np.zeros(len(w), np.float32)
            column[held[label == piece]] = w[held[label == piece]]
            weights.append(column)
            origin.append(b)
    weights = np.stack(weights, axis=1)
    total = weights.sum(axis=1, keepdims=True)
    lone = total[:, 0] <= 0
    weights = weights / np.where(total > 0, total, 1.0)
    weights[lone] = fit_weights(
        bones.rest[lone], bones.paths[:, lone], bones.transforms[:, origin], influences=1, exchanges=0
    )
    moments = skin_moments(bones.rest, weights, bones.paths)
    transforms = fit_rigid(moments, bones.transforms[:, origin], _SWEEPS)
    return Bones(bones.rest, bones.paths, weights, transforms, bones.influences)


def clean(bones: Bones, least: float) -> Bones:
    """Without the bones that dominate next to no vertex."""
    share = np.bincount(bones.weights.argmax(axis=1), minlength=bones.weights.shape[1]) / len(bones.rest)
    return bones.keep(np.flatnonzero(share >= least))


def dominant_on_curve(bones: Bones, curve: Curve) -> np.ndarray:
    """Numbers of the bones that weigh most at some node of the curve."""
    return np.unique(node_weights(curve, bones.weights).argmax(axis=1))


def merge(bones: Bones, curve: Curve, angle: float, at_most: int) -> Bones:
    """Joins touching bones, the most alike first, until every pair turns more than ``angle`` degrees apart
    and no more than ``at_most`` are left."""
    while bones.weights.shape[1] > 1:
        turn = relative_turn(bones.transforms)
        turn[overlap(curve, bones.weights) <= 1e-3 * node_lengths(curve).mean()] = np.inf
        np.fill_diagonal(turn, np.inf)
        a, b = np.unravel_index(int(np.argmin(turn)), turn.shape)
        if not np.isfinite(turn[a, b]) or (turn[a, b] > np.radians(angle) and len(turn) <= at_most):
            break
        weights = bones.weights.copy()
        weights[:, a] += weights[:, b]
        chosen = np.delete(np.arange(weights.shape[1]), b)
        transforms = fit_rigid(
            skin_moments(bones.rest, weights[:, chosen], bones.paths), bones.transforms[:, chosen], _SWEEPS
        )
        bones = Bones(bones.rest, bones.paths, weights[:, chosen], transforms, bones.influences)
    return bones


def relative_turn(transforms: np.ndarray) -> np.ndarray:
    """(B, B) angle in radians that two bones turn apart, its 98th percentile over the frames."""
    r = transforms[..., :3]
    count = r.shape[1]
    out = np.zeros((count, count))
    for b in range(count):
        out[b] = np.percentile(geodesic(r, r[:, b : b + 1]), 98.0, axis=0)
    return out


def overlap(curve: Curve, weights: np.ndarray) -> np.ndarray:
    """(B, B) length of curve on which two bones share: the integral of w_a w_b. weights: (V, B)."""
    on_curve = node_weights(curve, weights)
    return on_curve.T @ (on_curve * node_lengths(curve)[:, None])
