"""Joints from how the bones move: the centres about which neighbouring bones turn, guided by the curve skeleton."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Literal

import igl
import numpy as np
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from tasks.geometry.measure import diagonal
from tasks.geometry.moments import skin_error, skin_moments
from tasks.geometry.neighbours import adjacency, mesh_edges
from tasks.geometry.rotations import geodesic, project_so3
from tasks.skeleton.articulation import centres, off_hinges
from tasks.skeleton.curve_weights import Interpolation, node_lengths, node_weights, onto_surface, thin, vertex_areas
from tasks.skeleton.inner_bones import Bones, absence, merge_alike, prune, relative_turn, rigid_pieces
from tasks.skeleton.refit import posed, refit, spread_weights
from tasks.skeleton.runs import find_runs
from tasks.skeleton.symmetry import Mirror, find_mirror
from tasks.skeleton.tree import joint_names, kinematic_tree, link_components, to_ends
from tasks.values import Canonical, Curve, Motion, Skeleton, Skinning, Surface

_PULL = 0.001
_FOCUS = 4.0  # power of w_a w_b: traces of both far away must not draw their joint from where they meet
_SOFT = 0.03  # of the diagonal: a joint with this residual stays about where the curve puts it
_HOLD_CURVE, _HOLD_MOTION = 0.003, 0.03  # pull on joints in the refit, by whose tree it is
_FRAMES, _POINTS = 100, 2500  # looked at while bones are pruned; the refit sees more
_REFIT_FRAMES, _REFIT_POINTS = 300, 6000
_INFLUENCES = 4  # bones a point follows while they are pruned: more let ghosts hide
_AFTER = 6  # and once they are chosen
_CLEARLY, _MUCH = 0.9, 0.8  # of the squared error: one spanning tree for another; a spanning tree for the curve's own
_LIMBS, _TRUNK = 3, 0.3  # the root has at least so many bones round it, and this part of the largest such bone's skin
_FAR = 0.15  # of the diagonal: farther from its joint, the skin that two bones share says nothing of it
_GAP = 0.003  # of the diagonal: what taking a joint along its hinge to there may cost
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


@dataclass(frozen=True)
class Articulation:
    """Bones and the places where they meet. links: (L, 2) bone numbers; points: (L, 3) their joints; residuals: (L,)
    gap between both bones' idea of the joint, as a share of the diagonal; costs: (L,) for the spanning tree;
    middles: (B, 3) each bone's centre on the curve; areas: (B,) surface that each bone carries."""

    bones: Bones
    links: np.ndarray
    points: np.ndarray
    residuals: np.ndarray
    costs: np.ndarray
    middles: np.ndarray
    areas: np.ndarray


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
    """Few bones that explain the motion (:mod:`tasks.skeleton.inner_bones`), joints where two of them carry the same
    point along (:mod:`tasks.skeleton.articulation`), a tree over them, then weights and joints refitted to the motion
    (:mod:`tasks.skeleton.refit`). One joint a bone: it owns the points that its bone moves; no end effectors.

    max_joints: most joints; topology: ``motion`` takes the spanning tree of least joint gap, which is right for
    articulated bodies; ``curve`` keeps the curve's own tree, which does not tangle under cloth and soft tissue;
    ``auto`` takes the first where its median gap is under ``rigid_residual``, and else the second, unless the first
    follows the motion clearly better; knee: times the least error that fewer
    bones may cost; missed: degrees by which a bone's points must miss without it to be safe; angle: degrees below
    which two bones that touch are one; shortest: run of curve below which a bone is dropped (curve topology); reach:
    how far a joint may lie from where its bones meet on the curve; hinge: along
    an axis with less than this share of the squared turn a joint goes to where its bones' skins meet; symmetric: left
    and right of a shape that is its own mirror image get mirrored joints; rounds: of SSDR once the bones are chosen;
    refits: rounds of refitting; influences: most joints a point may follow. Lengths are shares of the bounding-box
    diagonal.
    """
    size = diagonal(canonical.points)
    chosen = thin(canonical, surface, curve, _POINTS)
    body = Body(
        surface,
        curve,
        onto_surface(_sampled(canonical, chosen), surface),
        size,
        find_mirror(surface) if symmetric else None,
    )
    frames = _spread(train.frames, _FRAMES)
    bones = _bones(train, canonical, skinning, frames, chosen)
    bones = few_bones(bones, body, at_most=max_joints, knee=knee, missed=missed, angle=angle, rounds=rounds)
    watched = _watch(train, canonical, body, frames)
    refitting = {"rounds": refits, "influences": influences, "reach": reach * size, "hinge": hinge}
    fits = []
    if topology != "curve":
        tree = better_posed(by_motion(bones, body, reach), by_motion(bones, body, reach, relative=True), body)
        fits.append(_fit_tree(tree, body, watched, hold=_HOLD_MOTION, **refitting))
    if topology == "curve" or (topology == "auto" and np.median(_tree_residuals(tree)) > rigid_residual):
        tree = by_curve(bones, body, reach, shortest=shortest, angle=angle, at_most=max_joints)
        fits.append(_fit_tree(tree, body, watched, hold=_HOLD_CURVE, **refitting))
    fit = fits[0] if len(fits) == 1 else _chosen(*fits, watched)
    joints = keep_inside(fit.joints, surface, curve)
    weights = fit.weights
    if len(watched.chosen) < len(canonical.points):
        seen = train.points[watched.more]
        weights = spread_weights(seen, canonical.points, fit.parents, joints, watched.chosen, weights, influences)
    return Skeleton(joint_names(len(joints)), fit.parents, joints.astype(np.float32), weights)


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
    return replace(bones, influences=_AFTER).improve(2 * rounds)


def by_motion(bones: Bones, body: Body, reach: float, *, relative: bool = False) -> Articulation:
    """Every pair of bones that shares some curve is a candidate; a gap, a joint far from the shared curve and a small
    share all make it dear. relative: the share counts against what both bones have of the curve."""
    curve, size = body.curve, body.size
    on_curve, length = body.on_curve(bones.weights), node_lengths(curve)
    edges = link_components(curve.nodes, curve.edges)
    meet = on_curve.argmax(axis=1)[edges]
    shared = on_curve.T @ (on_curve * length[:, None])
    candidates = shared > 1e-3 * length.mean()
    candidates[meet[:, 0], meet[:, 1]] = candidates[meet[:, 1], meet[:, 0]] = True  # so that the graph is connected
    pairs = np.argwhere(np.triu(candidates, 1))
    share = (on_curve[:, pairs[:, 0]] * on_curve[:, pairs[:, 1]] + 1e-9) ** _FOCUS * length[:, None]
    guess = (share.T @ curve.nodes) / share.sum(axis=0)[:, None]
    points, residuals = centres(bones.transforms, pairs, guess, np.full(len(pairs), _PULL), reach * size)
    away = np.linalg.norm(points - guess, axis=1)
    common = np.maximum(shared[pairs[:, 0], pairs[:, 1]], 1e-6 * length.mean())
    if relative:
        common = common / np.sqrt(shared[pairs[:, 0], pairs[:, 0]] * shared[pairs[:, 1], pairs[:, 1]])
    costs = (residuals / size + 0.3 * away / size + 0.001) / np.sqrt(common)
    middles = _middles(on_curve * length[:, None], curve)
    areas = vertex_areas(body.surface) @ body.carry.carry(bones.weights)
    return Articulation(bones, pairs, points, residuals / size, costs, middles, areas)


def better_posed(first: Articulation, second: Articulation, body: Body) -> Articulation:
    """The first, unless the tree of the second follows the motion clearly better when both are posed."""
    return second if _posed_error(second, body) < _CLEARLY * _posed_error(first, body) else first


def _posed_error(found: Articulation, body: Body) -> float:
    order, parents, joints = _assemble(found, body)
    bones, origin = found.bones, found.bones.rest.mean(axis=0)
    moments = skin_moments(bones.rest - origin, bones.weights[:, order], bones.paths - origin.astype(np.float32))
    return float(skin_error(moments, posed(parents, joints - origin, moments)).mean())


def by_curve(bones: Bones, body: Body, reach: float, *, shortest: float, angle: float, at_most: int) -> Articulation:
    """The curve's own tree: a bone for every run of nodes that one bone dominates, a joint where two runs meet."""
    curve, size = body.curve, body.size
    edges, length = link_components(curve.nodes, curve.edges), node_lengths(curve)
    runs = find_runs(
        curve.nodes.astype(np.float64),
        edges,
        body.on_curve(bones.weights),
        length,
        relative_turn(bones.transforms),
        shortest=shortest * size,
        angle=np.radians(angle),
        at_most=at_most,
    )
    transforms = bones.transforms[:, runs.bone]
    pull = np.full(len(runs.links), _PULL)
    _, residuals = centres(transforms, runs.links, runs.boundary, pull, reach * size)
    pull = _PULL + (residuals / size / _SOFT) ** 2
    points, residuals = centres(transforms, runs.links, runs.boundary, pull, reach * size)
    share = np.zeros((len(curve.nodes), len(runs.bone)))
    share[np.arange(len(share)), runs.of_node] = length + 1e-12
    bones = Bones(bones.rest, bones.paths, bones.weights[:, runs.bone], transforms, bones.influences)
    areas = np.bincount(runs.of_node[curve.of_vertex], vertex_areas(body.surface), minlength=len(runs.bone))
    costs = np.ones(len(runs.links))
    return Articulation(bones, runs.links, points, residuals / size, costs, _middles(share, curve), areas)


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


def _watch(train: Motion, canonical: Canonical, body: Body, frames: np.ndarray) -> Watched:
    chosen = thin(canonical, body.surface, body.curve, _REFIT_POINTS)
    more = _spread(train.frames, _REFIT_FRAMES)
    rest = canonical.points[chosen].astype(np.float64)
    carry = onto_surface(_sampled(canonical, chosen), body.surface)
    return Watched(chosen, more, rest, train.points[more][:, chosen], train.points[frames][:, chosen], carry)


def _fit_tree(
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
    order, parents, joints = _assemble(found, body)
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


def _chosen(by_motion: Fit, by_curve: Fit, watched: Watched) -> Fit:
    """The curve's own tree, unless the motion's follows the points clearly better."""
    return by_motion if _missed(by_motion, watched) < _MUCH * _missed(by_curve, watched) else by_curve


def _missed(fit: Fit, watched: Watched) -> float:
    """Mean of the summed squared distances of a frame."""
    origin = watched.rest.mean(axis=0)
    moments = skin_moments(watched.rest - origin, fit.weights, watched.paths - origin.astype(np.float32))
    return float(skin_error(moments, posed(fit.parents, fit.joints - origin, moments)).mean())


def _bones(train: Motion, canonical: Canonical, skinning: Skinning, frames, points) -> Bones:
    return Bones(
        canonical.points[points].astype(np.float64),
        train.points[frames][:, points],
        skinning.weights[points],
        skinning.transforms[frames].astype(np.float64),
        _INFLUENCES,
    )


def _pieces(bones: Bones, body: Body) -> np.ndarray:
    """(N,) label of the connected piece of the surface that one bone dominates; every point takes its vertex's."""
    on_surface = body.carry.carry(bones.weights).argmax(axis=1)
    edges = mesh_edges(body.surface.faces)
    inside = on_surface[edges[:, 0]] == on_surface[edges[:, 1]]
    _, piece = connected_components(adjacency(edges[inside], len(on_surface)), directed=False)
    near = cKDTree(body.surface.vertices).query(bones.rest)[1]
    return piece[near]


def _spread(frames: int, most: int) -> np.ndarray:
    return np.unique(np.linspace(0, frames - 1, min(frames, most)).round().astype(np.int64))


def _sampled(canonical: Canonical, chosen: np.ndarray) -> Canonical:
    """The chosen points as bare points; the whole shape where all are chosen."""
    if len(chosen) == len(canonical.points):
        return canonical
    return Canonical(canonical.points[chosen], None, canonical.frame, canonical.source)


def _tree_residuals(found: Articulation) -> np.ndarray:
    """Residuals of the links that the spanning tree keeps."""
    count = len(found.middles)
    if count < 2:
        return np.zeros(1)
    order, parents = kinematic_tree(found.links, found.costs, 0, count)
    at = _link_of(found.links)
    return np.array([found.residuals[at[_pair(order[j], order[parents[j]])]] for j in range(1, count)])


def _assemble(found: Articulation, body: Body) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Order of the bones (J,), parents (J,) and joints (J, 3). The root's joint lies on the curve where the median of
    its children's joints is: a pelvis between its thighs."""
    root = _root(found)
    order, parents = kinematic_tree(found.links, found.costs, root, len(found.middles))
    at = _link_of(found.links)
    joints = np.empty((len(order), 3))
    for j in range(1, len(order)):
        joints[j] = found.points[at[_pair(order[j], order[parents[j]])]]
    children = joints[parents == 0]
    place = np.median(children, axis=0) if len(children) else found.middles[root]
    nodes = body.curve.nodes.astype(np.float64)
    joints[0] = nodes[np.linalg.norm(nodes - place, axis=1).argmin()]
    return order, parents, joints


def _root(found: Articulation) -> int:
    """The bone that turns least in the world, of those in the trunk: several limbs hang on them and they carry much
    skin. That is the pelvis rather than the chest, and never the head."""
    count = len(found.middles)
    order, parents = kinematic_tree(found.links, found.costs, 0, count)
    ends = np.concatenate([order[1:], order[parents[1:]]])
    hub = np.bincount(ends, minlength=count) >= _LIMBS
    areas = np.where(hub, found.areas, 0.0) if hub.any() else found.areas
    trunk = np.flatnonzero(areas >= _TRUNK * areas.max())
    rotations = found.bones.transforms[:, trunk, :, :3]
    turn = geodesic(rotations, project_so3(rotations.mean(axis=0))).mean(axis=0)
    return int(trunk[np.argmin(turn)])


def _pair(a: int, b: int) -> tuple[int, int]:
    return (int(min(a, b)), int(max(a, b)))


def _link_of(links: np.ndarray) -> dict[tuple[int, int], int]:
    return {_pair(a, b): i for i, (a, b) in enumerate(links)}


def _middles(share: np.ndarray, curve: Curve) -> np.ndarray:
    """(B, 3) mean of the curve's nodes under each bone's share (M, B)."""
    return (share.T @ curve.nodes) / share.sum(axis=0)[:, None]
