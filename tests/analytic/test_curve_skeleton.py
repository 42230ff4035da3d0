"""Curve skeletons of bodies whose axis is known."""

from __future__ import annotations

import igl
import numpy as np
import pytest
from scipy.spatial import cKDTree

from tasks.errors import InputError
from tasks.geometry.neighbours import components
from tasks.geometry.rotations import from_rotation_vector
from tasks.skeleton import flow, graph, halfedge
from tasks.skeleton.curve import curve_skeleton
from tasks.skeleton.manifold import is_closed
from tasks.values import Curve, same
from tests.analytic import shapes

SETTINGS = {"speed": 0.1, "medial": 0.1, "edge": 0.002, "angle": 110.0, "stop": 1e-4, "rounds": 500, "twig": 1.0}
ROD = [([0.0, -0.5, 0.0], [0.0, 0.5, 0.0])]
WYE = [([0.0, 0.0, 0.0], [np.cos(a), np.sin(a), 0.0]) for a in (np.pi / 2, np.pi * 7 / 6, np.pi * 11 / 6)]
PLUS = [([-1.0, 0.0, 0.0], [1.0, 0.0, 0.0]), ([0.0, -1.0, 0.0], [0.0, 1.0, 0.0])]


def skeleton(vertices: np.ndarray, faces: np.ndarray, **changed: float) -> Curve:
    return curve_skeleton(shapes.surface(vertices, faces), **{**SETTINGS, **changed})


def leaves_and_excess(curve: Curve) -> tuple[int, int]:
    """Free ends, and branches beyond two summed over junctions (a junction may come out as two close ones)."""
    degree = shapes.degrees(curve.nodes, curve.edges)
    return int(np.sum(degree == 1)), int(np.sum(np.maximum(degree - 2, 0)))


def test_rod_gives_its_axis():
    vertices, faces = shapes.capsules(ROD, 0.2, 0.04)
    curve = skeleton(vertices, faces)
    assert leaves_and_excess(curve) == (2, 0)
    assert np.linalg.norm(curve.nodes[:, [0, 2]], axis=1).max() < 0.02  # a tenth of the radius
    assert np.ptp(curve.nodes[:, 1]) > 0.9  # the segment is 1 long, the body 1.4
    middle = np.abs(vertices[:, 1]) < 0.35
    assert np.abs(curve.nodes[curve.of_vertex[middle], 1] - vertices[middle, 1]).max() < 0.06


@pytest.mark.parametrize(("segments", "arms"), [(WYE, 3), (PLUS, 4)])
def test_arms_become_branches(segments, arms):
    curve = skeleton(*shapes.capsules(segments, 0.2, 0.06))
    assert leaves_and_excess(curve) == (arms, arms - 2)
    assert len(curve.edges) == len(curve.nodes) - 1
    ends = curve.nodes[shapes.degrees(curve.nodes, curve.edges) == 1]
    tips = np.array([p for segment in segments for p in segment if np.linalg.norm(p) > 0.5])
    assert cKDTree(ends).query(tips)[0].max() < 0.15
    crossing = curve.nodes[shapes.degrees(curve.nodes, curve.edges) > 2]
    assert np.linalg.norm(crossing, axis=1).max() < 0.1


def test_sphere_shrinks_to_nearly_a_point():
    curve = skeleton(*shapes.sphere(3))
    assert np.linalg.norm(curve.nodes, axis=1).max() < 0.05
    assert len(curve.edges) == len(curve.nodes) - 1


def test_every_vertex_and_point_is_mapped_once():
    vertices, faces = shapes.capsules(WYE, 0.2, 0.08)
    made = shapes.surface(vertices, faces)
    points = np.arange(0, len(vertices), 3, dtype=np.int32)
    curve = curve_skeleton(type(made)(made.vertices, made.faces, points), **SETTINGS)
    assert curve.of_vertex.shape == (len(vertices),)
    assert curve.of_vertex.min() >= 0
    assert curve.of_vertex.max() < len(curve.nodes)
    assert np.array_equal(curve.of_point, curve.of_vertex[points])
    assert curve.nodes.dtype == np.float32
    assert curve.edges.dtype == curve.of_vertex.dtype == curve.of_point.dtype == np.int32


def test_loop_is_cut_open():
    curve = skeleton(*shapes.torus(96, 32))
    assert len(curve.edges) == len(curve.nodes) - 1
    assert leaves_and_excess(curve) == (2, 0)
    assert np.abs(np.hypot(curve.nodes[:, 0], curve.nodes[:, 2]) - 1.0).max() < 0.1
    ends = curve.nodes[shapes.degrees(curve.nodes, curve.edges) == 1]
    assert np.linalg.norm(ends[0] - ends[1]) < 0.2


def test_two_bodies_give_two_trees():
    vertices, faces = shapes.capsules(ROD, 0.2, 0.06)
    both = (
        np.concatenate([vertices, vertices + np.array([1.0, 0.0, 0.0])]),
        np.concatenate([faces, faces + len(vertices)]),
    )
    curve = skeleton(*both)
    assert components(curve.edges, len(curve.nodes))[0] == 2
    assert len(curve.edges) == len(curve.nodes) - 2


def test_moves_with_the_body():
    vertices, faces = shapes.capsules(WYE, 0.2, 0.06)
    turn, shift = from_rotation_vector(np.array([0.3, -0.8, 0.5])), np.array([3.0, -2.0, 1.0])
    here, there = skeleton(vertices, faces), skeleton(3.0 * vertices @ turn.T + shift, faces)
    assert leaves_and_excess(here) == leaves_and_excess(there)
    back = (there.nodes - shift) @ turn / 3.0
    for apart in (
        cKDTree(_dense(back, there.edges)).query(here.nodes)[0],
        cKDTree(_dense(here.nodes, here.edges)).query(back)[0],
    ):
        assert apart.mean() < 0.02  # a tenth of the radius; the box that scales `edge` turns with the body
        assert apart.max() < 0.1


def _dense(nodes: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Ten points on every edge."""
    share = np.linspace(0.0, 1.0, 10)[:, None, None]
    return ((1.0 - share) * nodes[edges[:, 0]] + share * nodes[edges[:, 1]]).reshape(-1, 3)


def test_same_bits_twice():
    vertices, faces = shapes.capsules(PLUS, 0.2, 0.08)
    assert same(skeleton(vertices, faces), skeleton(vertices, faces))


def test_open_surface_is_refused():
    with pytest.raises(InputError, match=r"Surface\.faces"):
        skeleton(*shapes.box(open_top=True))


def test_pole_of_a_sphere_is_its_centre():
    vertices, faces = shapes.sphere(3)
    poles = flow.medial_poles(vertices, faces)
    assert np.linalg.norm(poles[np.isfinite(poles[:, 0])], axis=1).max() < 0.05
    assert np.mean(np.isfinite(poles[:, 0])) > 0.95


def test_step_solves_the_dense_system():
    """The kernel against the formula, on a mesh without obtuse angles (where clamping does nothing)."""
    vertices, faces = shapes.sphere(2)
    poles = 0.2 * np.random.default_rng(0).normal(size=vertices.shape)
    poles[::3] = np.nan
    mesh = halfedge.build(vertices, faces, spare=0)
    flow._solve(mesh, poles, np.zeros(len(vertices), bool), 0.1, 0.2, 1e-10)
    pull = np.where(np.isnan(poles[:, 0]), 0.0, 0.2)
    system = np.diag(0.1 + pull) - 2.0 * igl.cotmatrix(vertices, faces).toarray()
    right = 0.1 * vertices + pull[:, None] * np.nan_to_num(poles)
    np.testing.assert_allclose(mesh.position, np.linalg.solve(system, right), atol=1e-8)


def test_collapses_and_splits_keep_the_mesh_closed():
    vertices, faces = shapes.sphere(2)
    mesh = halfedge.build(vertices, faces, spare=200)
    rng = np.random.default_rng(1)
    for step in range(600):
        h = int(rng.integers(3 * mesh.used[1]))
        if mesh.origin[h] < 0:
            continue
        if step % 3 == 0:
            halfedge.split(mesh, h, mesh.position[mesh.origin[h]])
        elif halfedge.can_collapse(mesh, h):
            halfedge.collapse(mesh, h)
    left, renumbered = np.unique(halfedge.faces_of(mesh), return_inverse=True)
    assert is_closed(renumbered.reshape(-1, 3), len(left))
    assert len(left) - renumbered.size / 6 == 2  # still a sphere: V - T/2 = 2
    assert len(left) < len(vertices)
    assert np.array_equal(left, np.flatnonzero(mesh.first >= 0))


def test_tetrahedron_does_not_collapse_further():
    vertices, faces = np.eye(4)[:, :3], np.array([[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]])
    mesh = halfedge.build(vertices, faces, spare=0)
    assert not any(halfedge.can_collapse(mesh, h) for h in range(12))


def test_triangles_collapse_to_the_edge_between_far_ends():
    """A thin double triangle strip: its short edges go, its long ones stay."""
    position = np.array([[0, 0, 0], [0, 0.1, 0], [0, 0.05, 0.1], [1, 0, 0], [1, 0.1, 0], [1, 0.05, 0.1]], float)
    sides = [(0, 1, 4), (0, 4, 3), (1, 2, 5), (1, 5, 4), (2, 0, 3), (2, 3, 5), (0, 2, 1), (3, 4, 5)]
    edges, into = graph.collapse_triangles(position, np.array(sides))
    assert len(edges) == 1
    assert into[0] == into[1] == into[2] != into[3]
    assert into[3] == into[4] == into[5]


def test_twigs_fall_by_length_and_hand_their_points_down():
    nodes = np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0], [1, 0.3, 0], [1, -0.9, 0]], float)
    edges = np.array([[0, 1], [1, 2], [1, 3], [1, 4]])
    kept, left, owner = graph.drop_twigs(nodes, edges, np.arange(5), np.full(5, 0.5))
    assert len(kept) == 4
    assert len(left) == 3
    assert np.array_equal(kept[owner], nodes[[0, 1, 2, 1, 4]])
