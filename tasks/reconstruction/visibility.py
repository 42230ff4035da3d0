"""How much of the training images each Gaussian shows.

What lies below the surface is covered in every image: nothing keeps it in its place, and it takes part in what is made
of the paths.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import torch

from tasks.reconstruction.cuts import View
from tasks.reconstruction.rasterize import rasterize


def shown(drawn: Iterable[tuple[View, tuple[torch.Tensor, torch.Tensor, torch.Tensor]]], backend: str) -> np.ndarray:
    """The sum over views of each Gaussian's blending weights over all pixels, up to a common factor, (N,) float64.

    drawn: views, and the means (N, 3), scales (N, 1) and opacities (N,) that they see. A pixel's colour is linear in
    the Gaussians' colours, and the weights are its derivatives.
    """
    total = 0.0
    for view, (means, scales, opacities) in drawn:
        grey = torch.zeros((len(means), 1, 3), device=means.device, requires_grad=True)
        black = torch.zeros(3, device=means.device)
        given = means.detach(), scales.detach(), opacities.detach(), grey
        colour, _, _ = rasterize(*given, view.view, view.intrinsics, view.size, black, backend=backend)
        colour[..., 0].sum().backward()
        total = total + grey.grad[:, 0, 0].cpu().numpy().astype(np.float64)
    return total
