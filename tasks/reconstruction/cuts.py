"""The images of a capture as a fit wants them: scaled, cut to the thing, multiplied by alpha."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch

from tasks.errors import InputError
from tasks.reconstruction.hull import INSIDE
from tasks.values import Capture

MARGIN = 0.08  # of the image's longer side, kept round the thing: what strays there is still seen and punished
SMALLEST = 16  # pixels: an image is not scaled below


@dataclass(frozen=True)
class View:
    """One cut of an image. view: (4, 4); intrinsics: (3, 3) of the cut; colour: (H, W, 3) multiplied by alpha,
    alpha: (H, W) or None; pixels: of the whole image, in which all that was cut away is background."""

    view: torch.Tensor
    intrinsics: torch.Tensor
    colour: torch.Tensor
    alpha: torch.Tensor | None
    pixels: int

    @property
    def size(self) -> tuple[int, int]:
        """Height and width of the cut."""
        return self.colour.shape[0], self.colour.shape[1]


class Views:
    """The images in one size. share: of the capture's own size; centre, unit: the world is moved and scaled so that
    the thing lies round the origin with about unit size, which changes no picture."""

    def __init__(self, capture: Capture, share: float, centre: np.ndarray, unit: float, device: str) -> None:
        h, w = capture.size
        height, width = max(round(h * share), SMALLEST), max(round(w * share), SMALLEST)
        scale = np.array([width / w, height / h, 1.0])
        self._pixels, self._device, self._has_alpha = height * width, device, capture.has_alpha
        view = capture.view.astype(np.float64)
        view[:, :3, 3] = (view[:, :3, 3] + view[:, :3, :3] @ centre) / unit
        self._view = torch.from_numpy(view.astype(np.float32)).to(device)
        self._images, self._intrinsics = [], []
        margin = round(MARGIN * max(height, width))
        for image, own in zip(capture.images, capture.intrinsics, strict=True):
            small = _premultiplied(image, height, width) if capture.has_alpha else _scaled(image, height, width)
            rows, columns = _box(small[..., 3], margin) if capture.has_alpha else (slice(0, height), slice(0, width))
            intrinsics = own.astype(np.float64) * scale[:, None]
            intrinsics[:2, 2] -= columns.start, rows.start
            self._intrinsics.append(torch.from_numpy(intrinsics.astype(np.float32)).to(device))
            self._images.append(np.ascontiguousarray(small[rows, columns]))

    def __getitem__(self, i: int) -> View:
        image = torch.from_numpy(self._images[i]).to(self._device).float() * (1.0 / 255.0)
        alpha = image[..., 3] if self._has_alpha else None
        return View(self._view[i], self._intrinsics[i], image[..., :3], alpha, self._pixels)


def check(capture: Capture) -> None:
    """Raises InputError for a capture that no fit can use."""
    found = None
    if len(capture.images) < 2:
        found = f"{len(capture.images)} image(s)"
    elif not (np.isfinite(capture.view).all() and np.isfinite(capture.intrinsics).all()):
        found = "a camera that is not finite"
    elif capture.frame.min() < 0 or capture.frame.max() >= len(capture.times):
        found = f"an image of frame {int(capture.frame.max())} among {len(capture.times)} times"
    elif capture.has_alpha and not (capture.images[..., 3] >= INSIDE).any():
        found = "nothing but transparent pixels"
    if found:
        raise InputError(capture.name, expected="two images or more of one thing, with cameras and times", found=found)


def _scaled(image: np.ndarray, height: int, width: int) -> np.ndarray:
    return cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)


def _premultiplied(image: np.ndarray, height: int, width: int) -> np.ndarray:
    """Colours times alpha, then scaled: an edge's colour is not mixed with what lies under transparent pixels."""
    whole = image.astype(np.float32)
    whole[..., :3] *= whole[..., 3:] / 255.0
    return np.rint(_scaled(whole, height, width)).astype(np.uint8)


def _box(alpha: np.ndarray, margin: int) -> tuple[slice, slice]:
    """Rows and columns that hold the thing, with a margin; the whole image where nothing is seen."""
    found = []
    for axis in (1, 0):
        seen, size = np.flatnonzero(alpha.any(axis)), alpha.shape[1 - axis]
        low, high = (seen[0], seen[-1] + 1) if len(seen) else (0, size)
        found.append(slice(max(int(low) - margin, 0), min(int(high) + margin, size)))
    return found[0], found[1]
