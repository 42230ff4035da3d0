"""Which bones hang on which, and the joints between them: by their motion or by the curve's own tree."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tasks.geometry.moments import skin_error, skin_moments
from tasks.geometry.rotations import geodesic, project_so3
from tasks.skeleton.articulation import centres
from tasks.skeleton.body import Body
from tasks.skeleton.curve_weights import node_lengths, vertex_areas
from tasks.skeleton.inner_bones import Bones, relative_turn
from tasks.skeleton.refit import posed
from tasks.skeleton.runs import find_runs
from tasks.skeleton.tree import kinematic_tree, link_components
from tasks.values import Curve

_PULL = 0.001
_FOCUS = 4.0  # power of w_a w_b: traces of both far away must not draw their joint from where they meet
_SOFT = 0.03  # of the diagonal: a joint with this residual stays about where the curve puts it
_CLEARLY = 0.9  # of the squared error: one spanning tree for another
_LIMBS, _TRUNK = 3, 0.3  # the root has at least so many bones round it, and this part of the largest such bone's skin


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
    order, parents, joints = assemble(found, body)
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


def tree_residuals(found: Articulation) -> np.ndarray:
    """Residuals of the links that the spanning tree keeps."""
    count = len(found.middles)
    if count < 2:
        return np.zeros(1)
    order, parents = kinematic_tree(found.links, found.costs, 0, count)
    at = _link_of(found.links)
    return np.array([found.residuals[at[_pair(order[j], order[parents[j]])]] for j in range(1, count)])


def assemble(found: Articulation, body: Body) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Order of the bones (J,), parents (J,) and joints (J, 3). The root's joint lies on the curve where the median of
    its children's joints is: a pelvis between its thighs."""
    root = root_of(found)
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


def root_of(found: Articulation) -> int:
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
