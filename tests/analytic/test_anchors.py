"""Points that follow a surface, Gaussian bones, and how torn weights are."""

from __future__ import annotations

import numpy as np
import pytest

from tasks.bones.gaussian import gaussian_bones
from tasks.errors import InputError
from tasks.evaluation.fragments import bone_fragments
from tasks.geometry import rigid
from tasks.geometry.measure import diagonal, vertex_rmse
from tasks.geometry.rotations import from_rotation_vector
from tasks.geometry.skinning import skin
from tasks.reconstruction.anchors import anchored
from tasks.values import Canonical, Clusters, Motion, Skinning
from tests.analytic.shapes import sphere


def motion(points: np.ndarray, faces: np.ndarray | None) -> Motion:
    return Motion("m", points.astype(np.float32), faces, np.array([0, len(points)]), ("c",), 24.0)


def turning(points: np.ndarray, frames: int) -> tuple[np.ndarray, np.ndarray]:
    """(F, N, 3) points under one rigid motion, and its transforms (F, 3, 4)."""
    angle = np.linspace(0, 1.5, frames)[:, None] * np.array([0.3, 1.0, -0.2])
    transforms = rigid.make(from_rotation_vector(angle), 0.4 * angle)
    return rigid.apply(transforms[:, None], points), transforms


def test_anchored_points_ride_on_the_surface():
    vertices, faces = sphere(2)
    moved, transforms = turning(vertices, 9)
    train, test = motion(moved[:5], faces), motion(moved[5:], faces)
    corners = vertices[faces]
    inside_triangles = corners.mean(1)
    gaussians = motion(np.repeat(inside_triangles[None], 5, 0), None)
    out = anchored(gaussians, train, test)
    assert out.faces is None
    np.testing.assert_allclose(out.points, rigid.apply(transforms[5:, None], inside_triangles), atol=1e-5)
    with pytest.raises(InputError, match="a mesh"):
        anchored(gaussians, motion(moved[:5], None), test)


def two_blobs() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.normal(0, 0.2, (150, 3)), rng.normal([3.0, 0.0, 0.0], 0.2, (150, 3))])
    return points, np.repeat([0, 1], 150).astype(np.int32)


def test_gaussian_bones_give_far_blobs_their_own_bone():
    points, labels = two_blobs()
    a, left = turning(points, 6)
    right = rigid.make(np.repeat(np.eye(3)[None], 6, 0), np.linspace(0, 1, 6)[:, None] * [0, 1.0, 0])
    moved = np.where(labels[:, None] == 0, a, rigid.apply(right[:, None], points))
    clusters = Clusters(labels, np.stack([left, right], 1), np.ones(len(labels), bool), np.zeros(0), np.zeros(0))
    canonical = Canonical(points.astype(np.float32), None, 0, "first")
    found = gaussian_bones(motion(moved, None), canonical, clusters, sharpness=1.0, influences=2)
    np.testing.assert_allclose(found.weights.sum(1), 1, atol=1e-6)
    assert (found.weights.argmax(1) == labels).all()
    posed = skin(found.rest, found.weights, found.transforms)
    assert vertex_rmse(posed, moved) < 1e-3 * diagonal(points)


def test_fragments_count_the_pieces_that_a_bone_holds():
    points, labels = two_blobs()
    canonical = Canonical(points.astype(np.float32), None, 0, "first")

    def torn(weights: np.ndarray) -> float:
        return bone_fragments(
            canonical, Skinning(points, weights.astype(np.float32), np.zeros((1, 2, 3, 4)), np.zeros(0))
        )

    whole = np.eye(2)[labels]
    assert torn(whole) == 1.0
    assert torn(np.full((300, 2), 0.5)) == 2.0
    assert torn(np.stack([np.ones(300), np.zeros(300)], 1)) == 2.0  # an empty bone does not count
