"""How far a rendered view is from its image (GA eq. 2), term by term."""

from __future__ import annotations

import torch

from tasks.reconstruction.cuts import View
from tasks.reconstruction.ssim import ssim


def photometric(
    colour: torch.Tensor, alpha: torch.Tensor, view: View, background: torch.Tensor, *, structure: float, cover: float
) -> tuple[dict[str, torch.Tensor], torch.Tensor]:
    """The weighted terms of (1 - l) L1 + l (1 - SSIM) + cover |alpha - true alpha|, and the mean squared error of the
    whole image. colour: (H, W, 3) and alpha: (H, W) as rendered over the background (3,); structure: l, 0 leaves SSIM
    out."""
    true = view.colour
    if view.alpha is not None:
        true = true + (1.0 - view.alpha)[..., None] * background
    difference = colour - true
    terms = {"colour": (1.0 - structure) * difference.abs().mean()}
    if structure > 0:
        terms["structure"] = structure * (1.0 - ssim(colour.cpu(), true.cpu())).to(colour)
    if view.alpha is not None and cover > 0:
        terms["alpha"] = cover * (alpha - view.alpha).abs().mean()
    squared = difference.detach().square().sum() / (3 * view.pixels)
    return terms, squared
