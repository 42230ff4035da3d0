"""Joints from how the bones move: the centres about which neighbouring bones turn, guided by the curve skeleton."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np

from tasks.geometry.measure import diagonal
from tasks.skeleton.body import Body, few_bones
from tasks.skeleton.curve_weights import onto_surface, sampled, thin
from tasks.skeleton.inner_bones import Bones
from tasks.skeleton.linking import better_posed, by_curve, by_motion, tree_residuals
from tasks.skeleton.refit import spread_weights
from tasks.skeleton.symmetry import find_mirror
from tasks.skeleton.tree import joint_names
from tasks.skeleton.tree_fit import (
    HOLD_CURVE,
    HOLD_MOTION,
    Fit,
    Watched,
    fit_tree,
    follows_better,
    keep_inside,
    spread,
    watch,
)
from tasks.values import Canonical, Curve, Motion, Skeleton, Skinning, Surface

_FRAMES, _POINTS = 100, 2500  # looked at while bones are pruned; the fit of the tree sees more
_INFLUENCES = 4  # bones a point follows while they are pruned: more let ghosts hide


def joints_by_motion(
    train: Motion,
    canonical: Canonical,
    skinning: Skinning,
    surface: Surface,
    curve: Curve,
    *,
    max_joints: Annotated[int, "[1, 500]"],
    topology: Literal["auto", "motion", "curve"],
    rigid_residual: Annotated[float, "[0, inf)"],
    knee: Annotated[float, "[1, 100]"],
    missed: Annotated[float, "[0, 90]"],
    angle: Annotated[float, "[0, 90]"],
    shortest: Annotated[float, "[0, inf)"],
    reach: Annotated[float, "[0, inf)"],
    hinge: Annotated[float, "[0, 0.5]"],
    symmetric: bool,
    rounds: Annotated[int, "[0, inf)"],
    refits: Annotated[int, "[0, inf)"],
    influences: Annotated[int, "[1, 16]"],
) -> Skeleton:
    """Few bones that explain the motion (:mod:`tasks.skeleton.inner_bones`, :mod:`tasks.skeleton.division`), joints
    where two of them carry the same point along (:mod:`tasks.skeleton.articulation`), a tree over them, then weights
    and joints refitted to the motion (:mod:`tasks.skeleton.refit`). One joint a bone: it owns the points that its bone
    moves; no end effectors.

    max_joints: most joints; topology: ``motion`` takes the spanning tree of least joint gap, which is right for
    articulated bodies; ``curve`` keeps the curve's own tree, which does not tangle under cloth and soft tissue;
    ``auto`` takes the first where its median gap is under ``rigid_residual``, and else the second, unless the first
    follows the motion clearly better; knee: times the least error that fewer bones may cost; missed: degrees by which a
    bone's points must miss without it to be safe; angle: degrees below which two bones that touch are one; shortest:
    run of curve below which a bone is dropped (curve topology); reach: how far a joint may lie from where its bones
    meet on the curve; hinge: along an axis with less than this share of the squared turn a joint goes to where its
    bones' skins meet; symmetric: left and right of a shape that is its own mirror image get mirrored joints; rounds: of
    SSDR once the bones are chosen; refits: rounds of refitting; influences: most joints a point may follow. Lengths are
    shares of the bounding-box diagonal.
    """
    chosen = thin(canonical, surface, curve, _POINTS)
    carry, mirror = onto_surface(sampled(canonical, chosen), surface), find_mirror(surface) if symmetric else None
    body = Body(surface, curve, carry, diagonal(canonical.points), mirror)
    frames = spread(train.frames, _FRAMES)
    bones = _bones(train, canonical, skinning, frames, chosen)
    bones = few_bones(bones, body, at_most=max_joints, knee=knee, missed=missed, angle=angle, rounds=rounds)
    watched = watch(train, canonical, body, frames)
    trees = {"topology": topology, "rigid_residual": rigid_residual, "shortest": shortest, "angle": angle}
    refitting = {"rounds": refits, "influences": influences, "hinge": hinge}
    fit = _fitted(bones, body, watched, reach=reach, at_most=max_joints, refitting=refitting, **trees)
    joints, weights = keep_inside(fit.joints, surface, curve), fit.weights
    if len(watched.chosen) < len(canonical.points):
        seen = train.points[watched.more]
        weights = spread_weights(seen, canonical.points, fit.parents, joints, watched.chosen, weights, influences)
    return Skeleton(joint_names(len(joints)), fit.parents, joints.astype(np.float32), weights)


def _fitted(
    bones: Bones,
    body: Body,
    watched: Watched,
    *,
    topology: str,
    rigid_residual: float,
    shortest: float,
    angle: float,
    reach: float,
    at_most: int,
    refitting: dict,
) -> Fit:
    """The tree of the topology asked for, refitted; of both where ``auto`` has to try both, the better one."""
    refitting = refitting | {"reach": reach * body.size}
    fits = []
    if topology != "curve":
        tree = better_posed(by_motion(bones, body, reach), by_motion(bones, body, reach, relative=True), body)
        fits.append(fit_tree(tree, body, watched, hold=HOLD_MOTION, **refitting))
    if topology == "curve" or (topology == "auto" and np.median(tree_residuals(tree)) > rigid_residual):
        tree = by_curve(bones, body, reach, shortest=shortest, angle=angle, at_most=at_most)
        fits.append(fit_tree(tree, body, watched, hold=HOLD_CURVE, **refitting))
    return fits[0] if len(fits) == 1 else follows_better(*fits, watched)


def _bones(train: Motion, canonical: Canonical, skinning: Skinning, frames, points) -> Bones:
    return Bones(
        canonical.points[points].astype(np.float64),
        train.points[frames][:, points],
        skinning.weights[points],
        skinning.transforms[frames].astype(np.float64),
        _INFLUENCES,
    )
