"""The renderer against pixels worked out by hand, charts, and figures of small shapes."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from dataclasses import replace

import cv2
import numpy as np
import pytest
import trimesh

from tasks.drawing import colours, figures, plot, render
from tasks.geometry import rigid
from tasks.geometry.rotations import from_rotation_vector
from tasks.values import Canonical, Clusters, Motion, Parts, Rig, Skeleton, Skinning


def raster(corners: list, near: list, faces: list, size: int = 4):
    ones = np.ones(len(corners))
    return render.rasterise(
        np.array(corners, float), np.array(near, float), ones, np.array(faces, np.int32), size, size
    )


def test_a_triangle_covers_the_pixels_whose_centres_it_holds():
    """Corners (0, 0), (4, 0), (0, 4): a centre (x + 1/2, y + 1/2) is inside where x + y <= 3, edge included."""
    face, shares, depth = raster([[0, 0], [4, 0], [0, 4]], [0, 4, 8], [[0, 1, 2]])
    x, y = np.meshgrid(np.arange(4), np.arange(4))
    inside = x + y <= 3
    assert np.array_equal(face == 0, inside)
    assert np.array_equal(face == -1, ~inside)
    expected = np.stack([1 - (x + y + 1) / 4, (x + 0.5) / 4, (y + 0.5) / 4], axis=-1)
    assert shares[inside] == pytest.approx(expected[inside], abs=1e-6)
    assert depth[inside] == pytest.approx((x + 0.5 + 2 * (y + 0.5))[inside])


def test_the_nearer_triangle_is_seen_whatever_the_order_and_the_winding():
    square = [[0, 0], [8, 0], [0, 8]]
    for faces in ([[0, 1, 2], [3, 4, 5]], [[3, 5, 4], [0, 2, 1]]):
        face, _, depth = raster(square + square, [1, 1, 1, 2, 2, 2], faces)
        assert depth[0, 0] == 2
        assert faces[face[0, 0]][0] == 3


def test_nothing_is_drawn_of_triangles_without_area_or_off_the_canvas():
    face, _, _ = raster([[0, 0], [2, 2], [4, 4], [9, 9], [12, 9], [9, 12]], [0] * 6, [[0, 1, 2], [3, 4, 5]])
    assert (face == -1).all()


def test_two_triangles_of_a_square_leave_no_gap():
    rng = np.random.default_rng(0)
    corners = np.array([[2.0, 1.0], [29.0, 3.0], [27.0, 30.0], [1.0, 28.0]]) + rng.uniform(-0.5, 0.5, (4, 2))
    face, _, _ = raster(corners, [0] * 4, [[0, 1, 2], [0, 2, 3]], 32)
    x, y = np.meshgrid(np.arange(32) + 0.5, np.arange(32) + 0.5)
    inside = np.ones((32, 32), bool)
    for a, b in zip(corners, np.roll(corners, -1, 0), strict=True):
        inside &= (b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0]) >= 0
    assert np.array_equal(face >= 0, inside)


def reference(pixels, near, weight, faces, height, width):
    """The rasteriser in plain numpy, a triangle at a time over the whole canvas."""
    face, shares = np.full((height, width), -1), np.zeros((height, width, 3))
    depth = np.full((height, width), -np.inf)
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    for t, f in enumerate(faces):
        matrix = np.vstack([pixels[f].T, np.ones(3)])
        if abs(np.linalg.det(matrix)) < 1e-12:
            continue
        share = np.stack([x, y, np.ones_like(x)], axis=-1) @ np.linalg.inv(matrix).T
        z = share @ near[f]
        seen = (share.min(-1) >= -1e-12) & (z > depth)
        face[seen], depth[seen] = t, z[seen]
        part = share[seen] * weight[f]
        shares[seen] = part / part.sum(-1, keepdims=True)
    return face, shares, depth


@pytest.mark.parametrize("distance", [0.0, 3.0])
def test_rasteriser_against_its_reference(distance):
    ball = trimesh.creation.icosphere(subdivisions=2)
    points, faces = np.asarray(ball.vertices), np.asarray(ball.faces, np.int32)
    camera = render.look(points, azimuth=0.4, elevation=0.3, width=24, height=20, distance=distance)
    pixels, near = camera.project(points)
    weight = near if distance else np.ones_like(near)
    made = render.rasterise(pixels, near, weight, faces, camera.height, camera.width)
    true = reference(pixels, near, weight, faces, camera.height, camera.width)
    assert np.mean(made[0] != true[0]) < 0.002  # centres on an edge may fall to either side of it
    same = made[0] == true[0]
    assert made[1][same] == pytest.approx(true[1][same], abs=1e-5)
    # shares give back the point of the surface that the pixel's centre sees, also in perspective
    hit = made[0] >= 0
    seen = (points[faces[made[0][hit]]] * made[1][hit][..., None]).sum(1)
    y, x = np.nonzero(hit)
    assert camera.project(seen)[0] == pytest.approx(np.stack([x + 0.5, y + 0.5], axis=-1), abs=1e-3)


def test_the_camera_frames_the_shape_and_knows_left_from_right():
    rng = np.random.default_rng(0)
    points = rng.standard_normal((200, 3)) * [3, 1, 2] + 50
    for distance in (0.0, 4.0):
        camera = render.look(points, azimuth=2.0, elevation=0.3, width=60, height=40, distance=distance, margin=0.1)
        pixels, _ = camera.project(points)
        free = np.abs(pixels / [camera.width, camera.height] - 0.5).max(0)
        assert free.max() == pytest.approx(0.4, abs=1e-7)
    front = render.look(points, azimuth=0.0, elevation=0.0, width=60, height=40)
    axes, near = front.project(front.centre + np.eye(3))
    here, origin = front.project(front.centre[None])
    assert axes[0, 0] > here[0, 0]  # +X is right, +Y up, +Z towards the viewer
    assert axes[1, 1] < here[0, 1]
    assert near[2] > origin[0]
    side = render.look(points, azimuth=np.pi / 2, elevation=0.0, width=60, height=40)
    assert side.project(side.centre + np.eye(3)[:1])[1] > side.project(side.centre[None])[1]


def test_broadside_sees_the_widest_side():
    rng = np.random.default_rng(1)
    for turn in (0.0, 0.7, 2.1):
        spin = from_rotation_vector(np.array([0, turn, 0]))
        points = (rng.standard_normal((4000, 3)) * [5, 1, 1]) @ spin.T
        assert abs(np.sin(render.broadside(points, 0.0) - turn)) < 0.05


def test_normals_of_a_sphere_point_outwards():
    ball = trimesh.creation.icosphere(subdivisions=3)
    normals = render.vertex_normals(np.asarray(ball.vertices), np.asarray(ball.faces))
    assert (normals * ball.vertices).sum(1).min() > 0.999


def test_a_painted_sphere_is_lit_from_the_upper_left_and_round():
    ball = trimesh.creation.icosphere(subdivisions=4)
    points = np.asarray(ball.vertices)
    camera = render.look(points, azimuth=0, elevation=0, width=100, height=100, margin=0.1)
    surface, spheres = render.blank(100, 100), render.blank(100, 100)
    render.paint_mesh(surface, camera, points, np.asarray(ball.faces), colours.CLAY)
    render.paint_points(spheres, camera, np.zeros((1, 3)), colours.CLAY, 1.0)
    image = render.finish(surface).astype(float)
    covered = (image < 250).any(-1)
    assert covered.mean() == pytest.approx(np.pi * 0.4**2, rel=0.02)
    assert image[30, 35].mean() > image[70, 65].mean() + 20
    assert np.abs(image - render.finish(spheres)).mean() < 1.5  # a mesh of a ball and a ball look alike


def test_glass_lets_through_what_is_behind():
    ball = trimesh.creation.icosphere(subdivisions=3)
    points = np.asarray(ball.vertices)
    camera = render.look(points, azimuth=0, elevation=0, width=40, height=40)
    canvas = render.blank(40, 40)
    canvas[:] = (255, 0, 0)
    render.paint_mesh(canvas, camera, points, np.asarray(ball.faces), colours.CLAY, opacity=0.2, rim=0.6)
    image = render.finish(canvas).astype(int)
    assert image[20, 20, 0] - image[20, 20, 1] > 150  # still red in the middle
    assert image[20, 3, 1] > image[20, 20, 1] + 30  # the rim hides more


def test_png_keeps_pixels_and_channels():
    image = np.random.default_rng(0).integers(0, 256, (5, 7, 3), dtype=np.uint8)
    back = cv2.imdecode(np.frombuffer(render.png(image), np.uint8), cv2.IMREAD_COLOR)
    assert np.array_equal(back[:, :, ::-1], image)


def test_colour_maps_fall_evenly_in_lightness():
    for table in (colours.error_map, colours.weight_map):
        ramp = table(np.linspace(0, 1, 21))
        lab = cv2.cvtColor(ramp.reshape(-1, 1, 3).astype(np.float32), cv2.COLOR_RGB2Lab)[:, 0]
        steps = np.diff(lab[:, 0])
        assert (steps < -2).all()
        assert (steps > -6).all()
        assert np.array_equal(table(np.array([-1.0, 2.0])), table(np.array([0.0, 1.0])))
    bones = colours.bone_colours(30)
    assert len(np.unique(np.round(bones, 3), axis=0)) == 30
    assert colours.bone_colours(0).shape == (0, 3)
    assert colours.part_colours(12).shape == (12, 3)


def test_round_steps():
    assert [plot.round_up(v) for v in (0.0, 0.9, 1.0, 1.1, 2.2, 4.9, 51, 0.013)] == [1, 1, 1, 2, 2.5, 5, 100, 0.02]
    assert plot.round_up(2.6, (1, 1.5, 2, 3, 4, 5, 6, 8, 10)) == 3


def points_of(svg: str, tag: str) -> list:
    tree = ET.fromstring(svg)
    return [e.attrib for e in tree.iter() if e.tag.endswith(tag)]


def test_a_chart_puts_points_where_they_belong():
    one = plot.Series("a < b", np.array([10, 20, 30]), np.array([4.0, 0.0, 2.0]))
    two = plot.Series("c", np.array([30, 10]), np.array([1.0, 3.0]), np.array([0.5, 0.5]))
    svg = plot.lines([one, two], x="count", y="error [%]", marks=[(20, "chosen: 20")])
    dots = np.array([[float(e["cx"]), float(e["cy"])] for e in points_of(svg, "circle")])
    assert np.allclose(np.diff(dots[:3, 0]), dots[1, 0] - dots[0, 0])
    assert dots[2, 1] == pytest.approx((dots[0, 1] + dots[1, 1]) / 2, abs=0.11)  # 2 lies midway between 4 and 0
    assert dots[3, 0] == dots[0, 0]  # sorted along x
    (band,) = points_of(svg, "polygon")
    assert len(band["points"].split()) == 4
    texts = [e.text for e in ET.fromstring(svg).iter() if e.tag.endswith("text")]
    assert {"count", "error [%]", "chosen: 20", "a < b", "c", "0", "2", "4"} <= set(texts)


def test_a_chart_with_logarithmic_axes():
    ramp = plot.Series("a", np.array([1, 10, 100]), np.array([0.1, 1.0, 10.0]))
    dots = points_of(plot.lines([ramp], x="n", y="e", log_x=True, log_y=True), "circle")
    across = [float(e["cx"]) for e in dots]
    assert across[1] - across[0] == pytest.approx(across[2] - across[1], abs=0.11)
    with pytest.raises(ValueError, match="positive"):
        plot.lines([plot.Series("a", np.array([0, 1]), np.array([1, 2]))], x="n", y="e", log_x=True)


def test_a_chart_of_one_point():
    svg = plot.lines([plot.Series("a", np.array([3]), np.array([0.0]))], x="n", y="e")
    assert "nan" not in svg
    assert len(points_of(svg, "circle")) == 1


@pytest.fixture(scope="module")
def walker() -> tuple[Motion, Canonical, Skinning, Skeleton, Parts]:
    """A capsule along +Y that walks along -Z, away from a viewer at +Z; two bones, two joints, two parts."""
    mesh = trimesh.creation.capsule(height=2.0, radius=0.5, count=[12, 12])
    points = np.asarray(mesh.vertices, np.float32)[:, [0, 2, 1]] * [1, 1, 0.5]
    path = np.zeros((5, 1, 3))
    path[:, 0, 2] = -np.arange(5)
    clip_start = np.array([0, 2, 5])
    frames = (points + path).astype(np.float32)
    motion = Motion("walker", frames, np.asarray(mesh.faces, np.int32), clip_start, ("a", "b"), 10.0, "m")
    upper = np.clip((points[:, 1] - points[:, 1].mean()) / 2 + 0.5, 0, 1)
    weights = np.stack([1 - upper, upper], axis=1).astype(np.float32)
    skinning = Skinning(points, weights, rigid.identity(5, 2), np.array([0.3, 0.1]))
    joints = np.array([[0, 0.5, 0], [0, 1.5, 0]], np.float32)
    skeleton = Skeleton(("low", "high"), np.array([-1, 0], np.int32), joints, weights)
    parts = Parts(("legs", "chest"), np.eye(2, dtype=bool), np.array([0, 1], np.int32), np.eye(2, dtype=np.float32))
    return motion, Canonical(frames[0], motion.faces, 0, "first"), skinning, skeleton, parts


def test_the_eye_is_where_it_walks_to(walker):
    motion, *_ = walker
    assert np.cos(figures.azimuth_of(motion)) < 0  # on the side of -Z


def test_a_skeleton_that_stands_out_of_its_shape_is_not_cut_off(walker):
    _, shape, _, skeleton, _ = walker
    long = replace(skeleton, joints=skeleton.joints * np.array([1, 3, 1], np.float32))
    image = figures.skeleton_figure(shape, long, None, azimuth=0.5)
    paper = image[0, 0]
    edge = np.concatenate([image[0], image[:, 0], image[:, -1]])
    assert (np.abs(edge.astype(int) - paper).max(-1) < 8).all()


def test_what_is_as_broad_as_long_is_seen_from_the_front_of_its_skeleton():
    turn = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    ring = np.stack([np.cos(turn), 0 * turn, np.sin(turn)], axis=1).astype(np.float32)
    points = np.stack([ring, ring + np.float32(0.1)]).astype(np.float32)
    joints = np.array([[0, 0, 0], [2, 0, 0], [-2, 0, 0]], np.float32)  # arms along x: the front is +z
    still = np.broadcast_to(np.eye(3, dtype=np.float32), (2, 3, 3, 3)), np.zeros((2, 3, 3), np.float32)
    rig = Rig(("hip", "left", "right"), np.array([-1, 0, 0]), joints, np.ones((40, 3), np.float32) / 3, *still)
    motion = Motion("ring", points, None, np.array([0, 2]), ("turn",), 30.0, rig=rig)
    assert figures.azimuth_of(motion) == pytest.approx(0.55)  # a little to the side, for depth
    quarter = np.array([[0, 0, 1], [0, 1, 0], [-1, 0, 0]], np.float32)
    rotations = still[0].copy()
    rotations[:, 0] = quarter  # the body turns to +x
    turned = replace(motion, rig=replace(rig, rotations=rotations))
    assert abs(np.sin(figures.azimuth_of(turned) - 0.55)) == pytest.approx(1.0)


def test_error_figure_colours_by_error_on_one_scale(walker):
    motion, *_ = walker
    good, bad = motion.points.copy(), motion.points.copy()
    bad[4] += [0.2, 0, 0]
    azimuth = figures.azimuth_of(motion)
    image = figures.error_figure(motion, {"good": good, "bad": bad}, 2.5, focus="bad", azimuth=azimuth)
    height, width = image.shape[:2]
    panel = (width - 104) // 3
    middle = image[height // 4, [panel // 2, panel + panel // 2, 2 * panel + panel // 2]].astype(int)
    worst = image[3 * height // 4 - 20, [panel + panel // 2, 2 * panel + panel // 2]].astype(int)
    assert np.ptp(middle[1]) < 40  # no error in the median frame: pale
    assert np.abs(middle[1] - middle[2]).max() <= 2
    assert worst[1].mean() < worst[0].mean() - 40  # 200 mm in the worst: dark
    assert image.dtype == np.uint8


def test_a_line_of_text_shrinks_into_its_room():
    wide, narrow = render.blank(200, 30), render.blank(200, 30)
    render.text(wide, "a rather long name of a clip", (100, 20), align="middle")
    render.text(narrow, "a rather long name of a clip", (100, 20), align="middle", room=60)
    spans = [np.ptp(np.nonzero((c < 200).any((0, 2)))[0]) / render.SUPERSAMPLE for c in (wide, narrow)]
    assert spans[0] > 100
    assert 40 < spans[1] <= 62


def test_figures_of_surfaces_and_of_bare_points(walker):
    motion, canonical, skinning, skeleton, parts = walker
    for faces in (canonical.faces, None):
        shape = Canonical(canonical.points, faces, 0, "first")
        azimuth = figures.azimuth_of(motion)
        images = [
            figures.skeleton_figure(shape, skeleton, parts, azimuth=azimuth),
            figures.skeleton_figure(shape, skeleton, None, azimuth=azimuth, theme="dark"),
            figures.parts_figure(shape, skinning, parts, azimuth=azimuth),
            figures.bones_figure(shape, skinning, azimuth=azimuth),
        ]
        for image in images:
            assert image.dtype == np.uint8
            assert (
                0.02 < np.mean(np.abs(image.astype(int) - image[0, 0]).max(-1) > 8) < 0.9
            )  # something, not everything


def test_the_chosen_count_is_marked():
    clusters = Clusters(
        np.zeros(4, np.int32), np.zeros((2, 3, 3, 4)), np.ones(4, bool), np.array([1, 2, 3]), np.array([0.4, 0.2, 0.1])
    )
    assert "chosen: 3" in figures.count_figure(clusters, 2.0)
