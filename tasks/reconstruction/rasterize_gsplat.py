"""The rasteriser on CUDA: gsplat (Ye et al. 2025, Apache-2.0), whose conventions the other backends follow."""

from __future__ import annotations

import torch

from tasks.errors import InputError
from tasks.reconstruction.rasterize import DEGREE, EPS2D, NEAR

WHERE = "rasterize.backend=gsplat"


def draw(means, scales, opacities, sh, view, intrinsics, size, background, quaternions):
    """See :func:`tasks.reconstruction.rasterize.rasterize`. float32 on CUDA."""
    rasterization = _library()
    if not means.is_cuda:
        raise InputError(WHERE, expected="tensors on CUDA", found=str(means.device), do="use the backend numba")
    if quaternions is None:
        quaternions = means.new_tensor([1.0, 0.0, 0.0, 0.0]).expand(len(means), 4)
    images, alpha, _ = rasterization(
        means,
        quaternions,
        scales.expand(len(means), 3),
        opacities,
        sh,
        view[None],
        intrinsics[None],
        size[1],
        size[0],
        sh_degree=DEGREE[sh.shape[1]],
        near_plane=NEAR,
        eps2d=EPS2D,
        packed=False,
        render_mode="RGB+ED",
    )
    alpha = alpha[0, :, :, 0]
    return images[0, :, :, :3] + (1.0 - alpha)[..., None] * background, alpha, images[0, :, :, 3]


def _library():
    if not torch.cuda.is_available():
        do = "use the backend numba, which needs none"
        raise InputError(WHERE, expected="a CUDA device", found="none", do=do)
    try:
        from gsplat import rasterization
    except ImportError:
        raise InputError(WHERE, expected="the package gsplat", found="none", do='pip install -e ".[cuda]"') from None
    return rasterization
