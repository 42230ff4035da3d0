"""Small repairs that close a mesh without touching the rest of it."""

from __future__ import annotations

import igl
import numpy as np

from tasks.skeleton.manifold import corner_fans, duplicated, open_edges

_ROUNDS = 20


def mend(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Welds equal vertices, drops triangles that make the mesh non-manifold and caps every hole with a fan.

    vertices: (V, 3), faces: (T, 3) -> the same for the mended mesh, which is closed but may have several components
    and may have lost triangles: the caller judges whether too many.
    """
    vertices, same = np.unique(vertices, axis=0, return_inverse=True)
    faces = same.ravel()[faces]
    faces = faces[np.all(faces != np.roll(faces, 1, axis=1), axis=1)]
    _, single = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    faces = faces[np.sort(single)]
    if len(faces) and duplicated(faces, len(vertices)).any():
        faces = igl.bfs_orient(faces)[0]
    for _ in range(_ROUNDS):
        bad = duplicated(faces, len(vertices))
        if not bad.any():
            bad = _loose(faces, len(vertices))
        if not bad.any():
            break
        faces = faces[~bad]
    vertices, faces = _cap(vertices, faces)
    used, faces = np.unique(faces, return_inverse=True)
    return vertices[used], faces.reshape(-1, 3)


def _loose(faces: np.ndarray, count: int) -> np.ndarray:
    """(T,) triangles at vertices where several fans meet, but for the largest fan there."""
    fan = corner_fans(faces, count)
    size = np.bincount(fan)[fan]
    corner = faces.ravel()
    order = np.lexsort((fan, -size, corner))
    chosen = np.full(count, -1)
    first = order[np.insert(np.diff(corner[order]) > 0, 0, True)] if len(order) else order
    chosen[corner[first]] = fan[first]
    return np.any((fan != chosen[corner]).reshape(-1, 3), axis=1)


def _cap(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fills every boundary loop with triangles to its middle."""
    start, end = open_edges(faces, len(vertices))
    following = dict(zip(start.tolist(), end.tolist(), strict=True))
    middles, caps = [], []
    while following:
        at = min(following)
        loop = []
        while at in following:
            loop.append(at)
            at = following.pop(at)
        middle = len(vertices) + len(middles)
        middles.append(vertices[loop].mean(axis=0))
        caps += [(b, a, middle) for a, b in zip(loop, loop[1:] + loop[:1], strict=True)]
    if not caps:
        return vertices, faces
    return np.concatenate([vertices, middles]), np.concatenate([faces, np.array(caps, faces.dtype)])
