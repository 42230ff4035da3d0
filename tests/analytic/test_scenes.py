"""Rendered scenes: where things appear, how much they cover, which frames and cameras there are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tasks.captures import cameras as cam
from tasks.captures import dnerf, multiview
from tasks.captures.raycast import Caster, solid_colour
from tasks.captures.scenes import render_scene, scene_files, scene_motion
from tasks.drawing.pictures import scene_picture
from tasks.errors import InputError
from tasks.evaluation.scenes import evaluate_scene
from tasks.geometry.rotations import from_rotation_vector
from tasks.values import Motion, Rig, same
from tests.analytic.shapes import sphere

SCENE = {
    "size": 48,
    "layout": "monocular",
    "views": 12,
    "test_views": 4,
    "cameras": 5,
    "test_cameras": 2,
    "fill": 0.15,
    "follow": True,
    "field_of_view": 40.0,
    "samples": 2,
    "shading": 0.3,
    "seed": 3,
}


def ball(frames: int = 6, travel: float = 0.0, rig: bool = False) -> Motion:
    """A sphere, drawn out into an egg, that turns and travels."""
    vertices, faces = sphere(3)
    egg = vertices * [1.0, 1.6, 1.0]
    turns = from_rotation_vector(np.outer(np.linspace(0, 1, frames), [0.0, 0.0, 1.0]))
    points = egg @ turns.transpose(0, 2, 1) + np.linspace(0, travel, frames)[:, None, None] * [1.0, 0, 0]
    shift = np.zeros((frames, 1, 3), np.float32)
    bones = Rig(("root",), np.array([-1]), np.zeros((1, 3)), np.ones((len(egg), 1)), turns[:, None], shift)
    start, names = np.array([0, frames // 2, frames]), ("one", "two")
    return Motion("ball", points.astype(np.float32), faces, start, names, 24.0, rig=bones if rig else None)


def cube(low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    corners = np.array(np.meshgrid(*zip(low, high, strict=True), indexing="ij")).reshape(3, -1).T
    faces = [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6], [0, 2, 6]]
    return corners, np.array([*faces, [0, 6, 4], [1, 5, 7], [1, 7, 3]], np.int32)


def test_a_small_cube_covers_the_pixel_that_its_centre_projects_to():
    """Image axes, centres of pixels and the world-to-camera matrix, all at once."""
    intrinsics = cam.pinhole(100, 40.0)
    view = cam.look_at(np.array([[3.0, 2.0, 4.0]]), np.array([[0.1, -0.2, 0.3]]))[0]
    random = np.random.default_rng(0)
    for place in random.uniform(-0.8, 0.8, (20, 3)):
        points, faces = cube(place - 0.02, place + 0.02)
        x, y = cam.project(place[None], view, intrinsics)[0]
        share = Caster(points, faces, points).coverage(view, intrinsics, 100, 8)
        rows, columns = np.nonzero(share)
        weight = share[rows, columns]
        assert abs(np.average(columns + 0.5, weights=weight) - x) < 0.1
        assert abs(np.average(rows + 0.5, weights=weight) - y) < 0.1


def test_up_is_up_and_right_is_right():
    view = cam.look_at(np.array([[0.0, 0.0, 5.0]]), np.zeros((1, 3)))[0]
    x, y = cam.project(np.array([[0.5, 0.0, 0.0], [0.0, 0.5, 0.0]]), view, cam.pinhole(100, 40.0)).T
    assert x[0] > 50
    assert y[0] == pytest.approx(50)
    assert y[1] < 50
    np.testing.assert_allclose(cam.eyes(view[None]), [[0, 0, 5]], atol=1e-12)
    assert np.linalg.det(view[:3, :3]) == pytest.approx(1)


def test_coverage_of_a_sphere_is_its_projected_area():
    """A sphere of radius r at distance d seen head-on is a disc of radius f r / sqrt(d^2 - r^2)."""
    vertices, faces = sphere(5)
    intrinsics = cam.pinhole(120, 40.0)
    view = cam.look_at(np.array([[0.0, 0.0, 6.0]]), np.zeros((1, 3)))[0]
    share = Caster(vertices, faces, vertices).coverage(view, intrinsics, 120, 4)
    disc = np.pi * (intrinsics[0, 0] / np.sqrt(36.0 - 1.0)) ** 2
    assert share.sum() == pytest.approx(disc, rel=3e-3)
    inside = np.hypot(*(np.mgrid[:120, :120] + 0.5 - 60)) < np.sqrt(disc / np.pi) - 1.5
    assert (share[inside] == 1).all()  # no ray slips through between triangles


def test_colours_are_those_of_the_rest_shape_and_not_darkened_by_alpha():
    vertices, faces = sphere(3)
    view = cam.look_at(np.array([[0.0, 0.0, 6.0]]), np.zeros((1, 3)))[0]
    drawn = Caster(vertices, faces, vertices).image(view, cam.pinhole(81, 30.0), 81, samples=3, shading=0.0)
    middle = solid_colour(np.array([[0.0, 0.0, 1.0]], np.float32), vertices.mean(0), np.sqrt(12.0))
    np.testing.assert_allclose(drawn[40, 40, :3] / 255, middle[0], atol=0.02)
    moved = Caster(vertices + np.array([0.3, 0, 0]), faces, vertices).image(
        view, cam.pinhole(81, 30.0), 81, samples=3, shading=0.0
    )
    assert not np.array_equal(moved, drawn)
    x, y = np.floor(cam.project(np.array([[0.3, 0.0, 1.0]]), view, cam.pinhole(81, 30.0))[0]).astype(int)
    np.testing.assert_allclose(moved[y, x, :3] / 255, middle[0], atol=0.03)  # the colour travels with the surface
    rim = (drawn[..., 3] > 20) & (drawn[..., 3] < 200)
    assert rim.any()
    assert drawn[rim][:, :3].max(1).mean() > 0.6 * drawn[drawn[..., 3] == 255][:, :3].max(1).mean()
    assert (drawn[drawn[..., 3] == 0] == 0).all()


def test_both_sides_of_an_open_surface_are_lit_towards_the_eye():
    """One triangle, seen from the front and from the back, the light shining along the view from behind the eye."""
    points = np.array([[-1.0, -1, 0], [1, -1, 0], [0, 1, 0]])
    for z, lit in ((4.0, True), (-4.0, False)):  # the light comes from +z
        view = cam.look_at(np.array([[0.0, 0.0, z]]), np.zeros((1, 3)))[0]
        settings = {"view": view, "intrinsics": cam.pinhole(33, 50.0), "size": 33, "samples": 1}
        faces = [np.array([f], np.int32) for f in ([0, 1, 2], [0, 2, 1])]
        pictures = [Caster(points, f, points).image(**settings, shading=1.0) for f in faces]
        np.testing.assert_allclose(*(p.astype(float) for p in pictures), atol=1)
        glow = Caster(points, faces[0], points).image(**settings, shading=0.0)
        share = pictures[0][16, 16, :3].astype(float) / glow[16, 16, :3]
        assert (share > 0.6).all() == lit


def test_monocular_views_have_a_camera_and_a_time_of_their_own():
    motion = ball()
    train, test = render_scene(motion, **SCENE)
    assert train.images.shape == (12, 48, 48, 4)
    assert test.images.shape == (4, 48, 48, 4)
    assert train.images.dtype == np.uint8
    assert len(np.unique(train.view.reshape(12, -1), axis=0)) == 12
    assert train.frame.tolist() == sorted(train.frame.tolist())
    assert set(train.frame.tolist()) == set(range(6))
    assert np.array_equal(train.camera, np.arange(12))
    np.testing.assert_allclose(train.times, np.linspace(0, 1, 6), atol=1e-6)
    eyes = cam.eyes(train.view)
    assert (eyes[:, 1] >= 0).all()
    assert not set(map(tuple, cam.eyes(test.view).round(6))) & set(map(tuple, eyes.round(6)))
    assert (train.clip_start.tolist(), train.clip_names, train.fps) == ([0, 3, 6], ("one", "two"), 24.0)


@pytest.mark.parametrize("travel", [0.0, 8.0])
def test_the_subject_fills_its_share_and_is_nowhere_cut(travel):
    train, test = render_scene(ball(travel=travel), **SCENE | {"views": 40})
    assert train.images[..., 3].mean() / 255 == pytest.approx(0.15, abs=0.015)
    for images in (train.images, test.images):
        border = [images[:, 0], images[:, -1], images[:, :, 0], images[:, :, -1]]
        assert max(b[..., 3].max() for b in border) == 0


def test_multiview_cameras_stand_still_and_see_every_frame():
    settings = SCENE | {"layout": "multiview", "fill": 0.05}
    train, test = render_scene(ball(travel=1.0), **settings)
    assert len(train.images) == 5 * 6
    assert len(test.images) == 2 * 6
    pairs = set(zip(train.camera.tolist(), train.frame.tolist(), strict=True))
    assert pairs == {(c, f) for c in range(5) for f in range(6)}
    for capture in (train, test):
        for c in np.unique(capture.camera):
            assert len(np.unique(capture.view[capture.camera == c].reshape(6, -1), axis=0)) == 1
    apart = np.linalg.norm(cam.eyes(train.view)[:, None] - cam.eyes(test.view), axis=2)
    assert apart.min() > 0.1


def test_the_same_seed_gives_the_same_bits_and_another_one_other_cameras():
    first, again = (render_scene(ball(), **SCENE)[0] for _ in range(2))
    assert same(first, again)
    other = render_scene(ball(), **SCENE | {"seed": 4})[0]
    assert not np.array_equal(first.view, other.view)


def test_the_rig_comes_without_weights():
    motion = ball(rig=True)
    rig = render_scene(motion, **SCENE)[0].rig
    assert rig.weights.shape == (0, 1)
    assert np.array_equal(rig.rotations, motion.rig.rotations)


def test_frames_are_chosen_first_evenly_or_by_interpolation():
    motion = ball(frames=12, rig=True)
    first = scene_motion(motion, clip=None, frames=7, choose="first")
    assert np.array_equal(first.points, motion.points[:7])
    assert (first.clip_start.tolist(), first.fps) == ([0, 6, 7], 24.0)
    even = scene_motion(motion, clip=None, frames=4, choose="even")
    assert np.array_equal(even.points, motion.points[[0, 4, 7, 11]])
    assert even.clip_start.tolist() == [0, 2, 4]
    assert even.fps == pytest.approx(24 * 3 / 11)
    assert np.array_equal(even.rig.rotations, motion.rig.rotations[[0, 4, 7, 11]])
    assert scene_motion(motion, clip=None, frames=99, choose="first").frames == 12
    clip = scene_motion(motion, clip="two", frames=None, choose="first")
    assert np.array_equal(clip.points, motion.points[6:])
    bare = replace(motion, rig=None, clip_start=np.array([0, 12]), clip_names=("one",))
    dense = scene_motion(bare, clip=None, frames=23, choose="resample")
    np.testing.assert_allclose(dense.points[::2], bare.points, atol=1e-5)
    np.testing.assert_allclose(dense.points[1::2], (bare.points[1:] + bare.points[:-1]) / 2, atol=0.01)
    assert dense.fps == pytest.approx(48)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"clip": "three"}, ["scene.clip", "one, two"]),
        ({"frames": 20, "choose": "resample"}, ["scene.choose", "without a skeleton"]),
    ],
)
def test_wrong_frames_are_one_line(change, words):
    settings = {"clip": None, "frames": None, "choose": "first"} | change
    with pytest.raises(InputError) as error:
        scene_motion(ball(rig=True), **settings)
    assert all(word in str(error.value) for word in words)


def test_bare_points_cannot_be_rendered():
    with pytest.raises(InputError, match="a mesh to render"):
        render_scene(replace(ball(), faces=None), **SCENE)


def test_the_numbers_of_a_scene_and_its_cameras_hold_against_the_surface():
    motion = ball(rig=True)
    capture, views = render_scene(motion, **SCENE)
    found = evaluate_scene(capture, views, motion)
    numbers = dict(zip(found.names, found.values.tolist(), strict=True))
    assert (numbers["images_count"], numbers["views_count"], numbers["frames_count"]) == (12, 4, 6)
    assert numbers["fill_pct"] == pytest.approx(15, abs=1.5)
    assert numbers["on_subject_pct"] == 100
    beside = evaluate_scene(capture, views, replace(motion, points=motion.points + np.float32(0.5)))
    assert beside.values[found.names.index("on_subject_pct")] < 90
    assert scene_picture(capture, views).png[:4].tobytes() == b"\x89PNG"


@pytest.mark.parametrize(("layout", "reader"), [("monocular", dnerf.load), ("multiview", multiview.load)])
def test_a_scene_is_a_folder_in_the_layout_of_its_cameras(tmp_path, layout, reader):
    scene = render_scene(ball(rig=True), **SCENE | {"layout": layout, "fill": 0.1})
    for path, data in scene_files(*scene, name="ball").items():
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / path).write_bytes(data)
    more = {"up": "z", "fps": 1.0, "unit": "unit"} if layout == "monocular" else {}
    for before, after in zip(
        scene, reader(path=str(tmp_path / "ball"), size=None, background="none", **more), strict=True
    ):
        assert before.images.sum(dtype=np.int64) == after.images.sum(dtype=np.int64)
        assert before.fps == after.fps
