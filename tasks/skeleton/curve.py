"""Curve skeleton of a closed surface by mean curvature flow."""

from __future__ import annotations

from typing import Annotated

import igl
import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import minimum_spanning_tree
from scipy.spatial import cKDTree

from tasks.errors import InputError
from tasks.geometry.measure import diagonal
from tasks.skeleton import flow, graph, halfedge
from tasks.skeleton.manifold import is_closed
from tasks.values import Curve, Surface


def curve_skeleton(
    surface: Surface,
    *,
    speed: Annotated[float, "[1e-4, 100]"],
    medial: Annotated[float, "[0, 100]"],
    edge: Annotated[float, "[1e-4, 0.1]"],
    angle: Annotated[float, "[60, 180]"],
    stop: Annotated[float, "[0, 1]"],
    rounds: Annotated[int, "[1, 10000]"],
    twig: Annotated[float, "[0, 100]"],
) -> Curve:
    """Mean curvature skeleton (Tagliasacchi et al. 2012) with the map from the surface to its curve.

    speed: w_H, how strongly a step holds its start (small is fast); medial: w_M, pull towards the medial axis; both
    against 1 for the curvature; edge: shortest edge while flowing, as a fraction of the bounding-box diagonal; angle:
    triangles wider than this (degrees) are split; stop: area lost in a round, as a fraction of the first, under which
    the flow ends; rounds: at most so many; twig: a branch that ends free is dropped when it is shorter than `twig`
    times the body's inner radius where it branches off. A body with handles gives a curve with loops: each is cut at
    its longest edge, so that the curve is a forest, one tree for each component of the surface.

    Raises InputError for a surface that is not closed.
    """
    _check(surface)
    vertices, faces = surface.vertices.astype(np.float64), surface.faces.astype(np.int64)
    poles = flow.medial_poles(vertices, faces)
    length = edge * diagonal(vertices)
    mesh, into = flow.contract(
        vertices, faces, poles, speed=speed, medial=medial, edge=length, angle=angle, stop=stop, rounds=rounds
    )
    nodes, edges, of_vertex = _thin_to_graph(mesh, graph.resolve(into)[: len(vertices)])
    edges = _cut_loops(nodes, edges)
    radius = cKDTree(vertices).query(nodes)[0]
    nodes, edges, of_vertex = graph.drop_twigs(nodes, edges, of_vertex, twig * radius)
    nodes = _bring_in(nodes, vertices, faces, poles)
    of_vertex = of_vertex.astype(np.int32)
    return Curve(nodes.astype(np.float32), edges.astype(np.int32), of_vertex, of_vertex[surface.of_point])


def _bring_in(nodes: np.ndarray, vertices: np.ndarray, faces: np.ndarray, poles: np.ndarray) -> np.ndarray:
    """Nodes that the flow left outside, where thin parts bend, go to the nearest pole inside."""
    poles = poles[np.isfinite(poles[:, 0])]
    poles = poles[igl.fast_winding_number(vertices, faces, poles) > 0.5]
    outside = igl.fast_winding_number(vertices, faces, nodes) <= 0.5
    if outside.any() and len(poles):
        nodes = nodes.copy()
        nodes[outside] = poles[cKDTree(poles).query(nodes[outside])[1]]
    return nodes


def _thin_to_graph(mesh: halfedge.Mesh, into: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Nodes at the mean of the vertices that ended there, their edges, and the node of each vertex of the surface."""
    left = np.flatnonzero(mesh.first >= 0)
    number = np.full(len(mesh.first), -1)
    number[left] = np.arange(len(left))
    position = mesh.position[left]
    edges, ends = graph.collapse_triangles(position, number[halfedge.faces_of(mesh)])
    kept, node = np.unique(ends, return_inverse=True)
    count = np.bincount(node)
    nodes = np.stack([np.bincount(node, position[:, x]) / count for x in range(3)], axis=1)
    return nodes, np.searchsorted(kept, edges), node[number[into]]


def _cut_loops(nodes: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """The spanning forest of least length."""
    length = np.linalg.norm(nodes[edges[:, 0]] - nodes[edges[:, 1]], axis=1)
    rank = np.argsort(np.argsort(length, kind="stable")) + 1.0  # lengths may be zero, which a sparse matrix drops
    tree = minimum_spanning_tree(coo_matrix((rank, (edges[:, 0], edges[:, 1])), shape=(len(nodes), len(nodes))))
    return np.sort(np.stack(tree.nonzero(), axis=1), axis=1)


def _check(surface: Surface) -> None:
    if not is_closed(surface.faces, len(surface.vertices)):
        raise InputError(
            "Surface.faces",
            expected="a closed surface: every edge between two triangles turned the same way",
            found=f"{len(surface.faces)} triangles that do not close",
            do="make it with closed_surface",
        )
