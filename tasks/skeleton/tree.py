"""From joints on a curve to a kinematic tree (GA 3.2)."""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import breadth_first_order, connected_components, dijkstra, minimum_spanning_tree
from scipy.spatial import cKDTree

from tasks.values import Curve


def lengths(nodes: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """(E,) length of every edge."""
    return np.linalg.norm(nodes[edges[:, 0]].astype(np.float64) - nodes[edges[:, 1]], axis=1)


def graph(edges: np.ndarray, costs: np.ndarray, count: int) -> csr_matrix:
    """Symmetric matrix of edge costs; of edges given twice the cheaper counts; zero costs stay edges."""
    costs = np.maximum(costs, 1e-300)
    low, high = np.minimum(edges[:, 0], edges[:, 1]), np.maximum(edges[:, 0], edges[:, 1])
    order = np.lexsort((costs, high, low))
    low, high, costs = low[order], high[order], costs[order]
    first = np.ones(len(low), bool)
    first[1:] = (low[1:] != low[:-1]) | (high[1:] != high[:-1])
    low, high, costs = low[first], high[first], costs[first]
    rows, columns = np.concatenate([low, high]), np.concatenate([high, low])
    return csr_matrix((np.concatenate([costs, costs]), (rows, columns)), shape=(count, count))


def to_ends(curve: Curve) -> np.ndarray:
    """(M,) way along the curve from every node to the nearest end; infinite where there is none."""
    count = len(curve.nodes)
    ends = np.flatnonzero(np.bincount(curve.edges.ravel(), minlength=count) == 1)
    if len(ends) == 0:
        return np.full(count, np.inf)
    return dijkstra(graph(curve.edges, lengths(curve.nodes, curve.edges), count), indices=ends, min_only=True)


def link_components(nodes: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Edges (E, 2) and, where the graph falls into pieces, the shortest bridges that make it one."""
    while True:
        count, label = connected_components(graph(edges, np.ones(len(edges)), len(nodes)), directed=False)
        if count == 1:
            return edges
        inside, outside = np.flatnonzero(label == 0), np.flatnonzero(label != 0)
        distance, nearest = cKDTree(nodes[inside]).query(nodes[outside])
        best = int(np.argmin(distance))
        edges = np.concatenate([edges, [[inside[nearest[best]], outside[best]]]]).astype(edges.dtype)


def contract(nodes: np.ndarray, edges: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The curve's graph contracted onto some of its nodes: every node falls to the nearest of them along the curve,
    and two of them are linked where their regions touch. nodes: (M, 3), edges: (E, 2) connected, at: (J,) node
    numbers -> links (L, 2) between 0..J-1 and their lengths along the curve (L,).
    """
    size = lengths(nodes, edges)
    distance, _, source = dijkstra(graph(edges, size, len(nodes)), indices=at, min_only=True, return_predecessors=True)
    number = np.full(len(nodes), -1)
    number[at] = np.arange(len(at))
    owner = number[source]
    a, b = owner[edges[:, 0]], owner[edges[:, 1]]
    touching = a != b
    reach = distance[edges[:, 0]] + size + distance[edges[:, 1]]
    return np.stack([a, b], axis=1)[touching], reach[touching]


def kinematic_tree(links: np.ndarray, costs: np.ndarray, root: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Spanning tree of least cost (it matters where the curve has loops), directed away from the root.

    links: (L, 2) connect 0..count-1; costs: (L,) -> order (J,): old number of each joint, the root first and every
    parent before its children; parents (J,) int32 in the new numbering.
    """
    tree = minimum_spanning_tree(graph(links, costs, count)) if count > 1 else csr_matrix((1, 1))
    order, above = breadth_first_order(tree, root, directed=False)
    new = np.empty(count, np.int64)
    new[order] = np.arange(count)
    parents = np.array([-1 if old == root else new[above[old]] for old in order], np.int32)
    return order, parents


def joint_names(count: int) -> tuple[str, ...]:
    """Neutral names: nothing is known about the body."""
    return tuple(f"joint_{j:02d}" for j in range(count))
