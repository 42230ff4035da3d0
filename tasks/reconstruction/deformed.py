"""What a deformation says about one frame."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import torch


@dataclass(frozen=True)
class Deformed:
    """means: (N, 3); log_scales, opacities: (N, 1) and (N,) added to the log scales and to the opacities' logits, or
    None; carriers: (B, 3) moved places of what rigidity is asked of, and turns: (B, 3, 3) their rotations."""

    means: torch.Tensor
    carriers: torch.Tensor
    turns: torch.Tensor
    log_scales: torch.Tensor | None = None
    opacities: torch.Tensor | None = None
