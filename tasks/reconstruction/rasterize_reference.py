"""The rasteriser as plain dense torch: every Gaussian in every pixel, for tests and as the text to read first.

Kerbl et al. 2023 (3D Gaussian splatting), Zwicker et al. 2001 (EWA splatting); gradients by autograd.
"""

from __future__ import annotations

import torch
from torch import Tensor

from tasks.reconstruction.rasterize import DEGREE, EPS2D, MARGIN, MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE, NEAR

SH_0 = 0.28209479177387814
SH_1 = 0.4886025119029199


def draw(means, scales, opacities, sh, view, intrinsics, size, background, quaternions):
    """See :func:`tasks.reconstruction.rasterize.rasterize`. Memory: N x H x W."""
    xy, cov, depth = project(means, covariance(scales, quaternions), view, intrinsics, size)
    colours = shade(sh, means, view)
    order = torch.argsort(depth.detach(), stable=True)
    order = order[depth.detach()[order] > NEAR]
    alphas = splat(xy[order], cov[order], opacities[order], size)  # [N, H, W]
    after = torch.cumprod(1.0 - alphas, dim=0)
    before = torch.cat([torch.ones_like(after[:1]), after[:-1]])
    weights = torch.where(after > MIN_TRANSMITTANCE, before * alphas, 0.0)
    alpha = weights.sum(0)
    rgb = torch.einsum("nhw,nc->hwc", weights, colours[order]) + (1.0 - alpha)[..., None] * background
    far = torch.einsum("nhw,n->hw", weights, depth[order])
    return rgb, alpha, torch.where(alpha > 0, far / torch.where(alpha > 0, alpha, 1.0), 0.0)


def covariance(scales: Tensor, quaternions: Tensor | None) -> Tensor:
    """R diag(s^2) R^T, (N, 3, 3)."""
    if scales.shape[1] == 1:
        return scales[:, :, None] ** 2 * torch.eye(3, dtype=scales.dtype, device=scales.device)
    w, x, y, z = torch.nn.functional.normalize(quaternions, dim=1).unbind(1)
    rotation = torch.stack(
        [
            *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
            *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
            *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
        ],
        dim=1,
    ).reshape(-1, 3, 3)
    m = rotation * scales[:, None, :]
    return m @ m.transpose(1, 2)


def project(means, cov, view, intrinsics, size) -> tuple[Tensor, Tensor, Tensor]:
    """Pixel positions (N, 2), blurred covariances in pixels^2 (N, 2, 2) and depths (N,)."""
    rotation, shift = view[:3, :3], view[:3, 3]
    x, y, z = (means @ rotation.T + shift).unbind(1)
    z = torch.where(z > NEAR, z, 1.0)  # those are not drawn: keep their gradients finite
    fx, fy, cx, cy = intrinsics[0, 0], intrinsics[1, 1], intrinsics[0, 2], intrinsics[1, 2]
    height, width = size
    # the slope of the projection is taken no further out than a margin round the image
    u = torch.clamp(x / z, -(cx + MARGIN * width / 2) / fx, (width - cx + MARGIN * width / 2) / fx)
    v = torch.clamp(y / z, -(cy + MARGIN * height / 2) / fy, (height - cy + MARGIN * height / 2) / fy)
    zero = torch.zeros_like(z)
    slope = torch.stack([fx / z, zero, -fx * u / z, zero, fy / z, -fy * v / z], 1).reshape(-1, 2, 3)
    m = slope @ rotation
    blur = EPS2D * torch.eye(2, dtype=means.dtype, device=means.device)
    xy = torch.stack([fx * x / z + cx, fy * y / z + cy], 1)
    return xy, m @ cov @ m.transpose(1, 2) + blur, (means @ rotation.T + shift)[:, 2]


def splat(xy, cov, opacities, size) -> Tensor:
    """Alpha of every Gaussian in every pixel, (N, H, W)."""
    rows = torch.arange(size[0], dtype=xy.dtype, device=xy.device) + 0.5
    columns = torch.arange(size[1], dtype=xy.dtype, device=xy.device) + 0.5
    dx = (columns[None, :] - xy[:, :1])[:, None, :]  # [N, 1, W]
    dy = (rows[None, :] - xy[:, 1:])[:, :, None]  # [N, H, 1]
    a, b, c = cov[:, 0, 0, None, None], cov[:, 0, 1, None, None], cov[:, 1, 1, None, None]
    sigma = 0.5 * (c * dx * dx - 2.0 * b * dx * dy + a * dy * dy) / (a * c - b * b)
    alphas = torch.clamp(opacities[:, None, None] * torch.exp(-sigma), max=MAX_ALPHA)
    return torch.where(alphas < MIN_ALPHA, 0.0, alphas)


def shade(sh: Tensor, means: Tensor, view: Tensor) -> Tensor:
    """Colours (N, 3) seen from the camera: max(0.5 + sum of coefficients times basis, 0)."""
    centre = -view[:3, :3].T @ view[:3, 3]
    basis = sh_basis(torch.nn.functional.normalize(means - centre, dim=1), DEGREE[sh.shape[1]])
    return torch.clamp(0.5 + torch.einsum("nk,nkc->nc", basis, sh), min=0.0)


def sh_basis(direction: Tensor, degree: int) -> Tensor:
    """Real spherical harmonics, signs and order of 3DGS files. direction: (N, 3) unit -> (N, (degree + 1)^2)."""
    x, y, z = direction.unbind(1)
    xx, yy, zz = x * x, y * y, z * z
    basis = [torch.full_like(x, SH_0)]
    if degree > 0:
        basis += [-SH_1 * y, SH_1 * z, -SH_1 * x]
    if degree > 1:
        basis += [
            *(1.0925484305920792 * x * y, -1.0925484305920792 * y * z, 0.31539156525252005 * (2 * zz - xx - yy)),
            *(-1.0925484305920792 * x * z, 0.5462742152960396 * (xx - yy)),
        ]
    if degree > 2:
        basis += [
            *(-0.5900435899266435 * y * (3 * xx - yy), 2.890611442640554 * x * y * z),
            *(-0.4570457994644658 * y * (4 * zz - xx - yy), 0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy)),
            *(-0.4570457994644658 * x * (4 * zz - xx - yy), 1.445305721320277 * z * (xx - yy)),
            -0.5900435899266435 * x * (xx - 3 * yy),
        ]
    return torch.stack(basis, 1)
