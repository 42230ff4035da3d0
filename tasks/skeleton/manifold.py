"""Is a triangle mesh the border of a solid, and if not, where does it fail?"""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from tasks.geometry.neighbours import components, mesh_edges


def is_closed(faces: np.ndarray, count: int) -> bool:
    """True when every directed edge occurs once, so does its reverse, and the triangles round every vertex form one
    fan. faces: (T, 3); count: number of vertices. A vertex without triangles makes it False."""
    faces = np.asarray(faces, np.int64)
    if len(faces) < 4 or np.any(faces == np.roll(faces, 1, axis=1)) or duplicated(faces, count).any():
        return False
    if len(open_edges(faces, count)[0]):
        return False
    return int(corner_fans(faces, count).max()) + 1 == count and len(np.unique(faces)) == count


def duplicated(faces: np.ndarray, count: int) -> np.ndarray:
    """(T,) True for triangles with a directed edge that another triangle has too. faces: (T, 3)."""
    edge = _directed(faces, count)
    _, which, times = np.unique(edge, return_inverse=True, return_counts=True)
    return np.any((times[which] > 1).reshape(-1, 3), axis=1)


def open_edges(faces: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Start and end (E,) of directed edges without a triangle on their other side. faces: (T, 3)."""
    start, end = faces.ravel().astype(np.int64), np.roll(faces, -1, axis=1).ravel().astype(np.int64)
    alone = ~np.isin(start * count + end, end * count + start)
    return start[alone], end[alone]


def corner_fans(faces: np.ndarray, count: int) -> np.ndarray:
    """(3T,) number of the fan each corner belongs to: triangles that meet at a vertex and hang together over edges.

    faces: (T, 3) without duplicated directed edges.
    """
    forward = _directed(faces, count)
    corner = np.arange(len(forward))
    backward = np.roll(faces, -1, axis=1).ravel().astype(np.int64) * count + faces.ravel()
    order = np.argsort(forward)
    place = np.minimum(np.searchsorted(forward, backward, sorter=order), len(order) - 1)
    twin = order[place]
    met = forward[twin] == backward
    corner, twin = corner[met], twin[met]
    neighbour = np.where(twin % 3 == 2, twin - 2, twin + 1)  # starts where `corner` starts, in the next triangle
    size = len(forward)
    links = coo_matrix((np.ones(len(corner), np.int8), (corner, neighbour)), shape=(size, size))
    return connected_components(links, directed=False)[1]


def components_of(faces: np.ndarray, count: int) -> tuple[int, np.ndarray]:
    """Number of components of the triangles and the (T,) component of each. faces: (T, 3)."""
    _, label = components(mesh_edges(faces), count)
    used, of_face = np.unique(label[faces[:, 0]], return_inverse=True)
    return len(used), of_face


def _directed(faces: np.ndarray, count: int) -> np.ndarray:
    return faces.ravel().astype(np.int64) * count + np.roll(faces, -1, axis=1).ravel()
