"""Gaussians to images: one call, three backends, the same conventions.

Those of gsplat, but for the value of EPS2D: the colour of a Gaussian is max(0.5 + SH(direction), 0); its projected
covariance is blurred by EPS2D pixels^2; pixel centres lie at +0.5; its alpha in a pixel is
min(opacity exp(-sigma), MAX_ALPHA), and a pixel skips it where that is below MIN_ALPHA; Gaussians are blended from near
to far until the transmittance would fall to MIN_TRANSMITTANCE or below, the one that would do so left out; those nearer
than NEAR are not drawn.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Literal

from tasks.errors import InputError

if TYPE_CHECKING:
    from torch import Tensor

EPS2D = 0.1  # about a pixel's own variance, 1/12 (Mip-Splatting, Yu et al. 2024); 3DGS's 0.3 blurs every outline
MAX_ALPHA = 0.999
MIN_ALPHA = 1.0 / 255.0
MIN_TRANSMITTANCE = 1e-4
NEAR = 0.01
MARGIN = 0.3  # beyond the image, in its size: where the slope of the projection is frozen
DEGREE = {1: 0, 4: 1, 9: 2, 16: 3}

Backend = Literal["numba", "gsplat", "reference"]


def rasterize(
    means: Tensor,
    scales: Tensor,
    opacities: Tensor,
    sh: Tensor,
    view: Tensor,
    intrinsics: Tensor,
    size: tuple[int, int],
    background: Tensor,
    quaternions: Tensor | None = None,
    backend: Backend = "numba",
) -> tuple[Tensor, Tensor, Tensor]:
    """Colour (H, W, 3) over the background, alpha (H, W) and depth (H, W) of one view.

    means: (N, 3); scales: (N, 1) isotropic or (N, 3), standard deviations; opacities: (N,) in 0..1; sh: (N, K, 3) with
    K = 1, 4, 9, 16; view: (4, 4) world to camera, OpenCV's axes; intrinsics: (3, 3) in pixels; size: height and width;
    background: (3,); quaternions: (N, 4) w x y z of any length, or None with isotropic scales. Depth is the camera's z
    expected over the Gaussians that a pixel sees, weighted by what each adds to alpha and divided by alpha (0 where
    alpha is 0). Differentiable in means, scales, opacities, sh, quaternions and background. All tensors are of one
    floating type; ``gsplat`` needs CUDA. Raises InputError for other shapes, or where a backend cannot run.
    """
    _check(means, scales, opacities, sh, view, intrinsics, background, quaternions)
    if backend not in ("numba", "gsplat", "reference"):
        raise InputError("rasterize.backend", expected="numba, gsplat or reference", found=str(backend))
    if scales.shape[1] == 1:
        quaternions = None  # a sphere has no direction
    draw = import_module(f"tasks.reconstruction.rasterize_{backend}").draw
    return draw(means, scales, opacities, sh, view, intrinsics, size, background, quaternions)


def _check(means, scales, opacities, sh, view, intrinsics, background, quaternions) -> None:
    n = len(means)
    expected = {
        "means": (means, [(n, 3)]),
        "scales": (scales, [(n, 1), (n, 3)]),
        "opacities": (opacities, [(n,)]),
        "sh": (sh, [(n, k, 3) for k in DEGREE]),
        "view": (view, [(4, 4)]),
        "intrinsics": (intrinsics, [(3, 3)]),
        "background": (background, [(3,)]),
    }
    if quaternions is not None:
        expected["quaternions"] = (quaternions, [(n, 4)])
    elif scales.shape[-1] == 3:
        raise InputError("rasterize.quaternions", expected=f"shape {(n, 4)} with scales of (N, 3)", found="None")
    for name, (value, shapes) in expected.items():
        if tuple(value.shape) not in shapes:
            allowed = " or ".join(map(str, shapes))
            raise InputError(f"rasterize.{name}", expected=f"shape {allowed}", found=str(tuple(value.shape)))
        if value.dtype != means.dtype:
            raise InputError(f"rasterize.{name}", expected=f"{means.dtype} as the means", found=str(value.dtype))
