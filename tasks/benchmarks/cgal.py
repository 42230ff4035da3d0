"""CGAL's mean curvature flow skeletonisation over compas_cgal: the peer of our curve skeleton.

Under the GPL and an extra that only benchmarks need, so it is imported where it is used.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from tasks.errors import InputError
from tasks.values import Surface


def prepare(surface: Surface) -> Callable[[], tuple]:
    """The peer ready to run: a function that computes its segments and the vertices mapped to their ends.

    Raises InputError where the extra is missing.
    """
    trace = _library()
    mesh = surface.vertices.astype(np.float64), surface.faces.astype(np.int32)
    return lambda: trace(mesh)


def _library() -> Callable[[tuple], tuple]:
    try:
        from compas_cgal.skeletonization import mesh_skeleton_with_mapping
    except ImportError:
        do = 'pip install -e ".[bench]"'
        raise InputError("benchmark", expected="the package compas_cgal", found="none", do=do) from None
    return mesh_skeleton_with_mapping


def graph(segments: list, mapped: list, vertices: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Nodes (M, 3), edges (E, 2) and (vertices,) how many nodes each vertex of the surface is mapped to.

    The peer returns segments without numbers for their ends: equal coordinates are one node.
    """
    ends = np.array(segments, np.float64).reshape(-1, 3)
    nodes, first, number = np.unique(ends, axis=0, return_index=True, return_inverse=True)
    lists = [part for pair in mapped for part in pair]
    times = np.zeros(vertices, np.int64)
    for end in first:  # the list of a node stands at each of its ends
        times[np.asarray(lists[end], np.int64)] += 1
    return nodes, number.reshape(-1, 2), times
