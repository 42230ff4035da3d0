"""Neighbour graphs over mesh edges or, for bare points, over the nearest points."""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree


def mesh_edges(faces: np.ndarray) -> np.ndarray:
    """Undirected edges of triangles, each once. faces: (T, 3) -> (E, 2), smaller index first."""
    pairs = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    return _each_once(pairs)


def nearest_edges(points: np.ndarray, k: int) -> np.ndarray:
    """Undirected edges to the k nearest other points, each once. points: (N, 3) -> (E, 2)."""
    k = min(k, len(points) - 1)
    _, near = cKDTree(points).query(points, k=k + 1)
    pairs = np.stack([np.repeat(near[:, 0], k), near[:, 1:].ravel()], axis=1)
    pairs = pairs[pairs[:, 0] != pairs[:, 1]]
    return _each_once(pairs)


def adjacency(edges: np.ndarray, count: int) -> csr_matrix:
    """Symmetric 0/1 matrix (count, count) of undirected edges."""
    data = np.ones(2 * len(edges), np.float32)
    rows = np.concatenate([edges[:, 0], edges[:, 1]])
    columns = np.concatenate([edges[:, 1], edges[:, 0]])
    matrix = csr_matrix((data, (rows, columns)), shape=(count, count))
    matrix.data[:] = 1.0
    return matrix


def components(edges: np.ndarray, count: int) -> tuple[int, np.ndarray]:
    """Number of connected components and (count,) labels."""
    return connected_components(adjacency(edges, count), directed=False)


def _each_once(pairs: np.ndarray) -> np.ndarray:
    """Distinct undirected pairs in order, smaller index first; one integer for a pair sorts much faster than two."""
    low, high = pairs.min(1).astype(np.int64), pairs.max(1).astype(np.int64)
    size = int(high.max()) + 1 if len(high) else 1
    key = np.unique(low * size + high)
    return np.stack([key // size, key % size], axis=1).astype(pairs.dtype)
