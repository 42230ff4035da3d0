"""A tree over bones, its joints and weights fitted to the motion of the points."""

from __future__ import annotations

from dataclasses import dataclass

import igl
import numpy as np

from tasks.geometry.moments import skin_error, skin_moments
from tasks.skeleton.articulation import off_hinges
from tasks.skeleton.body import Body
from tasks.skeleton.curve_weights import Interpolation, onto_surface, sampled, thin, vertex_areas
from tasks.skeleton.inner_bones import Bones
from tasks.skeleton.linking import Articulation, assemble
from tasks.skeleton.refit import posed, refit
from tasks.values import Canonical, Curve, Motion, Surface

HOLD_CURVE, HOLD_MOTION = 0.003, 0.03  # pull on joints in the refit, by whose tree it is
_FRAMES, _POINTS = 300, 6000  # looked at
_MUCH = 0.8  # of the squared error: the motion's tree for the curve's own
_FAR = 0.15  # of the diagonal: farther from its joint, the skin that two bones share says nothing of it
_GAP = 0.003  # of the diagonal: what taking a joint along its hinge to there may cost


@dataclass(frozen=True)
class Watched:
    """What a tree is refitted to. chosen: (K,) numbers of points; more: (F,) numbers of frames; rest: (K, 3); paths:
    (F, K, 3); few_paths: (f, K, 3), in the frames that the bones' transforms are of; carry: from the points to the
    surface."""

    chosen: np.ndarray
    more: np.ndarray
    rest: np.ndarray
    paths: np.ndarray
    few_paths: np.ndarray
    carry: Interpolation


@dataclass(frozen=True)
class Fit:
    """A refitted tree. parents: (J,); joints: (J, 3) float64; weights: (K, J) of the watched points."""

    parents: np.ndarray
    joints: np.ndarray
    weights: np.ndarray


def watch(train: Motion, canonical: Canonical, body: Body, frames: np.ndarray) -> Watched:
    chosen = thin(canonical, body.surface, body.curve, _POINTS)
    more = spread(train.frames, _FRAMES)
    rest = canonical.points[chosen].astype(np.float64)
    carry = onto_surface(sampled(canonical, chosen), body.surface)
    return Watched(chosen, more, rest, train.points[more][:, chosen], train.points[frames][:, chosen], carry)


def fit_tree(
    found: Articulation,
    body: Body,
    watched: Watched,
    *,
    rounds: int,
    influences: int,
    reach: float,
    hinge: float,
    hold: float,
) -> Fit:
    """The tree over the bones, its joints and weights refitted to the motion of the watched points."""
    order, parents, joints = assemble(found, body)
    transforms = found.bones.transforms[:, order]
    nothing = np.zeros((len(watched.rest), len(joints)))

    def settle(joints: np.ndarray, weights: np.ndarray, world: np.ndarray) -> np.ndarray:
        meet = _meet(parents, joints, watched.carry.carry(weights), body.surface)
        far, gap = _FAR * body.size, _GAP * body.size
        joints = off_hinges(parents, joints, world, meet, share=hinge, far=far, gap=gap)
        return joints if body.mirror is None else body.mirror.even(joints)

    start = Bones(watched.rest, watched.few_paths, nothing, transforms, influences).refit(transforms, nothing)
    how = {"rounds": rounds, "influences": influences, "reach": reach, "hold": hold, "settle": settle}
    return Fit(parents, *refit(watched.paths, watched.rest, parents, joints, start.weights, **how))


def _meet(parents: np.ndarray, joints: np.ndarray, weights: np.ndarray, surface: Surface) -> np.ndarray:
    """(J, 3) middle of the skin that each joint shares with its parent; the joint itself where they share none.
    weights: (V, J) of the surface."""
    share = (weights * weights[:, np.maximum(parents, 0)]) ** 2 * vertex_areas(surface)[:, None]
    share[:, parents < 0] = 0.0
    total = share.sum(axis=0)[:, None]
    return np.where(total > 0.0, share.T @ surface.vertices / np.where(total > 0.0, total, 1.0), joints)


def follows_better(by_motion: Fit, by_curve: Fit, watched: Watched) -> Fit:
    """The curve's own tree, unless the motion's follows the points clearly better."""
    return by_motion if _missed(by_motion, watched) < _MUCH * _missed(by_curve, watched) else by_curve


def _missed(fit: Fit, watched: Watched) -> float:
    """Mean of the summed squared distances of a frame."""
    origin = watched.rest.mean(axis=0)
    moments = skin_moments(watched.rest - origin, fit.weights, watched.paths - origin.astype(np.float32))
    return float(skin_error(moments, posed(fit.parents, fit.joints - origin, moments)).mean())


def keep_inside(joints: np.ndarray, surface: Surface, curve: Curve) -> np.ndarray:
    """Joints outside the closed surface move towards the nearest node of the curve until they are inside."""
    vertices, faces = surface.vertices.astype(np.float64), surface.faces.astype(np.int64)
    nodes = curve.nodes.astype(np.float64)
    nodes = nodes[igl.fast_winding_number(vertices, faces, nodes) > 0.5] if len(nodes) else nodes
    if len(nodes) == 0:
        return joints
    target = nodes[np.linalg.norm(joints[:, None] - nodes[None], axis=2).argmin(axis=1)]
    out = joints.copy()
    for t in np.linspace(0.0, 1.0, 11):
        outside = igl.fast_winding_number(vertices, faces, out) <= 0.5
        if not outside.any():
            break
        out[outside] = (1.0 - t) * joints[outside] + t * target[outside]
    return out


def spread(frames: int, most: int) -> np.ndarray:
    return np.unique(np.linspace(0, frames - 1, min(frames, most)).round().astype(np.int64))
