"""Closed surface and curve skeleton of captured meshes, rigs and splats."""

from __future__ import annotations

import igl
import numpy as np
import pytest

from tasks.skeleton.curve import curve_skeleton
from tasks.skeleton.manifold import components_of, is_closed
from tasks.skeleton.surface import closed_surface
from tasks.values import Canonical, Curve, Surface
from tests.shipped import shipped

SURFACE = shipped("skeleton.surface")
CURVE = shipped("skeleton.curve")


def sound(points: np.ndarray, faces: np.ndarray | None) -> tuple[Surface, Curve]:
    """Surface and curve, with what must hold for every shape checked."""
    surface = closed_surface(Canonical(points, faces, 0, "first"), **SURFACE)
    assert is_closed(surface.faces, len(surface.vertices))
    assert components_of(surface.faces, len(surface.vertices))[0] == 1
    curve = curve_skeleton(surface, **CURVE)
    assert len(curve.edges) == len(curve.nodes) - 1
    assert len(curve.of_vertex) == len(surface.vertices)
    assert len(curve.of_point) == len(points)
    winding = igl.fast_winding_number(
        surface.vertices.astype(np.float64), surface.faces.astype(np.int64), curve.nodes.astype(np.float64)
    )
    assert np.mean(winding > 0.5) >= 0.95
    return surface, curve


def leaves(curve: Curve) -> int:
    return int(np.sum(np.bincount(curve.edges.ravel()) == 1))


def sequence(shared_data, name: str) -> tuple[np.ndarray, np.ndarray]:
    with np.load(shared_data / "mesh_sequences" / f"{name}.npz", allow_pickle=False) as data:
        return data["vertices"][0], data["faces"]


def rig(shared_data, name: str) -> tuple[np.ndarray, np.ndarray]:
    with np.load(shared_data / "rigged_quaternius" / "decoded" / f"{name}.npz", allow_pickle=False) as data:
        return data["rest_vertices"].astype(np.float32), data["faces"]


@pytest.mark.parametrize(
    ("name", "count"), [("horse_gallop", 8), ("human_samba", 5), ("human_crane", 5), ("cat_poses", 6)]
)
def test_first_frame_has_the_limbs_of_the_body(shared_data, name, count):
    """Horse: legs, tail, nose, ears; people: hands, feet, head; cat: legs, tail, head. CGAL finds the same once its
    one-node twigs (one on samba, two on crane) are dropped by the same rule."""
    points, faces = sequence(shared_data, name)
    surface, curve = sound(points, faces)
    assert leaves(curve) == count
    np.testing.assert_array_equal(surface.vertices[surface.of_point], points)


@pytest.mark.parametrize("name", ["wolf", "horse", "donkey", "fox", "alpaca", "deer"])
def test_rigged_animal_has_eight_ends(shared_data, name):
    _, curve = sound(*rig(shared_data, name))
    assert leaves(curve) == 8


@pytest.mark.slow
@pytest.mark.parametrize("name", ["stegosaurus", "parasaurolophus", "platformercharacter"])
def test_open_and_many_part_meshes_are_closed(shared_data, name):
    points, faces = rig(shared_data, name)
    assert not is_closed(faces, len(points)) or components_of(faces, len(points))[0] > 1
    sound(points, faces)


@pytest.mark.slow
def test_points_without_their_faces_keep_the_limbs(shared_data):
    points, _ = sequence(shared_data, "human_samba")
    _, curve = sound(points, None)
    assert leaves(curve) == 5


@pytest.mark.slow
def test_cat_without_faces_is_closed(shared_data):
    sound(sequence(shared_data, "cat_poses")[0], None)


@pytest.mark.slow
def test_gaussian_centres(shared_data):
    """32 bytes a splat, the centre first: Spot the cow has legs, horns or ears, nose and tail."""
    raw = np.fromfile(shared_data / "splat_objects" / "spot_10k.splat", np.uint8).reshape(-1, 32)
    centres = raw[:, :12].copy().view(np.float32).reshape(-1, 3)
    _, curve = sound(centres, None)
    assert leaves(curve) >= 6
