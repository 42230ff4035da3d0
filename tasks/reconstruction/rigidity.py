"""Local rigidity of what carries the Gaussians, over neighbours at rest (GA eq. 3 and 4).

Both terms are means over neighbour pairs, in units of the pairs' mean squared length at rest.
"""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial import cKDTree

TINY = 1e-12


class Neighbourhood:
    """The k nearest neighbours of every carrier at rest. rest: (B, 3) -> index (B, k), edges (B, k, 3)."""

    def __init__(self, rest: torch.Tensor, k: int) -> None:
        points = rest.detach().cpu().numpy()
        k = min(k, len(points) - 1)
        _, near = cKDTree(points).query(points, k=k + 1)
        self.index = torch.from_numpy(np.ascontiguousarray(near.reshape(len(points), -1)[:, 1:])).to(rest.device)
        self.edges = rest[self.index] - rest[:, None]
        self.lengths = self.edges.norm(dim=-1)
        self.unit = float((self.lengths**2).mean()) if k else 1.0

    def rigidity(self, moved: torch.Tensor, turns: torch.Tensor | None) -> tuple[torch.Tensor, torch.Tensor]:
        """The terms |e' - R_i e|^2 (as rigid as possible) and (|e'| - |e|)^2 (distances kept), two scalars.

        moved: (B, 3); turns: (B, 3, 3), each carrier's own rotation R_i, which then learns from the term too; or None
        for the rotation that fits its neighbours best, by SVD (eq. 4), through which no gradient flows.
        """
        now = moved[self.index] - moved[:, None]  # (B, k, 3)
        if turns is None:
            turns = best_rotations(self.edges, now.detach())
        rigid = ((now - torch.einsum("bij,bkj->bki", turns, self.edges)) ** 2).sum(-1).mean()
        kept = ((torch.sqrt((now**2).sum(-1) + TINY) - self.lengths) ** 2).mean()
        return rigid / self.unit, kept / self.unit


def best_rotations(source: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """Kabsch: H = sum source target^T = U S V^T, R = V diag(1, 1, det) U^T. (B, k, 3) twice -> (B, 3, 3).

    Eq. 4 prints U V^T, which is the inverse and may reflect.
    """
    u, _, vt = torch.linalg.svd(torch.einsum("bki,bkj->bij", source, target))
    sign = torch.det(u) * torch.det(vt)
    v = vt.transpose(1, 2)
    return torch.cat([v[:, :, :2], v[:, :, 2:] * sign[:, None, None]], dim=2) @ u.transpose(1, 2)


def rotation_of(vectors: torch.Tensor) -> torch.Tensor:
    """Rodrigues: rotation vectors (B, 3) in radians -> (B, 3, 3); smooth at zero."""
    squared = (vectors**2).sum(-1)[:, None, None]
    angle = torch.sqrt(squared + TINY)
    x, y, z = vectors.unbind(1)
    nil = torch.zeros_like(x)
    k = torch.stack([nil, -z, y, z, nil, -x, -y, x, nil], dim=1).view(-1, 3, 3)
    eye = torch.eye(3, dtype=vectors.dtype, device=vectors.device)
    return eye + torch.sin(angle) / angle * k + (1 - torch.cos(angle)) / (angle**2) * (k @ k)
