"""Adam in one pass over a parameter: no temporaries, and moments that a checkpoint can hold."""

from __future__ import annotations

import numba
import numpy as np
import torch

BETAS = (0.9, 0.99)  # a second moment of 100 steps follows parameters that only some views touch
EPSILON = 1e-15


class Adam:
    """Kingma & Ba 2015, bias-corrected. Moments are kept for each parameter by its name, shaped like it."""

    def __init__(self) -> None:
        self.first: dict[str, torch.Tensor] = {}
        self.second: dict[str, torch.Tensor] = {}

    def step(self, name: str, value: torch.Tensor, rate: float, iteration: int) -> None:
        """Moves ``value`` in place along its gradient and forgets that. iteration: counts from one."""
        if name not in self.first:
            self.first[name], self.second[name] = torch.zeros_like(value), torch.zeros_like(value)
        scale = rate * float(np.sqrt(1.0 - BETAS[1] ** iteration)) / (1.0 - BETAS[0] ** iteration)
        arrays = value.detach(), value.grad.contiguous(), self.first[name].detach(), self.second[name].detach()
        if value.is_cuda:
            step_reference(*arrays, scale)
        else:
            flat = (a.view(-1).numpy() for a in arrays)
            _step(*flat, np.float32(scale), np.float32(BETAS[0]), np.float32(BETAS[1]), np.float32(EPSILON))
        value.grad = None

    def forget(self, name: str, rows: np.ndarray) -> None:
        """No momentum for some rows of a parameter."""
        if name in self.first:
            self.first[name][rows] = 0.0
            self.second[name][rows] = 0.0


def step_reference(
    value: torch.Tensor, gradient: torch.Tensor, first: torch.Tensor, second: torch.Tensor, scale: float
) -> None:
    """One step by torch's own operations, in place, all of one shape."""
    first.lerp_(gradient, 1.0 - BETAS[0])
    second.mul_(BETAS[1]).addcmul_(gradient, gradient, value=1.0 - BETAS[1])
    value.addcdiv_(first, second.sqrt().add_(EPSILON), value=-scale)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _step(value, gradient, first, second, scale, b1, b2, epsilon):
    one = np.float32(1.0)
    for i in range(value.size):
        g = gradient[i]
        first[i] = b1 * first[i] + (one - b1) * g
        second[i] = b2 * second[i] + (one - b2) * g * g
        value[i] -= scale * first[i] / (np.sqrt(second[i]) + epsilon)
