"""Benchmarks: what is timed, how results are read, and numbers that are known beforehand."""

from __future__ import annotations

import os
import sys
from dataclasses import replace

import numpy as np
import pytest

from tasks.benchmarks import cgal, cost, dem_bones, rasterizer, stages
from tasks.benchmarks.bones import benchmark_bones
from tasks.benchmarks.scale import scale_bones, subdivided
from tasks.benchmarks.skeleton import benchmark_skeleton, counts, limbs
from tasks.bones.clustering import cluster
from tasks.bones.ssdr import ssdr
from tasks.errors import InputError
from tasks.geometry.measure import vertex_rmse
from tasks.geometry.rotations import from_rotation_vector
from tasks.geometry.skinning import skin
from tasks.values import Canonical, Metrics, Motion
from tests.analytic import shapes
from tests.analytic.test_bones import CLUSTERING, SSDR
from tests.analytic.test_curve_skeleton import ROD, SETTINGS, WYE

OURS = {"clustering": CLUSTERING | {"max_bones": 4, "count": "fixed"}, "decomposition": SSDR}
PEER = {"smooth": 0.0, "affine": 0.0}
RUNS = {"repeats": 3, "peer_repeats": 1, "held_out": True, "threads": 1}


def bending_rod(frames: int = 12) -> tuple[Motion, Canonical]:
    """A rod that bends along its whole length, and swings."""
    vertices, faces = shapes.capsules(ROD, 0.2, 0.08)
    bend = np.sin(np.linspace(0.0, 2 * np.pi, frames, endpoint=False))[:, None]
    turns = np.stack([0.3 * bend * vertices[:, 1], np.zeros_like(bend * vertices[:, 1]), bend * vertices[:, 1]], -1)
    points = np.einsum("fnij,nj->fni", from_rotation_vector(turns), vertices).astype(np.float32)
    motion = Motion("rod", points, faces.astype(np.int32), np.array([0, frames]), ("all",), 24.0)
    return motion, Canonical(points[0], motion.faces, 0, "first")


def named(metrics: Metrics) -> dict[str, float]:
    return dict(zip(metrics.names, metrics.values.tolist(), strict=True))


def measured(**settings: float | None) -> dict[str, float]:
    motion, canonical = bending_rod()
    train, test = motion.take_frames([slice(0, 9)], ["seen"]), motion.take_frames([slice(9, 12)], ["unseen"])
    return named(benchmark_bones(motion, train, test, canonical, **OURS, **RUNS | settings))


def test_a_peer_that_does_the_same_has_ratios_of_one(monkeypatch):
    def twin(motion, canonical, *, bones, influences, smooth, affine):
        clusters = cluster(motion, canonical, **OURS["clustering"] | {"max_bones": bones})
        return lambda: ssdr(motion, canonical, clusters, **SSDR | {"influences": influences})

    monkeypatch.setattr(dem_bones, "prepare", twin)
    monkeypatch.setattr(dem_bones, "skinning", lambda solved, canonical: solved)
    found = measured(**PEER)
    assert found["rmse_ratio"] == found["held_out_rmse_ratio"] == 1.0
    assert found["bones_rmse_pct"] == found["peer_rmse_pct"] > 0
    assert found["bones_count"] == found["peer_bones_count"] == 4
    assert found["time_ratio"] == pytest.approx(found["seconds"] / found["peer_seconds"])
    assert found["time_to_peer_rmse_ratio"] > 0  # the settings as shipped, if no quicker ones, reach their own error


def test_an_error_that_is_never_reached_has_no_time(monkeypatch):
    def exact(motion, canonical, **_):
        return lambda: ssdr(motion, canonical, cluster(motion, canonical, **CLUSTERING), **SSDR | {"iterations": 40})

    monkeypatch.setattr(dem_bones, "prepare", exact)  # three times the bones
    monkeypatch.setattr(dem_bones, "skinning", lambda solved, canonical: solved)
    found = measured(**PEER, held_out=False)
    assert found["rmse_ratio"] > 1
    assert "time_to_peer_rmse_ratio" not in found
    assert "held_out_rmse_ratio" not in found


def test_dem_bones_is_read_as_it_measures_itself():
    pytest.importorskip("py_dem_bones")
    motion, canonical = bending_rod()
    native = dem_bones.prepare(motion, canonical, bones=4, influences=2, **PEER)()
    found = dem_bones.skinning(native, canonical)
    assert found.weights.shape == (motion.points.shape[1], native.nB)
    np.testing.assert_allclose(found.weights.sum(1), 1.0, atol=1e-6)
    assert (found.weights > 0).sum(1).max() <= 2
    rmse = vertex_rmse(skin(found.rest, found.weights, found.transforms), motion.points)
    assert rmse == pytest.approx(native.rmse(), rel=1e-4)


def test_bones_against_the_peer_itself():
    pytest.importorskip("py_dem_bones")
    found = measured(**PEER)
    assert found["rmse_ratio"] < 1.1
    assert found["peer_bones_count"] <= 4


def test_curve_against_the_peer_itself():
    pytest.importorskip("compas_cgal")
    surface = shapes.surface(*shapes.capsules(WYE, 0.2, 0.08))
    found = named(benchmark_skeleton(surface, tracing=SETTINGS, repeats=1, threads=1))
    assert found["curve_leaves"] == found["peer_curve_leaves"] == 3
    assert found["curve_cycles"] == found["peer_curve_cycles"] == 0
    assert found["curve_mapped_pct"] == found["peer_curve_mapped_pct"] == 100.0


def test_counts_of_a_graph_drawn_by_hand():
    surface = shapes.surface(*shapes.sphere(2))
    nodes = np.array([[0.0, 0, 0], [0.5, 0, 0], [0, 0.5, 0], [0, 0, 3.0]])
    edges = np.array([[0, 1], [0, 2], [1, 2], [0, 3]])  # a triangle with a tail whose end is outside
    times = np.ones(len(surface.vertices))
    times[0], times[1] = 0, 2
    found = counts(nodes, edges, times, surface)
    share = 100.0 * (1 - 2 / len(times))
    assert found == {
        "curve_leaves": 1.0,
        "curve_junctions": 1.0,
        "curve_cycles": 1.0,
        "curve_inside_pct": 75.0,
        "curve_mapped_pct": pytest.approx(share),
    }


def test_short_branches_are_no_limbs():
    surface = shapes.surface(*shapes.sphere(3))
    nodes = np.array([[0.0, 0, 0], [1.2, 0, 0], [-1.2, 0, 0], [0, 0.4, 0]])
    edges = np.array([[0, 1], [0, 2], [0, 3]])  # the third is shorter than the radius of 1
    assert limbs(nodes, edges, surface, 1.0) == 2
    assert limbs(nodes, edges, surface, 0.3) == 3


def test_segments_become_a_graph():
    a, b, c = [0.0, 0, 0], [1.0, 0, 0], [2.0, 0, 0]
    nodes, edges, times = cgal.graph([(a, b), (b, c)], [([0, 1], [2]), ([2], [3, 1])], 5)
    assert nodes.tolist() == [a, b, c]
    assert edges.tolist() == [[0, 1], [1, 2]]
    assert times.tolist() == [1, 2, 1, 1, 0]


def test_a_missing_extra_says_what_to_install(monkeypatch):
    for package in ("py_dem_bones", "compas_cgal.skeletonization"):
        monkeypatch.setitem(sys.modules, package, None)
    install = r'pip install -e "\.\[bench\]"'
    with pytest.raises(InputError, match=install):
        dem_bones.prepare(*bending_rod(), bones=2, influences=2, **PEER)
    with pytest.raises(InputError, match=install):
        cgal.prepare(shapes.surface(*shapes.sphere(1)))


def test_bare_points_are_nothing_for_dem_bones():
    motion, canonical = bending_rod()
    with pytest.raises(InputError, match="faces"):
        dem_bones.prepare(replace(motion, faces=None), canonical, bones=2, influences=2, **PEER)


def test_both_take_turns_and_getting_ready_comes_first():
    log = []

    def prepare(who):
        log.append(f"prepare {who}")
        return lambda: log.append(who) or who

    found = cost.in_turn(lambda: prepare("ours"), lambda: prepare("peer"), (2, 1))
    assert log == ["prepare ours", "ours", "prepare peer", "peer", "prepare ours", "ours"]
    assert [result for result, _ in found] == ["ours", "peer"]


def test_median_of_times_and_most_memory():
    costs = [cost.Cost(s, 2 * s, m) for s, m in ((3.0, 1.0), (1.0, 5.0), (2.0, None))]
    assert cost.median(costs) == cost.Cost(2.0, 4.0, 5.0)


def test_memory_at_the_peak_not_at_the_end():
    _, found = cost.measure(lambda: np.ones(50 * 2**17).sum())
    if found.memory is None:
        pytest.skip("the system does not say")
    assert 45 < found.memory < 75


def test_threads_are_held_and_given_back(monkeypatch):
    monkeypatch.setenv("SKELEBONES_THREADS", "7")
    with cost.threads_held(2):
        assert os.environ["SKELEBONES_THREADS"] == "2"
    assert os.environ["SKELEBONES_THREADS"] == "7"
    with cost.threads_held(0):
        assert os.environ["SKELEBONES_THREADS"] == "7"


def test_finer_meshes_are_the_same_surface_and_move_with_it():
    motion, canonical = bending_rod(frames=3)
    fine, shape = subdivided(motion, canonical)
    points, triangles = motion.points.shape[1], len(motion.faces)
    assert len(fine.faces) == 4 * triangles
    assert fine.points.shape[1] == points + 3 * triangles // 2  # a middle for every edge of a closed surface
    np.testing.assert_array_equal(fine.points[:, :points], motion.points)
    for frame, coarse in zip([*fine.points, shape.points], [*motion.points, canonical.points], strict=True):
        assert shapes.volume(frame, fine.faces) == pytest.approx(shapes.volume(coarse, motion.faces), rel=1e-5)


def test_scale_times_every_size_and_draws_them():
    motion, canonical = bending_rod()
    settings = {"subdivisions": 1, "shares": [0.5, 1.0], "repeats": 1, "threads": 1}
    metrics, picture = scale_bones(motion, canonical, **OURS, **settings)
    found = named(metrics)
    points = motion.points.shape[1]
    sizes = {name.split("@")[1] for name in found if "@" in name}
    assert sizes == {f"{points}x6", f"{points}x12", f"{4 * points - 6}x12"}  # Euler's formula, a closed surface
    assert found["points_count"] == 4 * points - 6
    assert np.isfinite([found["points_exponent"], found["frames_exponent"]]).all()
    assert picture.svg.startswith("<svg")


def a_ball() -> Canonical:
    import igl

    vertices, faces = igl.icosahedron()[:2]
    return Canonical(vertices.astype(np.float32), faces.astype(np.int32), 0, "rest")


RASTER = {"gaussians": [200], "sizes": [40], "threads": [1, 2], "repeats": 3, "seed": 0}


def test_a_rasterizer_that_is_ours_has_ratios_near_one(monkeypatch):
    """The twin draws the same Gaussians with our own kernel; case by case, all six numbers."""
    import torch

    from tasks.reconstruction.rasterize import rasterize

    class Twin:
        def __init__(self, *, size, **scene):
            self.given, self.size = {name: torch.from_numpy(a) for name, a in scene.items()}, size

        def forward(self):
            self.images = rasterize(**self.given, size=self.size, background=torch.zeros(3))

        def backward(self, of_rgb, of_alpha):
            assert of_rgb.shape == (40, 40, 3)
            assert of_alpha.shape == (40, 40)
            assert 0.4 < float(self.images[1].mean()) < 0.9  # a ball four fifths as wide as the image, and its blur

    monkeypatch.setattr(rasterizer, "_library", lambda: Twin)
    found = named(rasterizer.benchmark_rasterizer(a_ball(), **RASTER))
    assert len(found) == 2 + 2 * 6
    case = "200 at 40 px, 1 thread"
    assert found[f"time_ratio@{case}"] == found[f"step_ms@{case}"] / found[f"peer_step_ms@{case}"]
    assert found["forward_ratio"] == found[f"forward_ratio@{case}"]


@pytest.mark.slow
def test_the_peer_in_warp_draws_what_ours_draws():
    """Or its time would mean nothing: images and gradients agree to float32."""
    pytest.importorskip("warp", reason="needs the extra bench (warp-lang)")
    import torch

    from tasks.reconstruction.rasterize import rasterize

    scene = rasterizer.covering(a_ball(), 300, 40, 0)
    slopes = np.random.default_rng(0).normal(size=(40, 40, 4)).astype(np.float32)
    peer = rasterizer._library()(**scene, size=(40, 40))
    theirs = [*peer.forward(), *peer.backward(slopes[..., :3], slopes[..., 3])]
    given = {name: torch.from_numpy(a).requires_grad_(name in scene) for name, a in scene.items()}
    images = rasterize(**given, size=(40, 40), background=torch.zeros(3))
    of_images = [torch.from_numpy(slopes[..., :3].copy()), torch.from_numpy(slopes[..., 3])]
    leaves = [given[name] for name in ("means", "scales", "sh", "opacities")]
    ours = [*images, *torch.autograd.grad(images[:2], leaves, of_images)]
    for a, b in zip(theirs, (t.detach().numpy() for t in ours), strict=True):
        assert np.abs(a.reshape(b.shape) - b).max() < 2e-5 * np.abs(b).max()


def test_all_stages_are_timed_and_add_up(monkeypatch):
    """What the stages do is tested elsewhere: here they hand on names, to see that each is timed with its settings."""
    names = ("cluster", "ssdr", "closed_surface", "curve_skeleton", "joints_by_motion", "find_parts", "build_database")
    seen = []

    def stage(name):
        return lambda *_, **settings: seen.append((name, settings)) or name

    for name in (*names, "fit_poses"):
        monkeypatch.setattr(stages, name, stage(name))
    monkeypatch.setattr(stages.partmm, "animate", stage("animate"))
    motion, canonical = bending_rod(frames=3)
    own = {"decomposition": {}, "closing": {}, "tracing": {"speed": 1}, "jointing": {}, "posing": {}, "parting": {}}
    settings = {"clustering": {"max_bones": 4}, **own, "matching": {"k": 7}}
    size = {"subdivisions": 1, "repeats": 2, "threads": 1}
    found = named(stages.benchmark_stages(motion, motion, canonical, **settings, **size))
    each = [found[f"seconds@{n}"] for n in ("clusters", "bones", "surface", "curve", "skeleton", "poses", "PartMM")]
    assert 0 < sum(each) < found["seconds"]
    assert found["points_count"] == subdivided(motion, canonical)[0].points.shape[1]
    assert (found["frames_count"], found["bones_count"]) == (3, 4)
    assert [s for n, s in seen if n == "curve_skeleton"] == [{"speed": 1}] * 3  # once to compile, twice timed
