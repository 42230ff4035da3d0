"""Joints where the skin weights change fastest along the curve: the paper's way (GA eq. 5)."""

from __future__ import annotations

from itertools import pairwise
from typing import Annotated

import numpy as np

from tasks.geometry.measure import diagonal
from tasks.skeleton.curve_weights import node_weights, onto_surface
from tasks.skeleton.refit import refit
from tasks.skeleton.resample import Branch, resample
from tasks.skeleton.tree import contract, joint_names, kinematic_tree, lengths, link_components
from tasks.values import Canonical, Curve, Motion, Skeleton, Skinning, Surface


def joints_by_gradient(
    train: Motion,
    canonical: Canonical,
    skinning: Skinning,
    surface: Surface,
    curve: Curve,
    *,
    tau: Annotated[float, "(0, 1)"],
    spacing: Annotated[float, "(0, 0.2)"],
    refits: Annotated[int, "[0, inf)"],
    influences: Annotated[int, "[1, inf)"],
) -> Skeleton:
    """GA eq. 5: g(s) = 1/2 |W(s + h) - W(s - h)|_1 along every branch of the evenly resampled curve; a joint is a
    local maximum of g above ``tau``, and every junction and leaf. The tree is the curve's own, contracted onto the
    joints; the root is the joint nearest the centroid. A leaf is an end effector: it owns no points.

    The paper says nothing of the skeleton's own skin weights: every point starts with the joint above it on the curve,
    then ``refits`` rounds fit weights of at most ``influences`` joints to the motion; the joints stay where they are.
    tau: 0..1 (g has no unit); spacing: h as a share of the bounding-box diagonal.
    """
    size = diagonal(canonical.points)
    weights = node_weights(curve, onto_surface(canonical, surface).carry(skinning.weights))
    branches = resample(curve.nodes, curve.edges, weights, spacing * size)
    nodes, edges, at = _join(branches, [maxima(transition(b.weights), tau) for b in branches])
    if len(nodes) == 0:  # the curve of a ball is one point
        nodes, at = curve.nodes[:1].astype(np.float64), np.zeros(1, np.int64)
    edges = link_components(nodes, edges)
    links, costs = contract(nodes, edges, at)
    centroid = canonical.points.mean(axis=0, dtype=np.float64)
    root = int(np.argmin(np.linalg.norm(nodes[at] - centroid, axis=1)))
    order, parents = kinematic_tree(links, costs, root, len(at))
    at = at[order]
    owner = owners(nodes, edges, at, parents)
    nearest = np.linalg.norm(curve.nodes[curve.of_point][:, None] - nodes[None], axis=-1).argmin(axis=1)
    start = np.zeros((len(canonical.points), len(at)), np.float32)
    start[np.arange(len(start)), owner[nearest]] = 1.0
    joints, start = refit(
        train.points,
        canonical.points,
        parents,
        nodes[at],
        start,
        rounds=refits,
        influences=influences,
        reach=0.0,
        hold=0.0,
    )
    return Skeleton(joint_names(len(at)), parents, joints.astype(np.float32), start)


def transition(weights: np.ndarray) -> np.ndarray:
    """g of GA eq. 5 at every sample of a branch, in 0..1. weights: (S, B) -> (S,); nought at both ends."""
    g = np.zeros(len(weights))
    g[1:-1] = 0.5 * np.abs(weights[2:] - weights[:-2]).sum(axis=1)
    return g


def maxima(g: np.ndarray, tau: float) -> np.ndarray:
    """Samples above tau that are no smaller than their neighbours; of a plateau its middle. g: (S,) -> numbers."""
    found, s = [], 1
    while s < len(g) - 1:
        stop = s
        while stop + 1 < len(g) and g[stop + 1] == g[s]:
            stop += 1
        if g[s] > tau and g[s - 1] < g[s] and (stop + 1 == len(g) or g[stop + 1] < g[s]):
            found.append((s + stop) // 2)
        s = stop + 1
    return np.array(found, np.int64)


def owners(nodes: np.ndarray, edges: np.ndarray, at: np.ndarray, parents: np.ndarray) -> np.ndarray:
    """(M,) the joint that moves each node of the curve: the last one on the way from the root to it; a leaf, where
    the way ends, belongs to its parent."""
    order, above = kinematic_tree(edges, lengths(nodes, edges), int(at[0]), len(nodes))
    joint_at = np.full(len(nodes), -1)
    joint_at[at] = np.arange(len(at))
    has_child = np.bincount(parents[1:], minlength=len(parents)) > 0
    owner = np.empty(len(nodes), np.int64)
    owner_new = np.empty(len(nodes), np.int64)
    for new, old in enumerate(order):
        j = joint_at[old]
        owner_new[new] = j if j >= 0 and (has_child[j] or new == 0) else owner_new[above[new]]
    owner[order] = owner_new
    return owner


def _join(branches: list[Branch], peaks: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The resampled branches as one graph: nodes (M, 3), edges (E, 2), and the nodes that are joints (J,)."""
    number: dict[int, int] = {}
    points: list[np.ndarray] = []
    edges: list[tuple[int, int]] = []
    joints: set[int] = set()
    for branch, found in zip(branches, peaks, strict=True):
        here = []
        for s, point in enumerate(branch.points):
            end = branch.ends[0] if s == 0 else branch.ends[1] if s == len(branch.points) - 1 else None
            if end is not None and end in number:
                here.append(number[end])
                continue
            if end is not None:
                number[end] = len(points)
                joints.add(len(points))
            here.append(len(points))
            points.append(point)
        edges += pairwise(here)
        joints |= {here[s] for s in found}
    return np.array(points), np.array(edges, np.int64).reshape(-1, 2), np.array(sorted(joints), np.int64)
