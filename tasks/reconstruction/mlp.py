"""Deformation by the paper's network: position and time in, what changes in that frame out (GA eq. 1)."""

from __future__ import annotations

import math

import numpy as np
import torch

from tasks.reconstruction.deformed import Deformed
from tasks.reconstruction.nodes import farthest
from tasks.reconstruction.rigidity import rotation_of

POSITION_BANDS, TIME_BANDS = 10, 6
NEAR_ZERO = 1e-5  # spread of the last layer's first weights: the fit starts at rest


class Mlp:
    """depth x width perceptron with ReLU, the input joined in again after layer ``skip``.

    Outputs of a point: shift (3), rotation vector (3), and with ``deltas`` change of log scale and of opacity logit.
    carriers: (B, 3) points at rest that rigidity is asked of; device: where all of it lies.
    """

    def __init__(
        self, times: np.ndarray, carriers: np.ndarray, *, depth: int, width: int, skip: int, deltas: bool, device: str
    ) -> None:
        self.times, self.skip, self.deltas = times.astype(np.float32), skip, deltas
        self.rest = torch.from_numpy(carriers).to(device)
        self.depth, self.width = depth, width
        self.layers: dict[str, torch.Tensor] = {}

    @classmethod
    def placed(cls, times: np.ndarray, points: np.ndarray, carriers: int, seed: int, **shape: object) -> Mlp:
        """A network at rest, its carriers spread over the points."""
        spread = points[farthest(points, min(carriers, len(points)))].astype(np.float32)
        net = cls(times, spread, **shape)
        random = torch.Generator().manual_seed(seed)
        inputs = 3 * (1 + 2 * POSITION_BANDS) + 1 + 2 * TIME_BANDS
        wide = inputs
        for k in range(net.depth):
            net._add(f"layer{k}", wide, net.width, math.sqrt(6.0 / wide), random)
            wide = net.width + (inputs if k == net.skip else 0)
        net._add("out", wide, 8 if net.deltas else 6, NEAR_ZERO, random)
        return net

    def _add(self, name: str, inputs: int, outputs: int, bound: float, random: torch.Generator) -> None:
        weight = (2 * torch.rand(outputs, inputs, generator=random) - 1) * bound
        self.layers[f"{name}.weight"] = weight.to(self.rest.device).requires_grad_()
        self.layers[f"{name}.bias"] = torch.zeros(outputs, device=self.rest.device, requires_grad=True)

    def bind(self, means: np.ndarray) -> None:
        """Every point is asked for itself: nothing to choose."""

    def out(self, frame: int, points: torch.Tensor) -> torch.Tensor:
        """The network's outputs for points at rest in a frame. (M, 3) -> (M, 6 or 8)."""
        time = torch.full((len(points), 1), float(self.times[frame]), device=points.device)
        given = torch.cat([_encode(points.detach(), POSITION_BANDS), _encode(time, TIME_BANDS)], dim=1)
        x = given
        for k in range(self.depth):
            x = torch.relu(self._layer(f"layer{k}", x))
            if k == self.skip:
                x = torch.cat([x, given], dim=1)
        return self._layer("out", x)

    def _layer(self, name: str, x: torch.Tensor) -> torch.Tensor:
        return torch.nn.functional.linear(x, self.layers[f"{name}.weight"], self.layers[f"{name}.bias"])

    def at(self, frame: int, means: torch.Tensor) -> Deformed:
        """Where the Gaussians are in a frame. means: (N, 3) at rest."""
        out = self.out(frame, torch.cat([means, self.rest]))
        own, carried = out[: len(means)], out[len(means) :]
        scales, opacities = (own[:, 6:7], own[:, 7]) if self.deltas else (None, None)
        turns = rotation_of(carried[:, 3:6])
        return Deformed(means + own[:, :3], self.rest + carried[:, :3], turns, scales, opacities)

    def roughness(self) -> torch.Tensor | None:
        """The bands of time bound how fast it may change: nothing to ask."""

    def copy_outwards(self, first: int, last: int, clip: int) -> None:
        """A network has no knots: frames not seen yet are what it makes of them."""


def _encode(x: torch.Tensor, bands: int) -> torch.Tensor:
    """x, sin(2^k pi x), cos(2^k pi x) for k below bands. (M, D) -> (M, D (1 + 2 bands))."""
    angle = (x[..., None] * (math.pi * 2.0 ** torch.arange(bands, device=x.device))).flatten(1)
    return torch.cat([x, torch.sin(angle), torch.cos(angle)], dim=1)
