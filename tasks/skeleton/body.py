"""A body with its curve skeleton, and the few of its free bones that a skeleton needs."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from tasks.geometry.neighbours import adjacency, mesh_edges
from tasks.skeleton.curve_weights import Interpolation, node_lengths, node_weights
from tasks.skeleton.division import divide
from tasks.skeleton.inner_bones import Bones, absence, merge_alike, prune, rigid_pieces
from tasks.skeleton.symmetry import Mirror
from tasks.skeleton.tree import to_ends
from tasks.values import Curve, Surface

_AFTER = 6  # bones a point follows once they are chosen
_LEAST = 3  # points that a piece needs to turn as a whole
_TIP, _TIP_MISSED = 0.08, 2.0  # of the diagonal: length of a limb's tip; times ``missed`` for a bone in it to be kept
_WARM_UP = 3  # rounds of SSDR before pruning


@dataclass(frozen=True)
class Body:
    """What joints are looked for on. surface, curve: of the canonical shape; carry: from the bones' points to the
    surface; size: the shape's diagonal; mirror: its plane of symmetry, where it has one."""

    surface: Surface
    curve: Curve
    carry: Interpolation
    size: float
    mirror: Mirror | None

    def on_curve(self, weights: np.ndarray) -> np.ndarray:
        """Weights of the bones' points (N, B) on the curve's nodes (M, B)."""
        return node_weights(self.curve, self.carry.carry(weights))

    def limbs(self, bones: Bones, missed: float) -> Bones:
        """Only the bones that weigh most at some node of the curve: the others move skin but no limb. But all fingers
        of a hand share one end of the curve, as do the two ends of an ear: near an end a bone stays, too, if it owns
        points that would miss by ``_TIP_MISSED`` times ``missed`` degrees without it."""
        on_curve = self.on_curve(bones.weights)
        shown = np.unique(on_curve.argmax(axis=1))
        hidden = np.setdiff1d(np.arange(bones.count), shown)
        owned = np.bincount(bones.weights.argmax(axis=1), minlength=bones.count)
        near = to_ends(self.curve)[on_curve[:, hidden].argmax(axis=0)] <= _TIP * self.size
        tips = hidden[near & (owned[hidden] >= _LEAST)]
        turns = absence(bones, tips, self.size)[:, 0]
        return bones.keep(np.sort(np.concatenate([shown, tips[turns >= np.radians(_TIP_MISSED * missed)]])))


def few_bones(
    bones: Bones, body: Body, *, at_most: int, knee: float, missed: float, angle: float, rounds: int
) -> Bones:
    """From the free bones to those that a skeleton needs."""
    label = _pieces(bones, body)
    bones = rigid_pieces(bones, label, _LEAST).improve(_WARM_UP)
    bones = prune(bones, body.size, knee=knee, angle=missed, at_most=at_most).improve(rounds)
    bones = body.limbs(bones, missed).improve(rounds)
    on_curve = body.on_curve(bones.weights)
    shared = on_curve.T @ (on_curve * node_lengths(body.curve)[:, None])
    bones = merge_alike(bones, np.where(shared > 1e-3 * node_lengths(body.curve).mean(), shared, 0.0), angle)
    bones = replace(bones, influences=_AFTER).improve(2 * rounds)
    return divide(bones, body.size, angle=angle, at_most=at_most, rounds=rounds)


def _pieces(bones: Bones, body: Body) -> np.ndarray:
    """(N,) label of the connected piece of the surface that one bone dominates; every point takes its vertex's."""
    on_surface = body.carry.carry(bones.weights).argmax(axis=1)
    edges = mesh_edges(body.surface.faces)
    inside = on_surface[edges[:, 0]] == on_surface[edges[:, 1]]
    _, piece = connected_components(adjacency(edges[inside], len(on_surface)), directed=False)
    near = cKDTree(body.surface.vertices).query(bones.rest)[1]
    return piece[near]
