"""Linear blend skinning of Gaussians by a few of many nodes, with its gradient: kernels behind autograd."""

from __future__ import annotations

import numba
import numpy as np
import torch


def skin_reference(
    points: torch.Tensor,  # (N, 3)
    transforms: torch.Tensor,  # (B, 3, 4)
    index: torch.Tensor,  # (N, K)
    weights: torch.Tensor,  # (N, K)
) -> torch.Tensor:
    """x = sum_k w_k (A_k v + t_k), the slow and readable way. -> (N, 3)."""
    blended = (weights[..., None, None] * transforms[index.long()]).sum(1)  # (N, 3, 4)
    return (blended[..., :3] @ points[..., None])[..., 0] + blended[..., 3]


class Skin(torch.autograd.Function):
    """:func:`skin_reference` in float32 with gradients for points and transforms; index is int32."""

    @staticmethod
    def forward(ctx, points, transforms, index, weights):
        ctx.save_for_backward(points, transforms, index, weights)
        out = np.empty(points.shape, np.float32)
        _forward(*(t.detach().numpy() for t in (points, transforms, index, weights)), out)
        return torch.from_numpy(out)

    @staticmethod
    def backward(ctx, gradient):
        points, transforms, index, weights = (t.detach().numpy() for t in ctx.saved_tensors)
        to_points, to_transforms = np.empty_like(points), np.zeros_like(transforms)
        _backward(points, transforms, index, weights, gradient.contiguous().numpy(), to_points, to_transforms)
        return torch.from_numpy(to_points), torch.from_numpy(to_transforms), None, None


@numba.njit(cache=True, nogil=True, fastmath={"contract", "nsz"})
def _forward(points, transforms, index, weights, out):
    for n in range(len(points)):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        for a in range(3):
            total = np.float32(0.0)
            for k in range(index.shape[1]):
                t = transforms[index[n, k]]
                total += weights[n, k] * (t[a, 0] * x + t[a, 1] * y + t[a, 2] * z + t[a, 3])
            out[n, a] = total


@numba.njit(cache=True, nogil=True, fastmath={"contract", "nsz"})
def _backward(points, transforms, index, weights, gradient, to_points, to_transforms):
    for n in range(len(points)):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        px, py, pz = np.float32(0.0), np.float32(0.0), np.float32(0.0)
        for k in range(index.shape[1]):
            b, w = index[n, k], weights[n, k]
            for a in range(3):
                g = w * gradient[n, a]
                px += g * transforms[b, a, 0]
                py += g * transforms[b, a, 1]
                pz += g * transforms[b, a, 2]
                to_transforms[b, a, 0] += g * x
                to_transforms[b, a, 1] += g * y
                to_transforms[b, a, 2] += g * z
                to_transforms[b, a, 3] += g
        to_points[n, 0], to_points[n, 1], to_points[n, 2] = px, py, pz
