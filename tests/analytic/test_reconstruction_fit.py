"""Fitting Gaussians: its kernels against slow references, its start, and a planted scene found again."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import yaml

from tasks.errors import InputError
from tasks.reconstruction import adam, cuts, density, fitting
from tasks.reconstruction.curriculum import Schedule, Window
from tasks.reconstruction.fit import fit
from tasks.reconstruction.hull import hull_start, nearest_views, whereabouts
from tasks.reconstruction.motion import motion_of
from tasks.reconstruction.nodes import Nodes
from tasks.reconstruction.rasterize import EPS2D, rasterize
from tasks.reconstruction.rigidity import Neighbourhood, best_rotations, rotation_of
from tasks.reconstruction.skin import Skin, skin_reference
from tasks.reconstruction.splines import spline
from tasks.reconstruction.visibility import shown
from tasks.values import Capture, same
from tasks.workspace import Workspace

CONF = Path(__file__).parents[2] / "conf" / "reconstruction"
SIZE, FRAMES = 40, 12


def look_at(eye: np.ndarray, target: np.ndarray) -> np.ndarray:
    """World to camera, x right, y down, z forward."""
    z = (target - eye) / np.linalg.norm(target - eye)
    x = np.cross(z, [0.0, 1.0, 0.0])
    x /= np.linalg.norm(x)
    turn = np.stack([x, np.cross(z, x), z])
    view = np.eye(4)
    view[:3, :3], view[:3, 3] = turn, -turn @ eye
    return view


def planted(clips: tuple[int, ...] = (FRAMES,), images: int = 60) -> tuple[Capture, np.ndarray]:
    """A coloured ball of Gaussians that goes 0.6 along x, and where it is in every frame (F, N, 3)."""
    random = np.random.default_rng(0)
    ball = random.normal(size=(300, 3))
    ball = (0.5 * ball / np.linalg.norm(ball, axis=1, keepdims=True)).astype(np.float32)
    colour = ((ball + 0.5 - 0.5) / 0.28)[:, None].astype(np.float32)
    frames = sum(clips)
    along = np.concatenate([np.linspace(-0.3, 0.3, c) for c in clips]).astype(np.float32)
    points = ball + along[:, None, None] * np.float32([1, 0, 0]) + np.float32([3, 1, 0])
    frame = np.arange(images) * frames // images
    angle = random.uniform(0, 2 * np.pi, images)
    eye = np.stack([3 + 4 * np.cos(angle), 1 + random.uniform(-1, 3, images), 4 * np.sin(angle)], axis=1)
    view = np.stack([look_at(e, np.array([3.0, 1.0, 0.0])) for e in eye]).astype(np.float32)
    lens = np.array([[60, 0, SIZE / 2], [0, 60, SIZE / 2], [0, 0, 1]], np.float32)
    drawn = np.zeros((images, SIZE, SIZE, 4), np.uint8)
    for i, f in enumerate(frame):
        given = [points[f], np.full((300, 1), 0.06), np.full(300, 0.95), colour, view[i], lens]
        tensors = [torch.tensor(np.asarray(a, np.float32)) for a in given]
        rgb, alpha, _ = rasterize(*tensors, (SIZE, SIZE), torch.zeros(3))
        straight = rgb / alpha[..., None].clamp(min=1e-3)
        drawn[i] = (255 * torch.cat([straight, alpha[..., None]], 2)).clamp(0, 255).round().numpy()
    capture = Capture(
        name="ball",
        images=drawn,
        has_alpha=True,
        background=np.ones(3, np.float32),
        view=view,
        intrinsics=np.tile(lens, (images, 1, 1)),
        camera=np.arange(images, dtype=np.int32),
        frame=frame.astype(np.int32),
        times=np.linspace(0, 1, frames).astype(np.float32),
        fps=24.0,
        clip_start=np.concatenate([[0], np.cumsum(clips)]).astype(np.int64),
        clip_names=tuple(f"clip{c}" for c in range(len(clips))),
    )
    return capture, points


def settings(name: str = "cpu", **changed: object) -> dict:
    """A preset, small enough for a test."""
    conf = yaml.safe_load((CONF / f"{name}.yaml").read_text("utf-8"))
    del conf["kind"], conf["defaults"]
    small = {"backend": "numba", "iterations": 60, "gaussians": 200, "max_gaussians": 300, "carriers": 24}
    small |= {"hull_cells": 32, "divide_every": 20, "coarsest": 0.5, "depth": 3, "width": 16, "skip": 1, "seed": 3}
    return conf | small | changed


# kernels


def test_skin_and_its_gradient_agree_with_autograd():
    random = torch.Generator().manual_seed(0)
    points, transforms = (torch.randn(*s, generator=random) for s in ((50, 3), (7, 3, 4)))
    index = torch.randint(0, 7, (50, 4), generator=random, dtype=torch.int32)
    weights = torch.rand(50, 4, generator=random)
    wanted = torch.randn(50, 3, generator=random)
    found = []
    for function in (Skin.apply, skin_reference):
        given = [points.clone().requires_grad_(), transforms.clone().requires_grad_()]
        out = function(*given, index, weights)
        (out * wanted).sum().backward()
        found.append([out.detach(), given[0].grad, given[1].grad])
    for mine, reference in zip(*found, strict=True):
        torch.testing.assert_close(mine, reference, rtol=1e-5, atol=1e-5)


def test_adam_is_torchs_adam():
    random = torch.Generator().manual_seed(0)
    value = torch.randn(40, 3, generator=random)
    theirs = value.clone().requires_grad_()
    optimiser = torch.optim.Adam([theirs], lr=0.01, betas=adam.BETAS, eps=adam.EPSILON)
    mine, own = value.clone().requires_grad_(), adam.Adam()
    for k in range(1, 6):
        gradient = torch.randn(40, 3, generator=random)
        theirs.grad, mine.grad = gradient.clone(), gradient.clone()
        optimiser.step()
        own.step("value", mine, 0.01, k)
    torch.testing.assert_close(mine, theirs, rtol=1e-5, atol=1e-6)


def test_gaussians_are_blurred_by_so_many_pixels_at_first_and_then_no_more(tmp_path):
    capture, _ = planted(images=10)
    recipe = SimpleNamespace(**settings(iterations=100, full=0.5, blur=0.4))
    fitted = fitting.Fitting(capture, recipe, Workspace(tmp_path))
    view = cuts.Views(capture, 1.0, fitted.centre, fitted.unit, "cpu")[3]
    pixels = float(view.intrinsics[0, 0] / view.view[2, 3])  # to a unit of length at the thing's middle
    for fitted.iteration, variance in ((0, 0.4), (25, 0.2), (50, 0.0), (99, 0.0)):
        blurred = fitted._blurred(torch.full((5, 1), 0.5 / pixels), view)
        np.testing.assert_allclose((blurred.numpy() * pixels) ** 2, 0.25 + variance, rtol=1e-5)


# splines and nodes


def test_splines_sum_to_one_and_keep_clips_apart():
    found = spline(np.array([0, 30, 31, 50]), 4.0)
    np.testing.assert_allclose(found.weights.sum(1), 1.0, atol=1e-6)
    for clip, (a, b) in enumerate(((0, 30), (30, 31), (31, 50))):
        used = found.first[a:b]
        assert used.min() >= found.clip_knots[clip]
        assert used.max() + 4 <= found.clip_knots[clip + 1]


def test_splines_follow_a_line_exactly():
    found = spline(np.array([0, 21]), 4.0)
    knots = np.arange(found.knots, dtype=float)
    values = (found.weights * knots[found.first[:, None] + np.arange(4)]).sum(1)
    np.testing.assert_allclose(np.diff(values), 5 / 20, atol=1e-5)


def test_nodes_at_rest_move_nothing_and_the_coarsest_moves_all():
    points = np.random.default_rng(0).normal(size=(400, 3)).astype(np.float32)
    nodes = Nodes.placed(spline(np.array([0, 10]), 5.0), points, 64)
    nodes.bind(points)
    means = torch.from_numpy(points)
    torch.testing.assert_close(nodes.at(3, means).means, means, rtol=0, atol=1e-5)
    with torch.no_grad():
        nodes.table[:, -1, 1:4] = torch.tensor([0.2, -0.4, 0.3])
        nodes.table[:, -1, 4:] = torch.tensor([1.0, 2.0, 3.0])
    moved = nodes.at(3, means)
    rigid, kept = Neighbourhood(nodes.rest, 8).rigidity(moved.carriers, moved.turns)
    assert rigid.item() < 1e-9
    assert kept.item() < 1e-9
    assert float((moved.means.detach() - means).norm(dim=1).min()) > 0.5
    before, after = (torch.pdist(m.detach()[:50]) for m in (means, moved.means))
    torch.testing.assert_close(after, before, rtol=1e-4, atol=1e-4)


def test_knots_of_unseen_frames_are_copied_within_their_clip():
    points = np.random.default_rng(0).normal(size=(50, 3)).astype(np.float32)
    nodes = Nodes.placed(spline(np.array([0, 20, 40]), 2.0), points, 16)
    with torch.no_grad():
        nodes.table += torch.arange(len(nodes.table))[:, None, None]
    before = nodes.table.detach().clone()
    nodes.copy_outwards(8, 12, 0)
    low, high = int(nodes.spline.first[8]) + 1, int(nodes.spline.first[12]) + 2
    assert torch.equal(nodes.table[: low + 1], before[low : low + 1].expand(low + 1, -1, -1))
    assert torch.equal(nodes.table[low : high + 1], before[low : high + 1])
    assert (nodes.table[high : nodes.spline.clip_knots[1]] == before[high]).all()
    assert torch.equal(nodes.table[nodes.spline.clip_knots[1] :], before[nodes.spline.clip_knots[1] :])


# rigidity


@pytest.mark.parametrize("kind", ["own", "svd"])
def test_rigidity_is_zero_under_rigid_motion_only(kind):
    random = torch.Generator().manual_seed(1)
    rest = torch.randn(60, 3, generator=random, dtype=torch.float64)
    turn = rotation_of(torch.tensor([[0.3, -1.1, 0.5]], dtype=torch.float64))
    moved = rest @ turn[0].T + torch.tensor([1.0, 2.0, 3.0])
    near = Neighbourhood(rest, 8)
    turns = turn.expand(60, 3, 3) if kind == "own" else None
    rigid, kept = near.rigidity(moved, turns)
    assert float(rigid) < 1e-11
    assert float(kept) < 1e-11
    rigid, kept = near.rigidity(1.1 * moved, turns)
    assert float(rigid) == pytest.approx(0.01, rel=1e-3)
    assert float(kept) == pytest.approx(0.01, rel=1e-3)


def test_best_rotation_never_reflects():
    source = torch.randn(1, 8, 3, generator=torch.Generator().manual_seed(2))
    mirrored = source * torch.tensor([-1.0, 1.0, 1.0])
    assert float(torch.det(best_rotations(source, mirrored)[0])) == pytest.approx(1.0, abs=1e-5)


# start and curriculum


def test_hull_of_a_ball_lies_on_the_ball():
    capture, points = planted()
    start = hull_start(capture, frame=6, views=10, agree=0.9, cells=48)
    far = np.linalg.norm(start.points - points[6].mean(0), axis=1)
    assert start.frame == 6
    assert start.recall > 0.9
    assert 0.5 < np.median(far) < 0.68  # the ball with its Gaussians' width; a hull is never smaller than the thing
    centre, radius = whereabouts(capture)
    assert np.linalg.norm(centre - [3, 1, 0]) < 0.2
    assert 0.5 < radius < 1.3


def test_views_near_in_time_come_from_the_same_clip():
    capture, _ = planted((6, 6))
    chosen = nearest_views(capture, 5, 12)
    assert (capture.frame[chosen] < 6).all()


def test_window_grows_from_the_start_over_all_clips():
    capture, _ = planted((12, 8))
    start = hull_start(capture, frame=5, views=9, agree=0.8, cells=32)
    window = Window(capture, start, 9)
    assert window.frames(0.0)[1][1] < window.frames(0.0)[1][0]
    assert set(window.images(window.frames(0.0))) == set(window.first_images)
    assert window.frames(1.0) == [(0, 11), (12, 19)]
    counts = [len(window.images(window.frames(g))) for g in np.linspace(0, 1, 9)]
    assert counts == sorted(counts)
    assert counts[-1] == len(capture.images)


def test_sizes_double_up_to_the_whole():
    schedule = Schedule(1000, 0.1, 0.5, 0.25, 0.4)
    assert schedule.sizes() == [0.25, 0.5, 1.0]
    assert [schedule.size(i) for i in (0, 199, 200, 399, 400, 999)] == [0, 0, 1, 1, 2, 2]


# density


def test_division_reuses_transparent_gaussians_then_grows():
    params = {
        "means": torch.zeros(10, 3),
        "log_scales": torch.zeros(10, 1),
        "opacities": torch.full((10,), 3.0),
        "sh": torch.arange(10.0).view(10, 1, 1).expand(10, 1, 3).clone(),
    }
    params["opacities"][:3] = -5.0
    pull = density.Pull(10)
    pull.add(torch.ones(10, 3))
    divided = density.divide(params, adam.Adam(), pull, 12, 0.5, np.random.default_rng(0))
    assert divided == 5
    assert len(params["means"]) == 12
    assert (params["opacities"] > 0).all()  # the transparent three took a half each
    assert (params["sh"][:, 0, 0] >= 3).all()
    assert int((params["log_scales"] < 0).sum()) == 10  # both halves are smaller


def test_gaussians_show_what_nothing_nearer_covers():
    """A small half transparent one, a large opaque one and one behind it: areas in closed form, 2 pi variance."""
    lens = torch.tensor([[50.0, 0, 20], [0, 50, 20], [0, 0, 1]])
    view = cuts.View(torch.eye(4), lens, torch.zeros(40, 40, 3), None, 1600)
    means = torch.tensor([[0.5, 0.5, 2.0], [0, 0, 3.0], [0, 0, 5.0]])
    scales, opacities = torch.tensor([[0.04], [0.2], [0.05]]), torch.tensor([0.5, 0.999, 0.999])
    once = shown([(view, (means, scales, opacities))], "numba")
    small, large = (50 * 0.04 / 2) ** 2 + EPS2D, (50 * 0.2 / 3) ** 2 + EPS2D  # pixels^2
    np.testing.assert_allclose(once[0] / once[1], 0.5 * small / (0.999 * large), rtol=0.08)
    assert 0 < once[2] < 0.01 * once[1]
    np.testing.assert_allclose(shown(2 * [(view, (means, scales, opacities))], "numba"), 2 * once)


def test_only_some_gaussians_are_left_with_their_moments():
    params = {n: torch.arange(5.0).view(5, 1) for n in density.NAMES}
    own = adam.Adam()
    own.first, own.second = ({n: m * torch.arange(5.0).view(5, 1) for n in density.NAMES} for m in (2, 3))
    density.keep(params, own, np.array([1, 4]))
    for name in density.NAMES:
        assert params[name][:, 0].tolist() == [1, 4]
        assert params[name].requires_grad
        assert own.first[name][:, 0].tolist() == [2, 8]
        assert own.second[name][:, 0].tolist() == [3, 12]


# a whole fit


def test_planted_ball_is_found_again(tmp_path):
    capture, _ = planted()
    found = fit(
        capture, **settings(iterations=500, static=0.1, grown=0.4, rate_deformation=0.02), workspace=Workspace(tmp_path)
    )
    assert found.history[-1, 2] > 24.0
    assert found.points.shape == (FRAMES, len(found.gaussians.means), 3)
    solid = found.gaussians.opacities > 0.5
    middle = found.points[:, solid].mean(1)
    np.testing.assert_allclose(np.ptp(middle[:, 0]), 0.6, atol=0.12)
    np.testing.assert_allclose(middle.mean(0), [3, 1, 0], atol=0.1)
    motion = motion_of(found)
    assert motion.points is found.points
    assert motion.faces is None


def test_hidden_gaussians_are_taken_out_at_the_end_of_division(tmp_path):
    """A filled ball's inside is seen by nobody: with the rule nearly all Gaussians are left near its skin."""
    capture, points = planted()
    centre = points.mean(1)
    inside = {}
    for share in (0.0, 0.2):
        given = settings(iterations=300, start="ball", gaussians=800, max_gaussians=800, least_shown=share)
        found = fit(capture, **given, workspace=Workspace(tmp_path / str(share)))
        far = np.linalg.norm(found.points[0] - centre[0], axis=1)
        inside[share] = (far < 0.3).sum(), len(far)
    assert inside[0.2][1] < inside[0.0][1]
    assert inside[0.2][0] < 0.5 * inside[0.0][0]


@pytest.mark.parametrize("preset", ["cpu", "paper"])
def test_interrupted_fit_ends_with_the_same_bits(tmp_path, monkeypatch, preset):
    capture, _ = planted((6, 6), images=24)
    given = settings(preset, averaged=0.3, divide_until=0.6)
    whole = fit(capture, **given, workspace=Workspace(tmp_path / "whole"))

    class Killed(Exception):
        pass

    def die(text: str, fraction: float) -> None:
        if fraction > 0.4:
            raise Killed

    monkeypatch.setattr(fitting, "SAVE_SECONDS", -1.0)
    monkeypatch.setattr(fitting, "REPORT", 25)
    monkeypatch.setattr(fitting.Fitting, "save", _sometimes(fitting.Fitting.save))
    with pytest.raises(Killed):
        fit(capture, **given, workspace=Workspace(tmp_path / "cut", die))
    monkeypatch.setattr(fitting, "REPORT", 100)
    said = []
    again = fit(capture, **given, workspace=Workspace(tmp_path / "cut", lambda text, share: said.append(text)))
    assert same(replace(whole, history=whole.history[-1:, :1]), replace(again, history=again.history[-1:, :1]))


def _sometimes(save):
    """Keeps the state in the middle of things, not only where something has just ended."""

    def save_some(self) -> None:
        if self.iteration % 7 == 3:
            save(self)

    return save_some


def test_torn_checkpoint_starts_anew(tmp_path):
    capture, _ = planted(images=20)
    given = settings(iterations=5)
    whole = fit(capture, **given, workspace=Workspace(tmp_path / "a"))
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / "fit.safetensors").write_bytes(b"torn")
    assert same(whole, fit(capture, **given, workspace=Workspace(tmp_path / "b")))


def test_loss_that_is_not_finite_names_term_and_iteration(tmp_path, monkeypatch):
    capture, _ = planted(images=20)
    honest = fitting.photometric

    def poisoned(*args, **kwargs):
        terms, squared = honest(*args, **kwargs)
        return terms | {"alpha": terms["alpha"] * float("nan")}, squared

    monkeypatch.setattr(fitting, "photometric", poisoned)
    with pytest.raises(InputError, match=r"iteration 0: expected a finite loss, found alpha = nan"):
        fit(capture, **settings(), workspace=Workspace(tmp_path))


def test_a_reference_that_no_image_shows(tmp_path):
    capture, _ = planted(images=20)
    with pytest.raises(InputError, match=r"reconstruction\.reference"):
        fit(capture, **settings(reference=99), workspace=Workspace(tmp_path))


def test_captures_that_cannot_be_fitted(tmp_path):
    capture, _ = planted(images=20)
    empty = replace(capture, images=np.zeros_like(capture.images))
    apart = replace(capture, view=capture.view.copy())
    apart.view[::2, 2, 3] *= -1.0  # every other camera has its back to the ball
    for wrong, message in ((empty, "transparent"), (capture.take(np.array([0])), "1 image"), (apart, "cells")):
        with pytest.raises(InputError, match=message):
            fit(wrong, **settings(hull_agree=1.0), workspace=Workspace(tmp_path))


def test_memory_cap_is_honoured(tmp_path):
    capture, _ = planted(images=20)
    with pytest.raises(InputError, match=r"memory\.max_gb"):
        fit(capture, **settings(), workspace=Workspace(tmp_path, max_gb=1e-3))
