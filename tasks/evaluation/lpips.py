"""LPIPS (Zhang et al. 2018) with weights that the user brings; without them there is no such number.

The weights are a .safetensors or .npz file under the names of their sources: ``features.N.weight`` and ``.bias`` of
torchvision's AlexNet or VGG-16, and ``linK.model.1.weight`` (K = 0..4) of the authors' heads, version 0.1.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from tasks.errors import InputError

if TYPE_CHECKING:
    from torch import Tensor

SHIFT, SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)  # of the inputs, which lie in -1..1
# the layers of torchvision's `features`: a convolution's number, stride and padding; "pool"; "tap" where LPIPS looks
ALEX = ((0, 4, 2), "tap", "pool", (3, 1, 2), "tap", "pool", (6, 1, 1), "tap", (8, 1, 1), "tap", (10, 1, 1), "tap")
ALEX_POOL, VGG_POOL = (3, 2), (2, 2)
VGG = (
    *((0, 1, 1), (2, 1, 1), "tap", "pool", (5, 1, 1), (7, 1, 1), "tap", "pool"),
    *((10, 1, 1), (12, 1, 1), (14, 1, 1), "tap", "pool", (17, 1, 1), (19, 1, 1), (21, 1, 1), "tap", "pool"),
    *((24, 1, 1), (26, 1, 1), (28, 1, 1), "tap"),
)


def load(path: str) -> Callable[[np.ndarray, np.ndarray], float]:
    """LPIPS as a function of two images (H, W, 3) in 0..1. Raises InputError where the file is not what it needs."""
    import torch

    weights = {name: torch.from_numpy(np.ascontiguousarray(a, np.float32)) for name, a in _read(Path(path)).items()}
    layers, pool = (ALEX, ALEX_POOL) if _get(weights, path, "features.0.weight").shape[2] == 11 else (VGG, VGG_POOL)
    for layer in layers:
        if isinstance(layer, tuple):
            _get(weights, path, f"features.{layer[0]}.weight")
            _get(weights, path, f"features.{layer[0]}.bias")
    heads = [_get(weights, path, f"lin{k}.model.1.weight") for k in range(5)]

    def distance(image: np.ndarray, truth: np.ndarray) -> float:
        with torch.no_grad():
            a, b = (_looks(_input(x), weights, layers, pool) for x in (image, truth))
            apart = [((x - y) ** 2 * head).sum(1).mean() for x, y, head in zip(a, b, heads, strict=True)]
            return float(sum(apart))

    return distance


def _input(image: np.ndarray) -> Tensor:
    import torch

    x = torch.as_tensor(2.0 * np.asarray(image, np.float32) - 1.0).permute(2, 0, 1)[None]
    return (x - torch.tensor(SHIFT)[:, None, None]) / torch.tensor(SCALE)[:, None, None]


def _looks(x: Tensor, weights: dict, layers: tuple, pool: tuple[int, int]) -> list[Tensor]:
    """The features at the five taps, of unit length over the channels."""
    from torch.nn import functional

    found = []
    for layer in layers:
        if layer == "tap":
            found.append(x / (x.square().sum(1, keepdim=True).sqrt() + 1e-10))
        elif layer == "pool":
            x = functional.max_pool2d(x, *pool)
        else:
            number, stride, padding = layer
            w, b = weights[f"features.{number}.weight"], weights[f"features.{number}.bias"]
            x = functional.relu(functional.conv2d(x, w, b, stride, padding))
    return found


def _read(path: Path) -> dict[str, np.ndarray]:
    if not path.is_file():
        raise InputError("evaluate.lpips", expected="a file of weights", found=str(path), do="or set it to null")
    try:
        if path.suffix == ".npz":
            with np.load(path, allow_pickle=False) as arrays:
                return dict(arrays)
        from safetensors.numpy import load_file

        return load_file(path)
    except Exception as error:  # zip, header or type errors, depending on the file
        raise InputError(str(path), expected="a .safetensors or .npz file of weights", found=str(error)) from None


def _get(weights: dict, path: str, name: str):
    if name not in weights:
        raise InputError(str(path), expected=f"an array {name}", found=", ".join(sorted(weights)[:6]) or "no arrays")
    return weights[name]
