"""Where Gaussians are: transparent ones move to where the images pull hardest, their number grows, hidden ones go."""

from __future__ import annotations

import numpy as np
import torch

from tasks.reconstruction.adam import Adam

NAMES = ("means", "log_scales", "opacities", "sh")  # parameters with a row for each Gaussian
TRANSPARENT = 0.05  # opacity below which a Gaussian does nothing
SHRINK = 0.75  # scale of both halves of a divided Gaussian: they cover about what it did
APART = 0.6  # standard deviation of a half's place, in scales


class Pull:
    """How hard the images pull at each Gaussian's place: mean length of the gradient, over the views that see it."""

    def __init__(self, count: int) -> None:
        self.total, self.seen = np.zeros(count, np.float32), np.zeros(count, np.float32)

    def add(self, gradient: torch.Tensor) -> None:
        """gradient: (N, 3) of the loss with respect to the means."""
        length = gradient.norm(dim=1).cpu().numpy()
        self.total += length
        self.seen += length > 0

    def mean(self) -> np.ndarray:
        """(N,)."""
        return self.total / np.maximum(self.seen, 1.0)


def divide(
    params: dict[str, torch.Tensor], adam: Adam, pull: Pull, most: int, growth: float, rng: np.random.Generator
) -> int:
    """Divides Gaussians that are pulled hard; the second halves take the place of transparent ones, then of new ones.

    The number grows by the share ``growth`` up to ``most``. Gaussians are drawn with chances as their pull.
    Returns how many were divided.
    """
    with torch.no_grad():
        opaque = torch.sigmoid(params["opacities"]).cpu().numpy() >= TRANSPARENT
        chance = (pull.mean() * opaque).astype(np.float64)
        count, free = len(opaque), np.flatnonzero(~opaque)
        added = max(0, min(most - count, round(growth * count)))
        wanted = min(len(free) + added, int(np.count_nonzero(chance)))
        if wanted == 0:
            return 0
        chosen = np.sort(rng.choice(count, wanted, replace=False, p=chance / chance.sum()))
        free = free[:wanted]
        for name in NAMES:
            _append(params, adam, name, chosen[len(free) :])
            params[name].data[free] = params[name].data[chosen[: len(free)]]
        second = np.concatenate([free, np.arange(count, count + wanted - len(free))])
        both = np.concatenate([chosen, second])
        shift = rng.normal(size=(wanted, 3)).astype(np.float32)
        step = torch.from_numpy(APART * shift).to(params["means"]) * torch.exp(params["log_scales"].data[chosen])
        params["means"].data[chosen] += step
        params["means"].data[second] -= step
        params["log_scales"].data[both] += float(np.log(SHRINK))
        for name in NAMES:
            adam.forget(name, both)
    return wanted


def keep(params: dict[str, torch.Tensor], adam: Adam, rows: np.ndarray) -> None:
    """Leaves only some Gaussians, with their moments. rows: rising numbers."""
    for name in NAMES:
        params[name] = params[name].detach()[rows].clone().requires_grad_()
        for moments in (m for m in (adam.first, adam.second) if name in m):
            moments[name] = moments[name][rows].clone()


def _append(params: dict[str, torch.Tensor], adam: Adam, name: str, rows: np.ndarray) -> None:
    """Copies of some rows at the end, with the room for their moments."""
    if len(rows) == 0:
        return
    old = params[name].data
    params[name] = torch.cat([old, old[rows]]).requires_grad_()
    for moments in (m for m in (adam.first, adam.second) if name in m):
        moments[name] = torch.cat([moments[name], moments[name][rows]])
