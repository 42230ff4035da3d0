"""Bounded biharmonic weights on a lattice: the lattice is a conforming mesh, the weights are what symmetry asks for."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
import trimesh

from tasks.datasets import rigged_character
from tasks.geometry import kinematics
from tasks.geometry.lattice import lattice
from tasks.geometry.measure import diagonal, vertex_rmse
from tasks.geometry.skinning import skin
from tasks.motion.harmonic import biharmonic_weights, handles
from tasks.values import Canonical, Skeleton

BAR = trimesh.creation.box((0.2, 0.2, 2.0)).subdivide().subdivide()


def bar_and_skeleton() -> tuple[Canonical, Skeleton]:
    """A bar along z and two bones in it that meet in the middle; a third joint, at its end, moves no skin."""
    points = BAR.vertices.astype(np.float32)
    joints = np.array([[0, 0, -0.9], [0, 0, 0], [0, 0, 0.9]], np.float32)
    weights = np.tile(np.array([0.5, 0.5, 0], np.float32), (len(points), 1))
    faces = np.array(BAR.faces, np.int32)
    return Canonical(points, faces, -1, "bar"), Skeleton(("a", "b", "c"), np.array([-1, 0, 1]), joints, weights)


@pytest.mark.parametrize("faces", [True, False])
def test_lattice_is_a_conforming_mesh_round_the_shape(faces):
    shape = trimesh.creation.icosphere(subdivisions=4)
    made = lattice(shape.vertices, shape.faces if faces else None, 700)
    assert 350 < len(made.cells) <= 700
    a, b, c, d = (made.vertices[made.tets[:, k]] for k in range(4))
    volume = np.einsum("ij,ij->i", np.cross(b - a, c - a), d - a) / 6
    np.testing.assert_allclose(volume, made.size**3 / 6)  # all the same way round
    assert volume.sum() == pytest.approx(len(made.cells) * made.size**3)
    assert 4 / 3 * np.pi < volume.sum() < 4 / 3 * np.pi * (1 + 3 * made.size) ** 3
    sides = np.concatenate([np.sort(made.tets[:, list(k)], axis=1) for k in combinations(range(4), 3)])
    _, uses = np.unique(sides, axis=0, return_counts=True)
    assert set(uses) == {1, 2}
    outside = made.vertices[np.unique(np.unique(sides, axis=0)[uses == 1])]
    assert np.linalg.norm(outside, axis=1).min() > 0.9  # no hollow inside


def test_interpolation_gives_back_linear_functions():
    made = lattice(BAR.vertices, BAR.faces, 300)
    plane = np.array([0.3, -0.2, 0.7])
    got = made.interpolate((made.vertices @ plane)[:, None], BAR.vertices)
    np.testing.assert_allclose(got[:, 0], BAR.vertices @ plane, atol=1e-12)


def test_only_the_largest_part_is_kept_and_the_rest_takes_what_is_nearest():
    far = trimesh.creation.icosphere(subdivisions=2, radius=0.05).apply_translation([0, 0, 1.6])
    both = trimesh.util.concatenate([BAR, far])
    made = lattice(both.vertices, both.faces, 400)
    assert made.vertices[:, 2].max() < 1.3
    got = made.interpolate(made.vertices[:, 2:], far.vertices)
    np.testing.assert_allclose(got, made.vertices[:, 2].max(), atol=1e-9)


def test_weights_of_a_bar():
    canonical, skeleton = bar_and_skeleton()
    weights = biharmonic_weights(canonical, skeleton, cells=900)
    z = canonical.points[:, 2]
    np.testing.assert_allclose(weights.sum(1), 1, atol=1e-6)
    assert weights.min() >= 0
    assert (weights[:, 2] == 0).all()  # moves no skin
    assert weights[z < -0.5, 0].min() > 0.99
    assert weights[z > 0.5, 1].min() > 0.99
    mirrored = np.array([np.argmin(np.abs(canonical.points - p * [1, 1, -1]).sum(1)) for p in canonical.points])
    np.testing.assert_allclose(weights[:, 0], weights[mirrored, 1], atol=0.15)  # up to the lattice's own asymmetry
    order = np.argsort(z, kind="stable")
    assert np.diff(weights[order, 1]).min() > -0.1
    again = biharmonic_weights(canonical, skeleton, cells=900)
    np.testing.assert_array_equal(again, weights)


def test_every_joint_has_a_handle():
    canonical, _ = bar_and_skeleton()
    crowd = np.array([[0, 0, 0.001 * k] for k in range(5)], np.float32)
    parents = np.array([-1, 0, 0, 0, 0])
    many = Skeleton(tuple("abcde"), parents, crowd, np.full((len(canonical.points), 5), 0.2, np.float32))
    at, owner = handles(lattice(canonical.points, canonical.faces, 200), many, np.arange(5))
    assert set(owner) == set(range(5))
    assert len(set(at)) == len(at)


@pytest.mark.slow
def test_on_a_real_rig_far_better_than_the_nearest_bone(shared_data):
    path = shared_data / "rigged_quaternius" / "decoded" / "horse.npz"
    motion = rigged_character.load(path=str(path), fps=24.0, hierarchy="attached", unit="unit")
    rig, some = motion.rig, slice(None, None, 20)
    skeleton = Skeleton(rig.names, rig.parents, rig.joints, rig.weights)
    weights = biharmonic_weights(Canonical(motion.rest, motion.faces, -1, "rest"), skeleton, cells=1000)
    posed = kinematics.forward(rig.parents, rig.joints, rig.rotations[some], rig.translations[some])
    hard = np.eye(len(rig.names), dtype=np.float32)[weights.argmax(1)]
    error, hard_error = (vertex_rmse(skin(motion.rest, w, posed), motion.points[some]) for w in (weights, hard))
    assert error < 0.012 * diagonal(motion.rest)
    assert error < hard_error
