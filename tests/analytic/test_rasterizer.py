"""The rasteriser's backends against each other, against finite differences, and against what one can work out."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from tasks.errors import InputError
from tasks.reconstruction import rasterize_reference
from tasks.reconstruction.rasterize import EPS2D, MAX_ALPHA, MIN_ALPHA, rasterize
from tasks.reconstruction.ssim import ssim

SIZE = (29, 37)  # no multiple of the tiles
NEEDS_CUDA = pytest.param(
    "gsplat", marks=[pytest.mark.cuda, pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")]
)


def scene(dtype=torch.float64, *, coefficients=4, isotropic=True, count=60, seed=0):
    """Gaussians round the origin, some behind the camera or out of sight, and a turned camera off its axis."""
    g = np.random.default_rng(seed)
    given = {
        "means": g.uniform(-1, 1, (count, 3)) * [1.4, 1.2, 2.4],
        "scales": g.uniform(0.02, 0.25, (count, 1 if isotropic else 3)),
        "opacities": g.uniform(0.0, 1.0, count),
        "sh": g.normal(0, 0.4, (count, coefficients, 3)),
    }
    if not isotropic:
        given["quaternions"] = g.normal(size=(count, 4))
    view = np.eye(4)
    view[:3, :3] = [[math.cos(0.3), 0, math.sin(0.3)], [0, 1, 0], [-math.sin(0.3), 0, math.cos(0.3)]]
    view[:3, 3] = 0.1, -0.05, 2.0
    intrinsics = np.array([[40.0, 0, 17], [0, 44, 14], [0, 0, 1]])
    return tensors(given, dtype), *(torch.tensor(a, dtype=dtype) for a in (view, intrinsics))


def tensors(given: dict, dtype) -> dict:
    return {name: torch.tensor(a, dtype=dtype) for name, a in given.items()}


def drawn(backend, given, view, intrinsics, size=SIZE, background=(0.2, 0.5, 0.9)):
    """The three images, and the gradients of a fixed random sum of them by everything that has one."""
    device = "cuda" if backend == "gsplat" else "cpu"
    leaves = {name: t.detach().to(device).requires_grad_() for name, t in given.items()}
    leaves["background"] = torch.tensor(background, dtype=view.dtype, device=device, requires_grad=True)
    images = rasterize(**leaves, view=view.to(device), intrinsics=intrinsics.to(device), size=size, backend=backend)
    g = torch.Generator().manual_seed(5)
    weights = [torch.randn(i.shape, generator=g, dtype=torch.float64).to(i) for i in images]
    loss = sum((i * w).sum() for i, w in zip(images, weights, strict=True))
    gradients = torch.autograd.grad(loss, list(leaves.values()))
    found = dict(zip(("rgb", "alpha", "depth"), images, strict=True)) | dict(zip(leaves, gradients, strict=True))
    return {name: t.detach().cpu() for name, t in found.items()}


def apart(a, b) -> float:
    """Largest difference over the largest true value."""
    return float((a - b).abs().max() / b.abs().max())


@pytest.mark.parametrize("backend", ["numba", NEEDS_CUDA])
@pytest.mark.parametrize("isotropic", [True, False])
@pytest.mark.parametrize("coefficients", [1, 4, 9, 16])
def test_images_and_gradients_are_the_references(backend, isotropic, coefficients):
    given, view, intrinsics = scene(coefficients=coefficients, isotropic=isotropic)
    true = drawn("reference", given, view, intrinsics)
    if backend == "gsplat":  # has float32 only
        given, view, intrinsics = {n: t.float() for n, t in given.items()}, view.float(), intrinsics.float()
    found = drawn(backend, given, view, intrinsics)
    limit = 1e-5 if backend == "numba" else 2e-3
    assert {name: apart(found[name], true[name]) for name in true if apart(found[name], true[name]) > limit} == {}


@pytest.mark.parametrize("isotropic", [True, False])
def test_float32_is_near_float64(isotropic):
    found, true = (drawn("numba", *scene(t, isotropic=isotropic)) for t in (torch.float32, torch.float64))
    assert {name: apart(found[name], true[name]) for name in true if apart(found[name], true[name]) > 2e-5} == {}


@pytest.mark.parametrize("isotropic", [True, False])
def test_the_references_gradients_are_finite_differences(isotropic):
    """Along random directions; no Gaussian may come or go within the step, so opacities stay inside (1/255, 0.999)."""
    given, view, intrinsics = scene(coefficients=9, isotropic=isotropic, count=6, seed=3)
    given["opacities"] = 0.3 + 0.5 * given["opacities"]
    given["scales"] = given["scales"] + 0.6  # wider than the image: no pixel lies on the edge of MIN_ALPHA
    gradients = drawn("reference", given, view, intrinsics)
    g = torch.Generator().manual_seed(5)
    weights = [torch.randn(s, generator=g, dtype=torch.float64) for s in ((*SIZE, 3), SIZE, SIZE)]
    background = torch.tensor((0.2, 0.5, 0.9), dtype=torch.float64)

    def loss(changed):
        images = rasterize(
            **changed, view=view, intrinsics=intrinsics, size=SIZE, background=background, backend="reference"
        )
        return float(sum((i * w).sum() for i, w in zip(images, weights, strict=True)))

    for name, value in given.items():
        along = torch.randn(value.shape, generator=g, dtype=torch.float64)
        step = 1e-6
        slope = (loss(given | {name: value + step * along}) - loss(given | {name: value - step * along})) / (2 * step)
        assert slope == pytest.approx(float((gradients[name] * along).sum()), rel=1e-5), name


@pytest.mark.parametrize("isotropic", [True, False])
def test_projection_is_that_of_gsplat(isotropic):
    theirs = pytest.importorskip("gsplat.cuda._torch_impl", reason="needs the extra cuda (gsplat)")
    given, view, intrinsics = scene(coefficients=16, isotropic=isotropic)
    means, scales, sh = given["means"], given["scales"], given["sh"]
    quaternions = given.get("quaternions")
    upright = torch.tensor([[1.0, 0, 0, 0]], dtype=torch.float64).expand(len(means), 4)
    turn = upright if quaternions is None else torch.nn.functional.normalize(quaternions, dim=1)
    covariance = theirs._quat_scale_to_covar_preci(turn, scales.expand(-1, 3), True, False, False)[0]
    assert apart(rasterize_reference.covariance(scales, quaternions), covariance) < 1e-12
    size = (SIZE[1], SIZE[0])
    camera = view[None], intrinsics[None], *size
    radii, xy, depth, conic, _ = theirs._fully_fused_projection(means, covariance, *camera, eps2d=EPS2D)
    seen = (radii[0] > 0).all(-1)
    assert 10 < int(seen.sum()) < len(means)
    ours_xy, ours_cov, ours_depth = rasterize_reference.project(means, covariance, view, intrinsics, SIZE)
    assert apart(ours_xy[seen], xy[0, seen]) < 1e-12
    assert apart(ours_depth[seen], depth[0, seen]) < 1e-12
    inverse = torch.linalg.inv(ours_cov[seen])
    ours = torch.stack([inverse[:, 0, 0], inverse[:, 0, 1], inverse[:, 1, 1]], 1)
    assert apart(ours, conic[0, seen]) < 1e-9
    centre = -view[:3, :3].T @ view[:3, 3]
    colours = theirs._spherical_harmonics(3, means - centre, sh)
    assert apart(rasterize_reference.shade(sh, means, view), (colours + 0.5).clamp(min=0)) < 1e-9


@pytest.mark.parametrize("backend", ["numba", "reference", NEEDS_CUDA])
class TestOneGaussian:
    """Worked out by hand: on the axis, at depth 2, focal length 10, scale 0.4 -> 2 pixels, blurred to 2^2 + 0.1."""

    def draw(self, backend, *, opacity=0.8, means=((0.0, 0.0, 2.0),), colours=((0.9, 0.3, 0.1),), size=(9, 9)):
        device = "cuda" if backend == "gsplat" else "cpu"
        count = len(means)
        sh = (np.array(colours) - 0.5)[:, None] / rasterize_reference.SH_0
        given = {
            "means": np.array(means),
            "scales": np.full((count, 1), 0.4),
            "opacities": np.full(count, opacity),
            "sh": sh,
            "view": np.eye(4),
            "intrinsics": np.array([[10.0, 0, 4.5], [0, 10.0, 4.5], [0, 0, 1]]),
            "background": np.array([0.0, 0.0, 1.0]),
        }
        given = {n: t.to(device) for n, t in tensors(given, torch.float32).items()}
        return [i.cpu().numpy() for i in rasterize(**given, size=size, backend=backend)]

    def test_falls_off_as_a_gaussian_round_the_pixel_centre(self, backend):
        rgb, alpha, depth = self.draw(backend)
        assert alpha[4, 4] == pytest.approx(0.8, rel=1e-5)  # the centre lies on the centre of pixel 4
        assert alpha[4, 6] == pytest.approx(0.8 * math.exp(-0.5 * 4 / 4.1), rel=1e-5)
        assert alpha[1, 4] == pytest.approx(0.8 * math.exp(-0.5 * 9 / 4.1), rel=1e-5)
        assert depth[3, 5] == pytest.approx(2.0, rel=1e-5)
        assert rgb[4, 4] == pytest.approx([0.72, 0.24, 0.08 + 0.2], rel=1e-4)

    def test_ends_where_alpha_is_below_the_least(self, backend):
        _, alpha, depth = self.draw(backend, opacity=0.02)
        inside = 0.02 * np.exp(-0.5 * ((np.arange(9) - 4) ** 2) / 4.1) >= MIN_ALPHA
        assert np.array_equal(alpha[4] > 0, inside)
        assert 0 < inside.sum() < 9
        assert (depth[4, ~inside] == 0).all()

    def test_is_never_quite_opaque(self, backend):
        _, alpha, _ = self.draw(backend, opacity=1.0)
        assert alpha[4, 4] == pytest.approx(MAX_ALPHA, rel=1e-6)

    def test_blends_from_near_to_far(self, backend):
        colours = ((0.0, 1.0, 0.0), (1.0, 0.0, 0.0))
        rgb, alpha, depth = self.draw(backend, means=((0, 0, 4.0), (0, 0, 2.0)), colours=colours)
        assert rgb[4, 4] == pytest.approx([0.8, 0.2 * 0.8, 0.04], abs=1e-5)
        assert alpha[4, 4] == pytest.approx(0.96, abs=1e-5)
        assert depth[4, 4] == pytest.approx((0.8 * 2 + 0.16 * 4) / 0.96, rel=1e-5)

    def test_leaves_out_what_would_use_up_the_light(self, backend):
        """Two of 0.97 leave 9e-4 of the light, a third would leave 2.7e-5."""
        means = tuple((0, 0, 2.0 + i) for i in range(3))
        rgb, alpha, _ = self.draw(backend, opacity=0.97, means=means, colours=((1, 0, 0), (0, 1, 0), (1, 1, 1)))
        assert alpha[4, 4] == pytest.approx(1 - 0.03**2, abs=1e-6)
        assert rgb[4, 4, 2] == pytest.approx(0.03**2, abs=1e-6)

    def test_is_not_drawn_behind_the_camera(self, backend):
        rgb, alpha, _ = self.draw(backend, means=((0, 0, -2.0),))
        assert not alpha.any()
        assert (rgb == [0, 0, 1]).all()


def test_many_in_one_place_end_a_tile_early():
    """More Gaussians than a tile needs: those behind a full tile have no colour and no gradient."""
    given, view, intrinsics = scene(count=300, seed=1)
    given["means"] = given["means"] * 0.3
    given["opacities"] = 0.5 + 0.5 * given["opacities"]
    given["scales"] = given["scales"] + 0.3
    found, true = (drawn(backend, given, view, intrinsics) for backend in ("numba", "reference"))
    assert {name: apart(found[name], true[name]) for name in true if apart(found[name], true[name]) > 1e-5} == {}
    assert int((true["opacities"] == 0).sum()) > 100


def test_same_bits_with_any_number_of_threads(monkeypatch):
    results = []
    for threads in ("1", "2", "3"):
        monkeypatch.setenv("SKELEBONES_THREADS", threads)
        results.append(drawn("numba", *scene(torch.float32, count=9000, coefficients=9), size=(150, 170)))
    for other in results[1:]:
        assert all(torch.equal(results[0][name], other[name]) for name in other)


@pytest.mark.parametrize("backend", ["numba", "reference"])
def test_nothing_in_sight_is_background(backend):
    given, view, intrinsics = scene()
    given["means"] = given["means"] - torch.tensor([0, 0, 50.0])
    found = drawn(backend, given, view, intrinsics)
    assert (found["rgb"] == torch.tensor([0.2, 0.5, 0.9], dtype=torch.float64)).all()
    assert not any(found[name].any() for name in ("alpha", "depth", *given))


def test_no_gaussians_at_all():
    given, view, intrinsics = scene(count=0)
    assert not drawn("numba", given, view, intrinsics)["alpha"].any()


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"means": torch.zeros(60, 2)}, "rasterize.means: expected shape (60, 3), found (60, 2)"),
        ({"opacities": torch.zeros(59)}, "rasterize.opacities"),
        ({"sh": torch.zeros(60, 5, 3)}, "rasterize.sh"),
        (
            {"scales": torch.zeros(60, 3)},
            "rasterize.quaternions: expected shape (60, 4) with scales of (N, 3), found None",
        ),
        ({"scales": torch.zeros(60, 1).double()}, "rasterize.scales: expected torch.float32 as the means"),
        ({"backend": "cuda"}, "rasterize.backend: expected numba, gsplat or reference, found cuda"),
    ],
)
def test_says_what_is_wrong(changed, said):
    given, view, intrinsics = scene(torch.float32)
    call = {"view": view, "intrinsics": intrinsics, "size": SIZE, "background": torch.zeros(3)}
    with pytest.raises(InputError) as error:
        rasterize(**(given | call | changed))
    assert str(error.value).startswith(said)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
def test_gsplat_without_cuda_is_one_line():
    given, view, intrinsics = scene(torch.float32)
    with pytest.raises(InputError, match="expected a CUDA device, found none; use the backend numba"):
        rasterize(**given, view=view, intrinsics=intrinsics, size=SIZE, background=torch.zeros(3), backend="gsplat")


def plain_ssim(x, y):
    """The same by torch's convolutions. x, y: (H, W, 3)."""
    taps = torch.exp(-0.5 * ((torch.arange(11, dtype=x.dtype) - 5) / 1.5) ** 2)
    window = (torch.outer(taps, taps) / taps.sum() ** 2).expand(3, 1, 11, 11)

    def blur(a):
        return torch.nn.functional.conv2d(a.permute(2, 0, 1)[None], window, padding=5, groups=3)

    mx, my = blur(x), blur(y)
    vx, vy, cov = blur(x * x) - mx**2, blur(y * y) - my**2, blur(x * y) - mx * my
    return ((2 * mx * my + 1e-4) * (2 * cov + 9e-4) / ((mx**2 + my**2 + 1e-4) * (vx + vy + 9e-4))).mean()


@pytest.mark.parametrize(("dtype", "limit"), [(torch.float64, 1e-10), (torch.float32, 1e-4)])
def test_ssim_and_its_gradient_are_those_of_autograd(dtype, limit):
    g = torch.Generator().manual_seed(0)
    x = torch.rand(43, 37, 3, generator=g, dtype=dtype, requires_grad=True)
    y = 0.7 * x.detach() + 0.3 * torch.rand(43, 37, 3, generator=g, dtype=dtype)
    found, true = ssim(x, y), plain_ssim(x, y)
    assert float(found.detach()) == pytest.approx(float(true.detach()), abs=limit)
    a, b = (torch.autograd.grad(3.0 * value, x)[0] for value in (found, true))
    assert apart(a, b) < limit


def test_ssim_of_images_that_do_not_match():
    with pytest.raises(InputError, match=r"ssim.image: expected an image"):
        ssim(torch.zeros(20, 20, 3), torch.zeros(20, 21, 3))
