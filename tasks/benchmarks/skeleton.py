"""Our curve skeleton against CGAL's, side by side in one process on the same closed surface.

A judge that stands above the stages: unlike a stage it may import several of them.
"""

from __future__ import annotations

from typing import Annotated

import igl
import numpy as np
from scipy.spatial import cKDTree

from tasks.benchmarks import cgal
from tasks.benchmarks.cost import in_turn, numbers, threads_held
from tasks.evaluation.metrics import declared
from tasks.geometry.neighbours import components
from tasks.skeleton import graph
from tasks.skeleton.curve import curve_skeleton
from tasks.values import Curve, Metrics, Surface


def benchmark_skeleton(
    surface: Surface, *, tracing: dict, repeats: Annotated[int, "[1, inf)"], threads: Annotated[int, "[0, inf)"]
) -> Metrics:
    """Both skeletons in turn; ratios are ours / the peer's.

    tracing: the settings of :func:`curve_skeleton`; repeats: runs whose median is taken, after one that only warms up;
    threads: 0 for all cores. Leaves have one edge, junctions three or more; inside is the share of nodes with a winding
    number above a half; mapped is the share of the surface's vertices that belong to exactly one node; limbs are
    the peer's leaves once its short branches are dropped by the rule that ours follow (``twig``). Raises
    InputError where the extra is missing.
    """
    count = len(surface.vertices)
    peer = cgal.prepare(surface)

    def ours() -> Curve:
        return curve_skeleton(surface, **tracing)

    with threads_held(threads):
        ours()
        (curve, mine), (found, theirs) = in_turn(lambda: ours, lambda: peer, (repeats, repeats))
    mapped = (curve.of_vertex >= 0) & (curve.of_vertex < len(curve.nodes))  # one node each, by its shape
    shape = counts(curve.nodes, curve.edges, mapped.astype(int), surface)
    nodes, edges, times = cgal.graph(*found, count)
    shape |= {f"peer_{name}": value for name, value in counts(nodes, edges, times, surface).items()}
    shape["peer_curve_limbs"] = float(limbs(nodes, edges, surface, tracing["twig"]))
    return declared(numbers(mine, theirs) | shape, "unit")


def limbs(nodes: np.ndarray, edges: np.ndarray, surface: Surface, twig: float) -> int:
    """Leaves that are left without the branches shorter than `twig` inner radii of the body where they begin."""
    radius = cKDTree(surface.vertices.astype(np.float64)).query(nodes)[0]
    edges = graph.drop_twigs(nodes, edges, np.zeros(0, int), twig * radius)[1]
    return int(np.sum(np.bincount(edges.ravel()) == 1))


def counts(nodes: np.ndarray, edges: np.ndarray, times: np.ndarray, surface: Surface) -> dict[str, float]:
    """What a skeleton looks like. nodes: (M, 3); edges: (E, 2); times: (V,) nodes that each vertex is mapped to."""
    degree = np.bincount(edges.ravel(), minlength=len(nodes))
    trees = components(edges, len(nodes))[0]
    winding = igl.fast_winding_number(
        surface.vertices.astype(np.float64), surface.faces.astype(np.int64), nodes.astype(np.float64)
    )
    return {
        "curve_leaves": float(np.sum(degree == 1)),
        "curve_junctions": float(np.sum(degree >= 3)),
        "curve_cycles": float(len(edges) - len(nodes) + trees),
        "curve_inside_pct": 100.0 * float(np.mean(winding > 0.5)),
        "curve_mapped_pct": 100.0 * float(np.mean(times == 1)),
    }
