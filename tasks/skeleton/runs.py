"""The curve cut into runs, each the stretch of one bone: the tree is then the curve's own."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse.csgraph import connected_components

from tasks.geometry.neighbours import adjacency

_SMOOTHING = 3


@dataclass(frozen=True)
class Runs:
    """of_node: (M,) run of every curve node; bone: (R,) bone of every run; links: (L, 2) runs that meet;
    boundary: (L, 3) where."""

    of_node: np.ndarray
    bone: np.ndarray
    links: np.ndarray
    boundary: np.ndarray


def find_runs(
    nodes: np.ndarray,
    edges: np.ndarray,
    weights: np.ndarray,
    lengths: np.ndarray,
    turn: np.ndarray,
    *,
    shortest: float,
    angle: float,
    at_most: int,
) -> Runs:
    """Every node is labelled by its dominant bone; runs shorter than ``shortest`` or turning less than ``angle``
    (radians) against a neighbour are absorbed by the neighbour that moves most like them; where more than ``at_most``
    are left, the shortest go on being absorbed.

    nodes: (M, 3); edges: (E, 2) connected; weights: (M, B); lengths: (M,) length of curve at each node;
    turn: (B, B) angle that two bones turn apart.
    """
    near = adjacency(edges, len(nodes)).astype(np.float64)
    degree = np.asarray(near.sum(axis=1)).ravel()
    for _ in range(_SMOOTHING):
        weights = (weights + near @ weights) / (1.0 + degree)[:, None]
    label = weights.argmax(axis=1)
    while True:
        of_node, bone, links, meet = _cut(edges, label)
        if len(links) == 0:
            break
        size = np.bincount(of_node, weights=lengths, minlength=len(bone))
        apart = turn[bone[links[:, 0]], bone[links[:, 1]]]
        weaker = np.where(size[links[:, 0]] <= size[links[:, 1]], links[:, 0], links[:, 1])
        short = (size[weaker] < shortest) | (len(bone) > at_most)
        absorb = short | (apart < angle)
        if not absorb.any():
            break
        # the shortest first; among its neighbours the one it moves most like
        key = np.where(absorb, np.where(short, size[weaker], apart + size.sum()), np.inf)
        run = weaker[int(np.argmin(key))]
        beside = np.flatnonzero((links == run).any(axis=1))
        best = beside[int(np.argmin(apart[beside]))]
        other = links[best].sum() - run
        label[of_node == run] = bone[other]
    boundary = 0.5 * (nodes[edges[meet, 0]] + nodes[edges[meet, 1]])
    return Runs(of_node, bone, links, boundary)


def _cut(edges: np.ndarray, label: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Runs of one label: (M,) run of each node, (R,) its bone, (L, 2) runs that meet and the edge where they do."""
    inside = label[edges[:, 0]] == label[edges[:, 1]]
    count, run = connected_components(adjacency(edges[inside], len(label)), directed=False)
    bone = np.empty(count, np.int64)
    bone[run] = label
    pairs = np.sort(run[edges[~inside]], axis=1)
    links, first = np.unique(pairs, axis=0, return_index=True)
    return run, bone, links, np.flatnonzero(~inside)[first]
