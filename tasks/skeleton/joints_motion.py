"""Joints from how the bones move: the centres about which neighbouring bones turn, guided by the curve skeleton."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import igl
import numpy as np

from tasks.errors import InputError
from tasks.geometry.measure import diagonal
from tasks.skeleton.articulation import centres
from tasks.skeleton.curve_weights import Interpolation, node_lengths, node_weights, onto_surface
from tasks.skeleton.inner_bones import Bones, inner_bones, relative_turn
from tasks.skeleton.refit import refit
from tasks.skeleton.runs import find_runs
from tasks.skeleton.tree import joint_names, kinematic_tree, link_components
from tasks.values import Canonical, Curve, Motion, Skeleton, Skinning, Surface

_PULL = 0.003
_SOFT = 0.03  # of the diagonal: a joint with this residual stays about where the curve puts it
_FRAMES = 200  # frames that the tree is found from; the refit sees all


@dataclass(frozen=True)
class Articulation:
    """Bones and the places where they meet. bones: on the surface; links: (L, 2) bone numbers; points: (L, 3) their
    joints; residuals: (L,) gap between both bones' idea of the joint, in units of the diagonal; costs: (L,) for the
    spanning tree; middles: (B, 3) each bone's centre on the curve."""

    bones: Bones
    links: np.ndarray
    points: np.ndarray
    residuals: np.ndarray
    costs: np.ndarray
    middles: np.ndarray


def joints_by_motion(
    train: Motion,
    canonical: Canonical,
    skinning: Skinning,
    surface: Surface,
    curve: Curve,
    *,
    max_joints: int,
    topology: Literal["auto", "motion", "curve"],
    rigid_residual: float,
    angle: float,
    least: float,
    shortest: float,
    reach: float,
    rounds: int,
    refits: int,
    influences: int,
) -> Skeleton:
    """Inner bones (:mod:`inner_bones`), joints where two of them carry the same point along (:mod:`articulation`), a
    tree over them, then weights and joints refitted to the motion (:mod:`refit`). One joint a bone: a joint owns the
    points that its bone moves; there are no end effectors.

    topology: ``motion`` takes the spanning tree of least joint gap, which is right for articulated bodies; ``curve``
    keeps the curve's own tree, which does not tangle under cloth and soft tissue; ``auto`` takes the first where its
    median gap is under ``rigid_residual`` (share of the diagonal). angle: degrees below which two bones are one;
    least: share of the surface below which a bone is dust; shortest: run of curve below which a bone is dropped
    (curve topology), reach: how far a joint may lie from the place on the curve where its bones meet, both as shares
    of the diagonal; rounds: rounds of SSDR on the inner bones; refits: rounds of refitting; influences: most joints
    a point may follow. Lengths are shares of the bounding-box diagonal. Raises InputError for settings out of range.
    """
    _check_settings(max_joints, influences, angle)
    size = diagonal(canonical.points)
    bones = _bones_on_surface(train, skinning, onto_surface(canonical, surface), canonical, influences)
    bones = inner_bones(bones, surface, curve, least=least, rounds=rounds, angle=angle, at_most=max_joints)
    found = by_motion(bones, curve, size, reach)
    if topology == "curve" or (topology == "auto" and np.median(_tree_residuals(found)) > rigid_residual):
        found = by_curve(bones, curve, size, reach, shortest=shortest, angle=angle, rounds=rounds)
    parents, joints, weights = _assemble(found, canonical, surface, curve)
    joints, weights = refit(
        train.points,
        canonical.points,
        parents,
        joints,
        weights,
        rounds=refits,
        influences=influences,
        reach=reach * size,
    )
    joints = keep_inside(joints, surface, curve)
    return Skeleton(joint_names(len(joints)), parents, joints.astype(np.float32), weights)


def by_motion(bones: Bones, curve: Curve, size: float, reach: float) -> Articulation:
    """Every pair of bones that shares some curve is a candidate; a gap, a joint far from the shared curve and a small
    share all make it dear."""
    on_curve, length = node_weights(curve, bones.weights), node_lengths(curve)
    edges = link_components(curve.nodes, curve.edges)
    label = on_curve.argmax(axis=1)
    shared = on_curve.T @ (on_curve * length[:, None])
    candidates = shared > 1e-3 * length.mean()
    meet = label[edges]
    candidates[meet[:, 0], meet[:, 1]] = candidates[meet[:, 1], meet[:, 0]] = True  # so that the graph is connected
    pairs = np.argwhere(np.triu(candidates, 1))
    share = on_curve[:, pairs[:, 0]] * on_curve[:, pairs[:, 1]] * length[:, None] + 1e-12
    guess = (share.T @ curve.nodes) / share.sum(axis=0)[:, None]
    points, residuals = centres(bones.transforms, pairs, guess, np.full(len(pairs), _PULL), reach * size)
    away = np.linalg.norm(points - guess, axis=1)
    common = np.maximum(shared[pairs[:, 0], pairs[:, 1]], 1e-6 * length.mean())
    costs = (residuals / size + 0.3 * away / size + 0.001) / np.sqrt(common)
    return Articulation(bones, pairs, points, residuals / size, costs, _middles(on_curve * length[:, None], curve))


def by_curve(
    bones: Bones, curve: Curve, size: float, reach: float, *, shortest: float, angle: float, rounds: int
) -> Articulation:
    """The curve's own tree: a bone for every run of nodes that one bone dominates, a joint where two runs meet."""
    edges, length = link_components(curve.nodes, curve.edges), node_lengths(curve)
    runs = find_runs(
        curve.nodes.astype(np.float64),
        edges,
        node_weights(curve, bones.weights),
        length,
        relative_turn(bones.transforms),
        shortest=shortest * size,
        angle=np.radians(angle),
    )
    member = np.zeros((len(bones.rest), len(runs.bone)), np.float32)
    member[np.arange(len(member)), runs.of_node[curve.of_vertex]] = 1.0
    transforms = bones.transforms[:, runs.bone]
    bones = Bones(bones.rest, bones.paths, member, transforms, bones.influences)
    pull = np.full(len(runs.links), _PULL)
    _, residuals = centres(transforms, runs.links, runs.boundary, pull, reach * size)
    pull = _PULL + (residuals / size / _SOFT) ** 2
    points, residuals = centres(transforms, runs.links, runs.boundary, pull, reach * size)
    share = np.zeros((len(curve.nodes), len(runs.bone)))
    share[np.arange(len(share)), runs.of_node] = length + 1e-12
    costs = np.ones(len(runs.links))
    return Articulation(bones, runs.links, points, residuals / size, costs, _middles(share, curve))


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


def _bones_on_surface(
    train: Motion, skinning: Skinning, carry: Interpolation, canonical: Canonical, influences: int
) -> Bones:
    chosen = np.unique(np.linspace(0, train.frames - 1, min(train.frames, _FRAMES)).round().astype(np.int64))
    return Bones(
        carry.carry(canonical.points),
        carry.carry_paths(train.points[chosen]),
        carry.carry(skinning.weights).astype(np.float32),
        skinning.transforms[chosen].astype(np.float64),
        influences,
    )


def _tree_residuals(found: Articulation) -> np.ndarray:
    """Residuals of the links that the spanning tree keeps."""
    count = len(found.middles)
    if count < 2:
        return np.zeros(1)
    order, parents = kinematic_tree(found.links, found.costs, 0, count)
    at = _link_of(found.links)
    return np.array([found.residuals[at[_pair(order[j], order[parents[j]])]] for j in range(1, count)])


def _assemble(
    found: Articulation, canonical: Canonical, surface: Surface, curve: Curve
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Parents (J,), joints (J, 3) and the points' weights (N, J). The root is the bone nearest the centroid; its joint
    lies on the curve, in the bone's middle."""
    centroid = canonical.points.mean(axis=0, dtype=np.float64)
    root = int(np.argmin(np.linalg.norm(found.middles - centroid, axis=1)))
    order, parents = kinematic_tree(found.links, found.costs, root, len(found.middles))
    at = _link_of(found.links)
    joints = np.empty((len(order), 3))
    nodes = curve.nodes.astype(np.float64)
    joints[0] = nodes[np.linalg.norm(nodes - found.middles[root], axis=1).argmin()]
    for j in range(1, len(order)):
        joints[j] = found.points[at[_pair(order[j], order[parents[j]])]]
    weights = found.bones.weights[:, order][surface.of_point]
    return parents, joints, np.ascontiguousarray(weights)


def _pair(a: int, b: int) -> tuple[int, int]:
    return (int(min(a, b)), int(max(a, b)))


def _link_of(links: np.ndarray) -> dict[tuple[int, int], int]:
    return {_pair(a, b): i for i, (a, b) in enumerate(links)}


def _middles(share: np.ndarray, curve: Curve) -> np.ndarray:
    """(B, 3) mean of the curve's nodes under each bone's share (M, B)."""
    return (share.T @ curve.nodes) / share.sum(axis=0)[:, None]


def _check_settings(max_joints: int, influences: int, angle: float) -> None:
    for name, value, low, high in (
        ("max_joints", max_joints, 1, 500),
        ("influences", influences, 1, 16),
        ("angle", angle, 0.0, 90.0),
    ):
        if not low <= value <= high:
            raise InputError(f"skeleton.motion.{name}", expected=f"{low} to {high}", found=str(value))
