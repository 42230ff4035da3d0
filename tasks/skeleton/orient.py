"""Bare points as little discs that face outwards."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree
from scipy.spatial import cKDTree

_ROUNDS = 10


def discs(points: np.ndarray, neighbours: int) -> tuple[np.ndarray, np.ndarray]:
    """One triangle for each point, as large as the point's share of the surface and facing outwards.

    points: (N, 3) -> vertices (3N, 3), faces (N, 3): a soup whose winding number is that of oriented points
    (Barill et al. 2018).
    """
    distance, near = cKDTree(points).query(points, k=min(neighbours, len(points) - 1) + 1)
    normal = outward_normals(points, near)
    area = np.pi * distance[:, -1] ** 2 / near.shape[1]
    side = np.sqrt(4.0 * area / np.sqrt(3.0))
    across = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal), axis=1)])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    up = np.cross(normal, across)
    corners = np.stack(
        [across * np.cos(t) + up * np.sin(t) for t in (0.0, 2.0 * np.pi / 3.0, 4.0 * np.pi / 3.0)], axis=1
    )
    vertices = points[:, None] + corners * (side / np.sqrt(3.0))[:, None, None]
    return vertices.reshape(-1, 3), np.arange(3 * len(points)).reshape(-1, 3)


def outward_normals(points: np.ndarray, near: np.ndarray) -> np.ndarray:
    """Unit normals, turned alike along a spanning tree of the neighbour graph (Hoppe et al. 1992) and then outwards.

    points: (N, 3); near: (N, k) neighbours, the point itself first -> (N, 3).
    """
    offset = points[near] - points[near].mean(axis=1, keepdims=True)
    _, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", offset, offset))
    normal = axes[:, :, 0]
    rows, columns = np.repeat(near[:, 0], near.shape[1] - 1), near[:, 1:].ravel()
    bend = 1.0 - np.abs(np.einsum("ni,ni->n", normal[rows], normal[columns])) + 1e-6
    graph = coo_matrix((bend, (rows, columns)), shape=(len(points), len(points))).tocsr()
    graph = graph.maximum(graph.T)
    number, label = connected_components(graph, directed=False)
    tree = minimum_spanning_tree(graph)
    tree = tree + tree.T
    for part in range(number):
        members = np.flatnonzero(label == part)
        top = members[np.argmax(points[members, 1])]  # the highest point's normal must look up
        if normal[top, 1] < 0:
            normal[top] *= -1
        order, parent = breadth_first_order(tree, top, directed=False)
        for child in order[1:].tolist():
            if normal[child] @ normal[parent[child]] < 0:
                normal[child] *= -1
    return normal
