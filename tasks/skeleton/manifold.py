"""Is a triangle mesh the border of a solid?"""

from __future__ import annotations

import numpy as np

from tasks.geometry.neighbours import components, mesh_edges


def is_closed(faces: np.ndarray, count: int) -> bool:
    """True when every directed edge occurs once, its reverse occurs once, and the triangles round every vertex form one
    fan. faces: (T, 3); count: number of vertices. Vertices without triangles make it False."""
    faces = np.asarray(faces, np.int64)
    if len(faces) < 4 or np.any(faces[:, [0, 1, 2]] == faces[:, [1, 2, 0]]):
        return False
    start, end = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    forward, backward = np.sort(start * count + end), np.sort(end * count + start)
    if np.any(forward[1:] == forward[:-1]) or not np.array_equal(forward, backward):
        return False
    return bool(np.array_equal(fans(faces, count), np.ones(count)))


def fans(faces: np.ndarray, count: int) -> np.ndarray:
    """How many separate fans of triangles meet at each vertex: (count,). faces: (T, 3), edges closed."""
    faces = np.asarray(faces, np.int64)
    start, end = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    forward = start * count + end
    order = np.argsort(forward)
    twin = order[np.searchsorted(forward, end * count + start, sorter=order)]
    corner = np.arange(len(start))
    turn = twin[corner - 1 + 3 * (corner % 3 == 0)]  # the next corner round the same vertex
    smallest = corner
    for _ in range(int(np.ceil(np.log2(max(np.bincount(start).max(), 2)))) + 1):  # the smallest corner of each cycle
        smallest, turn = np.minimum(smallest, smallest[turn]), turn[turn]
    return np.bincount(start[smallest == corner], minlength=count)


def components_of(faces: np.ndarray, count: int) -> tuple[int, np.ndarray]:
    """Number of components of the triangles and the (T,) component of each. faces: (T, 3)."""
    _, label = components(mesh_edges(faces), count)
    used, of_face = np.unique(label[faces[:, 0]], return_inverse=True)
    return len(used), of_face
