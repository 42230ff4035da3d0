"""Numbers of images and rendered views, against what one can work out."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import nn

from tasks.errors import InputError
from tasks.evaluation import images, lpips
from tasks.geometry.gaussians import at_frame
from tasks.reconstruction.views import pose_gaussians, render_views
from tasks.values import Animation, Capture, Gaussians, Reconstruction

PICTURE = np.random.default_rng(0).random((40, 50, 3))


def capture(frames=2, size=(24, 30), background=(0.2, 0.5, 0.9)) -> Capture:
    """One camera looking along z from two units away, an image for each frame."""
    view, intrinsics = np.eye(4, dtype=np.float32), np.eye(3, dtype=np.float32)
    view[2, 3] = 2.0
    intrinsics[:2] = [[40, 0, size[1] / 2], [0, 40, size[0] / 2]]
    return Capture(
        name="toy",
        images=np.zeros((frames, *size, 4), np.uint8),
        has_alpha=True,
        background=np.array(background, np.float32),
        view=np.repeat(view[None], frames, 0),
        intrinsics=np.repeat(intrinsics[None], frames, 0),
        camera=np.zeros(frames, np.int32),
        frame=np.arange(frames, dtype=np.int32),
        times=np.linspace(0, 1, frames).astype(np.float32),
        fps=30.0,
        clip_start=np.array([0, frames]),
        clip_names=("all",),
    )


def reconstruction(frames=2, stretched=False) -> Reconstruction:
    """Thirty Gaussians that move along x."""
    g = np.random.default_rng(1)
    means = g.uniform(-0.3, 0.3, (30, 3)).astype(np.float32)
    gaussians = Gaussians(
        means=means,
        scales=g.uniform(0.02, 0.1, (30, 3 if stretched else 1)).astype(np.float32),
        quaternions=g.normal(size=(30, 4)).astype(np.float32) if stretched else None,
        opacities=g.uniform(0.2, 1.0, 30).astype(np.float32),
        sh=g.uniform(-1.0, 1.0, (30, 1, 3)).astype(np.float32),
    )
    points = means + np.arange(frames, dtype=np.float32)[:, None, None] * np.float32([0.1, 0, 0])
    like = capture(frames)
    return Reconstruction(
        name="toy",
        gaussians=gaussians,
        points=points,
        rotations=None,
        scaling=None,
        opacity=None,
        times=like.times,
        fps=30.0,
        clip_start=like.clip_start,
        clip_names=like.clip_names,
        unit="unit",
        rig=None,
        history=np.zeros((0, 3)),
    )


def test_psnr_of_a_known_difference():
    assert images.psnr(PICTURE, PICTURE + 0.1) == pytest.approx(20.0)
    assert images.psnr(PICTURE, PICTURE) == 100.0


def test_ssim_of_flat_images():
    """No variance is left: (2 a b + c) / (a^2 + b^2 + c)."""
    flat = np.ones((20, 20, 3))
    assert images.ssim(0.3 * flat, 0.7 * flat) == pytest.approx((0.42 + 1e-4) / (0.58 + 1e-4))
    assert images.ssim(PICTURE, PICTURE) == pytest.approx(1.0)


def test_ssim_is_the_mean_over_the_windows_one_by_one():
    truth = 0.5 * PICTURE + 0.5 * np.random.default_rng(1).random(PICTURE.shape)
    taps = np.exp(-0.5 * ((np.arange(11) - 5) / 1.5) ** 2)
    weights = np.outer(taps, taps)[..., None] / taps.sum() ** 2
    found = []
    for i in range(PICTURE.shape[0] - 10):
        for j in range(PICTURE.shape[1] - 10):
            x, y = PICTURE[i : i + 11, j : j + 11], truth[i : i + 11, j : j + 11]
            mx, my = ((weights * a).sum((0, 1)) for a in (x, y))
            vx, vy = ((weights * (a - m) ** 2).sum((0, 1)) for a, m in ((x, mx), (y, my)))
            cov = (weights * (x - mx) * (y - my)).sum((0, 1))
            found.append((2 * mx * my + 1e-4) * (2 * cov + 9e-4) / ((mx**2 + my**2 + 1e-4) * (vx + vy + 9e-4)))
    assert images.ssim(PICTURE, truth) == pytest.approx(np.mean(found), rel=1e-9)


def test_shrunk_ssim_hides_noise_and_begins_at_384_pixels():
    g = np.random.default_rng(2)
    big = np.repeat(np.repeat(g.random((200, 200, 3)), 2, 0), 2, 1)
    noisy = np.clip(big + 0.2 * g.normal(size=big.shape), 0, 1)
    means = noisy.reshape(200, 2, 200, 2, 3).mean((1, 3))
    assert images.ssim_shrunk(noisy, big) == pytest.approx(images.ssim(means, big[::2, ::2]))
    assert images.ssim_shrunk(noisy, big) > images.ssim(noisy, big) + 0.05
    small = slice(0, 383)
    assert images.ssim_shrunk(noisy[small, small], big[small, small]) == images.ssim(
        noisy[small, small], big[small, small]
    )


def test_flip_of_black_and_white():
    """0.9673 is what the authors' own tool says of the two; in grey a smaller step is a smaller error."""
    black, white = np.zeros((64, 64, 3)), np.ones((64, 64, 3))
    assert images.flip(black, white) == pytest.approx(0.9673, abs=1e-4)
    assert images.flip(black, black) == 0.0
    assert 0 < images.flip(black + 0.4, black + 0.5) < images.flip(black + 0.3, black + 0.5)


def alexnet() -> nn.Sequential:
    return nn.Sequential(
        *(nn.Conv2d(3, 64, 11, 4, 2), nn.ReLU(), nn.MaxPool2d(3, 2)),
        *(nn.Conv2d(64, 192, 5, 1, 2), nn.ReLU(), nn.MaxPool2d(3, 2)),
        *(nn.Conv2d(192, 384, 3, 1, 1), nn.ReLU(), nn.Conv2d(384, 256, 3, 1, 1), nn.ReLU()),
        *(nn.Conv2d(256, 256, 3, 1, 1), nn.ReLU()),
    )


def vgg() -> nn.Sequential:
    layers, before = [], 3
    for width in (64, 64, "pool", 128, 128, "pool", 256, 256, 256, "pool", 512, 512, 512, "pool", 512, 512, 512):
        if width == "pool":
            layers.append(nn.MaxPool2d(2, 2))
            continue
        layers += [nn.Conv2d(before, width, 3, 1, 1), nn.ReLU()]
        before = width
    return nn.Sequential(*layers)


@pytest.mark.parametrize(("build", "taps"), [(alexnet, (1, 4, 7, 9, 11)), (vgg, (3, 8, 15, 22, 29))])
def test_lpips_with_the_users_weights(build, taps, tmp_path):
    """Weights made up here in the layout of the real ones; the layers, run one by one, say what must come out."""
    torch.manual_seed(0)
    net = build().eval()
    weights = {f"features.{name}": t.numpy() for name, t in net.state_dict().items()}
    widths = [next(c for c in reversed(net[: t + 1]) if isinstance(c, nn.Conv2d)).out_channels for t in taps]
    heads = [torch.rand(1, w, 1, 1) for w in widths]
    weights |= {f"lin{k}.model.1.weight": head.numpy() for k, head in enumerate(heads)}
    np.savez(tmp_path / "weights.npz", **weights)
    a, b = np.random.default_rng(3).random((2, 64, 72, 3))
    expected, unit = 0.0, []
    for image in (a, b):
        shift, scale = torch.tensor([-0.030, -0.088, -0.188]), torch.tensor([0.458, 0.448, 0.450])
        x = (((torch.tensor(image, dtype=torch.float32) * 2 - 1) - shift) / scale).permute(2, 0, 1)[None]
        found = []
        for i, layer in enumerate(net):
            x = layer(x)
            if i in taps:
                found.append(torch.nn.functional.normalize(x, dim=1))
        unit.append(found)
    for x, y, head in zip(*unit, heads, strict=True):
        expected += float((head * (x - y) ** 2).sum(1).mean().detach())
    distance = lpips.load(str(tmp_path / "weights.npz"))
    assert distance(a, b) == pytest.approx(expected, rel=1e-4)
    assert distance(a, a) == 0.0


def test_lpips_without_its_weights(tmp_path):
    with pytest.raises(InputError, match=r"evaluate.lpips: expected a file of weights"):
        lpips.load(str(tmp_path / "none.npz"))
    np.savez(tmp_path / "odd.npz", something=np.zeros(3))
    with pytest.raises(InputError, match=r"expected an array features.0.weight, found something"):
        lpips.load(str(tmp_path / "odd.npz"))
    (tmp_path / "torn.safetensors").write_bytes(b"torn")
    with pytest.raises(InputError, match=r"torn.safetensors: expected a .safetensors or .npz file"):
        lpips.load(str(tmp_path / "torn.safetensors"))


def test_views_are_compared_over_the_background():
    """A wrong colour where alpha is 0 does not count; half of a wrong colour counts half."""
    truth = capture()
    wrong = np.zeros_like(truth.images)
    wrong[0, :, :, :3] = 255
    wrong[1] = [51, 128, 230, 128]  # the background's own colour, to a rounding
    found = images.evaluate_views(replace(truth, images=wrong), truth, ssim_down=True, lpips=None)
    numbers = dict(zip(found.names, found.values, strict=True))
    assert list(numbers) == ["psnr", "ssim", "flip", "ssim_down"]
    assert found.units == ("dB", "ratio", "ratio", "ratio")
    assert numbers["psnr"] > 70
    wrong[0, :, :, 3] = 51  # a fifth of white over (0.2, 0.5, 0.9)
    one = np.array([0])
    found = images.evaluate_views(replace(truth, images=wrong).take(one), truth.take(one), ssim_down=False, lpips=None)
    error = np.mean((0.2 * (1 - np.array([0.2, 0.5, 0.9]))) ** 2)
    assert found.values[0] == pytest.approx(-10 * math.log10(error), abs=1e-3)


def test_views_that_do_not_match():
    truth = capture()
    with pytest.raises(InputError, match="toy: rendered images: expected shape"):
        images.evaluate_views(capture(1), truth, ssim_down=False, lpips=None)
    with pytest.raises(InputError, match="expected the frames of the true ones"):
        images.evaluate_views(replace(truth, frame=truth.frame[::-1]), truth, ssim_down=False, lpips=None)


@pytest.mark.parametrize("stretched", [False, True])
def test_rendered_views_over_a_background_are_what_the_rasteriser_draws_over_it(stretched):
    from tasks.reconstruction.rasterize import rasterize

    made, seen = reconstruction(stretched=stretched), capture()
    rendered = render_views(made, seen, backend="numba")
    assert rendered.images.shape == seen.images.shape
    for i in range(2):
        g = at_frame(made, i)
        arrays = (g.means, g.scales, g.opacities, g.sh, seen.view[i], seen.intrinsics[i])
        given = [torch.tensor(a) for a in arrays]
        turn = None if g.quaternions is None else torch.tensor(g.quaternions)
        rgb, alpha, _ = rasterize(*given, seen.size, torch.tensor(seen.background), turn)
        assert 0.1 < float(alpha.mean()) < 0.9
        shown = images.over_background(rendered.images[i], seen.background)
        assert np.abs(shown - rgb.clamp(max=1).numpy()).max() < 1.01 / 255
    assert not np.array_equal(rendered.images[0], rendered.images[1])


def test_frames_that_were_not_reconstructed():
    with pytest.raises(InputError, match="toy: frames: expected numbers below 2, found 2"):
        render_views(reconstruction(2), capture(3), backend="numba")


def test_factors_of_a_frame():
    made = reconstruction()
    factors = replace(made, scaling=np.full((2, 30), 2.0, np.float32), opacity=np.full((2, 30), 0.5, np.float32))
    posed = at_frame(factors, 1)
    assert np.allclose(posed.scales, 2 * made.gaussians.scales)
    assert np.allclose(posed.opacities, 0.5 * made.gaussians.opacities)
    assert np.array_equal(posed.means, made.points[1])


def test_posed_gaussians_turn_with_what_is_round_them():
    """All is turned by 90 degrees: from a camera that turns along nothing changes."""
    made = reconstruction(frames=1, stretched=True)
    turn = np.float32([[0, -1, 0], [1, 0, 0], [0, 0, 1]])
    posed = pose_gaussians(made, Animation(made.points @ turn.T))
    assert posed.clip_start.tolist() == [0, 1]
    seen = capture(1)
    view = seen.view.copy()
    view[0, :3, :3] = turn.T
    along = replace(seen, view=view)
    still, turned = render_views(made, seen, backend="numba"), render_views(posed, along, backend="numba")
    assert np.abs(still.images.astype(int)[..., 3] - turned.images[..., 3]).max() <= 1
    unturned = render_views(replace(posed, rotations=None), along, backend="numba")
    assert np.abs(still.images.astype(int)[..., 3] - unturned.images[..., 3]).max() > 30


def test_poses_of_other_gaussians():
    made = reconstruction(1)
    with pytest.raises(InputError, match="expected a point for each of 30 Gaussians, found 9 points"):
        pose_gaussians(made, Animation(made.points[:, :9]))
