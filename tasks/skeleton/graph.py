"""From a thin triangle mesh to a graph of curves: edges collapse until no triangle is left."""

from __future__ import annotations

import heapq

import numpy as np

Neighbours = list[dict[int, set[int]]]


def collapse_triangles(position: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Collapses the shortest edge that still has a triangle, again and again (Au et al. 2008, section 5).

    position: (V, 3), faces: (T, 3) -> edges (E, 2) of vertices that are left, into (V,): the vertex each one was
    merged into. Nothing moves. A closed surface of genus 0 ends as a tree: merging two neighbours never opens a loop.
    """
    around = _neighbours(faces, len(position))
    into = np.arange(len(position))
    heap = [(_squared(position, u, v), u, v) for u, near in enumerate(around) for v in near if u < v]
    heapq.heapify(heap)
    while heap:
        _, u, v = heapq.heappop(heap)
        if not around[u].get(v):
            continue
        into[v] = u
        for w in _merge(around, u, v):
            heapq.heappush(heap, (_squared(position, u, w), min(u, w), max(u, w)))
    edges = [(u, v) for u, near in enumerate(around) for v in near if u < v]
    return np.array(edges, np.int64).reshape(-1, 2), resolve(into)


def _neighbours(faces: np.ndarray, count: int) -> Neighbours:
    """For every vertex its neighbours, and for each of these the third corners of the triangles on that edge."""
    around: Neighbours = [{} for _ in range(count)]
    for a, b, c in faces.tolist():
        for u, v, w in ((a, b, c), (b, c, a), (c, a, b)):
            around[u].setdefault(v, set()).add(w)
            around[v].setdefault(u, set()).add(w)
    return around


def _merge(around: Neighbours, u: int, v: int) -> list[int]:
    """Merges v into u; equal edges and equal triangles become one. Returns the neighbours that u got from v."""
    for w in around[u].pop(v):
        around[u][w].discard(v)
        around[w][u].discard(v)
    near = around[v]
    near.pop(u)
    around[v] = {}
    for w, thirds in near.items():
        thirds.discard(u)
        around[w].pop(v)
        around[u].setdefault(w, set()).update(thirds)
        around[w].setdefault(u, set()).update(thirds)
        for x in thirds:
            around[w][x].discard(v)
            around[w][x].add(u)
    return list(near)


def _squared(position: np.ndarray, u: int, v: int) -> float:
    a, b = position[u], position[v]
    return float((a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 + (a[2] - b[2]) ** 2)


def resolve(into: np.ndarray) -> np.ndarray:
    """Follows chains of mergers to their ends. into: (V,) -> (V,)."""
    while True:
        further = into[into]
        if np.array_equal(further, into):
            return into
        into = further


def drop_twigs(
    nodes: np.ndarray, edges: np.ndarray, of_vertex: np.ndarray, least: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Drops branches with a free end that are shorter than `least` at the node they branch from, shortest first.

    nodes: (M, 3); edges: (E, 2), a forest; of_vertex: (V,) node of each vertex; least: (M,) -> the same three; what
    was on a twig goes to the node it branched from.
    """
    near = [set() for _ in range(len(nodes))]
    for u, v in edges.tolist():
        near[u].add(v)
        near[v].add(u)
    into = np.arange(len(nodes))
    while True:
        short = []
        for leaf in range(len(nodes)):
            if len(near[leaf]) == 1:
                twig, length = _walk(nodes, near, leaf)
                if len(near[twig[-1]]) > 2 and length < least[twig[-1]]:
                    short.append((length, twig))
        if not short:
            break
        _, twig = min(short)
        near[twig[-1]].discard(twig[-2])
        for node in twig[:-1]:
            near[node].clear()
            into[node] = twig[-1]
    into = resolve(into)
    kept, node = np.unique(into, return_inverse=True)
    edges = np.array([(u, v) for u, others in enumerate(near) for v in sorted(others) if u < v], np.int64).reshape(
        -1, 2
    )
    return nodes[kept], np.searchsorted(kept, edges), node[of_vertex]


def _walk(nodes: np.ndarray, near: list[set[int]], leaf: int) -> tuple[list[int], float]:
    """From a free end to the first node that is not in the middle of a branch: the way and its length."""
    way, length = [leaf, next(iter(near[leaf]))], 0.0
    while True:
        length += float(np.linalg.norm(nodes[way[-1]] - nodes[way[-2]]))
        if len(near[way[-1]]) != 2:
            return way, length
        way.append(next(iter(near[way[-1]] - {way[-2]})))
