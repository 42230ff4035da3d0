"""Closed surfaces round shapes of known volume, however badly they come."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from tasks.errors import InputError
from tasks.skeleton.manifold import components_of, is_closed
from tasks.skeleton.mend import mend
from tasks.skeleton.orient import outward_normals
from tasks.skeleton.surface import closed_surface
from tasks.values import Canonical, Surface, same
from tests.analytic import shapes

SETTINGS = {"vertices": 1500, "cells": 48, "neighbours": 20, "remesh": "edges"}
ROD = [([0.0, -0.5, 0.0], [0.0, 0.5, 0.0])]


def close(points: np.ndarray, faces: np.ndarray | None, **changed: int) -> Surface:
    kept = None if faces is None else faces.astype(np.int32)
    made = closed_surface(Canonical(points.astype(np.float32), kept, 0, "test"), **{**SETTINGS, **changed})
    assert is_closed(made.faces, len(made.vertices))
    assert components_of(made.faces, len(made.vertices))[0] == 1
    assert made.of_point.shape == (len(points),)
    nearest = cKDTree(made.vertices).query(points.astype(np.float32))[0]
    np.testing.assert_allclose(np.linalg.norm(made.vertices[made.of_point] - points, axis=1), nearest, atol=1e-6)
    return made


def handles(made: Surface) -> float:
    return 1 - (len(made.vertices) - len(made.faces) / 2) / 2


def test_closed_mesh_stays_as_it_is():
    vertices, faces = shapes.capsules(ROD, 0.2, 0.05)
    made = close(vertices, faces)
    assert np.array_equal(made.vertices, vertices.astype(np.float32))
    assert np.array_equal(made.faces, faces)
    assert np.array_equal(made.of_point, np.arange(len(vertices)))


def test_mesh_turned_inside_out_is_turned_back():
    vertices, faces = shapes.capsules(ROD, 0.2, 0.05)
    made = close(vertices, faces[:, ::-1])
    assert shapes.volume(made.vertices, made.faces) == pytest.approx(shapes.volume(vertices, faces), rel=1e-5)


def test_coarse_mesh_is_refined_without_moving():
    made = close(*shapes.box())
    assert 750 <= len(made.vertices) <= 3000
    assert shapes.volume(made.vertices, made.faces) == pytest.approx(1.0, rel=1e-5)
    np.testing.assert_array_equal(made.vertices[made.of_point], shapes.box()[0])


def test_fine_mesh_is_thinned_out():
    made = close(*shapes.capsules(ROD, 0.2, 0.02))
    assert 750 <= len(made.vertices) <= 3000
    assert shapes.volume(made.vertices, made.faces) == pytest.approx(np.pi * 0.04 * (1 + 0.8 / 3), rel=0.03)


def test_isotropic_remeshing_gives_even_triangles():
    vertices, faces = shapes.capsules(ROD, 0.2, 0.02)
    made = close(vertices, faces, remesh="isotropic")
    assert 750 <= len(made.vertices) <= 3000
    assert shapes.volume(made.vertices, made.faces) == pytest.approx(shapes.volume(vertices, faces), rel=0.03)
    sides = [made.vertices[made.faces[:, k]] - made.vertices[made.faces[:, k - 1]] for k in range(3)]
    lengths = np.linalg.norm(sides, axis=-1)
    assert np.median(lengths.max(0) / lengths.min(0)) < 1.4


def test_open_box_is_closed():
    vertices, faces = shapes.box((1.0, 2.0, 1.0), open_top=True)
    assert not is_closed(faces, len(vertices))
    made = close(vertices, faces)
    assert shapes.volume(made.vertices, made.faces) == pytest.approx(2.0, rel=1e-5)


def test_soup_with_doubled_vertices_and_empty_triangles():
    vertices, faces = shapes.capsules(ROD, 0.2, 0.05)
    apart, number = vertices[faces].reshape(-1, 3), np.arange(3 * len(faces)).reshape(-1, 3)
    flat = np.array([[0, 0, 1], [5, 5, 5]])
    made = close(apart, np.concatenate([number, flat]))
    assert len(made.vertices) == len(vertices)
    assert shapes.volume(made.vertices, made.faces) == pytest.approx(shapes.volume(vertices, faces), rel=1e-5)


def test_overlapping_parts_become_their_union():
    vertices, faces = shapes.sphere(3)
    shifted = vertices + np.array([1.0, 0.0, 0.0])
    made = close(np.concatenate([vertices, shifted]), np.concatenate([faces, faces + len(vertices)]))
    lens = np.pi * (4 + 1) * (2 - 1) ** 2 / 12  # two unit balls one apart
    assert shapes.volume(made.vertices, made.faces) == pytest.approx(8 / 3 * np.pi - lens, rel=0.03)
    assert handles(made) == 0


def test_parts_with_a_narrow_gap_are_joined():
    vertices, faces = shapes.sphere(3)
    apart = vertices + np.array([2.1, 0.0, 0.0])  # 0.1 between them, a cell is 0.085
    made = close(np.concatenate([vertices, apart]), np.concatenate([faces, faces + len(vertices)]))
    assert np.ptp(made.vertices[:, 0]) > 4.0


def test_bare_points_of_a_capsule():
    vertices, faces = shapes.capsules(ROD, 0.2, 0.05)
    made = close(vertices, None)
    assert handles(made) == 0
    assert shapes.volume(made.vertices, made.faces) == pytest.approx(shapes.volume(vertices, faces), rel=0.05)


def test_normals_of_bare_points_look_outwards():
    points = np.concatenate([shapes.capsules(ROD, 0.2, 0.05)[0], shapes.capsules(ROD, 0.1, 0.03)[0] + [0.5, 0, 0]])
    distance, near = cKDTree(points).query(points, k=13)
    normal = outward_normals(points, near, distance[:, -1])
    axis = np.where(points[:, :1] > 0.3, [[0.5, 0.0, 0.0]], [[0.0, 0.0, 0.0]]) + np.clip(points, -0.5, 0.5) * [0, 1, 0]
    assert np.all(np.einsum("ij,ij->i", normal, points - axis) > 0)


def test_same_bits_twice():
    points = shapes.capsules(ROD, 0.2, 0.06)[0]
    assert same(close(points, None), close(points, None))


def test_fin_is_dropped_and_the_body_stays():
    vertices, faces = shapes.sphere(2)
    a, b = faces[0, :2]
    with_fin = np.concatenate([vertices, [2.0 * vertices[a]]])
    mended, left = mend(with_fin, np.concatenate([faces, [[a, b, len(vertices)]]]))
    assert is_closed(left, len(mended))
    assert shapes.volume(mended, left) == pytest.approx(shapes.volume(vertices, faces), rel=0.02)


def test_closedness_by_hand():
    _, faces = shapes.box()
    assert is_closed(faces, 8)
    assert not is_closed(faces[1:], 8)
    assert not is_closed(faces, 9)  # a vertex without triangles
    flipped = np.concatenate([faces[:1, ::-1], faces[1:]])
    assert not is_closed(flipped, 8)
    touching = np.where(faces == 0, 0, faces + 7)  # a second box that shares only vertex 0
    assert not is_closed(np.concatenate([faces, touching]), 15)


@pytest.mark.parametrize("faces", [None, np.array([[0, 1, 2], [1, 3, 2]])])
def test_flat_shape_is_refused(faces):
    flat = np.random.default_rng(0).random((100, 3)) * [1.0, 1.0, 0.0]
    with pytest.raises(InputError, match="span a volume"):
        close(flat, faces)
