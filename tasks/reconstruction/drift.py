"""Where the thing is in every frame, from its masks alone: what moves as a whole need not be searched by gradients."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from tasks.values import Capture

IMAGES = 6.0  # that a frame's place is mostly made of: fewer leave it to the shape of single masks
FAINT = 1e-3  # pull to the mean place, against that of the images: it settles what rays that are all alike leave open


def drift(capture: Capture) -> np.ndarray:
    """The point nearest to the rays through the masks' centres of mass, (F, 3) in the data's unit.

    A frame's own images count most, others of its clip by a bell over time as wide as holds ``IMAGES``; so one moving
    camera serves as well as several standing ones. Zero where the capture has no alpha.
    """
    found = np.zeros((len(capture.times), 3))
    if not capture.has_alpha:
        return found
    eye, ray, seen = _rays(capture)
    across = np.eye(3) - ray[:, :, None] * ray[:, None, :]  # (I, 3, 3): what is not along the ray
    push = np.einsum("iab,ib->ia", across, eye)
    mean = np.linalg.solve(across[seen].sum(0) + FAINT * seen.sum() * np.eye(3), push[seen].sum(0))
    for low, high in pairwise(capture.clip_start.tolist()):
        own = np.flatnonzero((capture.frame >= low) & (capture.frame < high) & seen)
        width = max(0.5, 0.5 * IMAGES * (high - low) / max(len(own), 1))
        far = (np.arange(low, high)[:, None] - capture.frame[own]) / width
        weight = np.exp(-0.5 * far**2) + 1e-6  # (frames, images): where there is no image near, the clip's mean
        faint = FAINT * (weight.sum(1) + 1e-6)
        system = np.einsum("fi,iab->fab", weight, across[own]) + faint[:, None, None] * np.eye(3)
        right = weight @ push[own] + faint[:, None] * mean
        found[low:high] = np.linalg.solve(system, right[..., None])[..., 0]
    return found


def _rays(capture: Capture) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Eyes (I, 3), unit rays (I, 3) through the masks' centres of mass, and which images (I,) show the thing at all."""
    h, w = capture.size
    columns, rows = (capture.images[..., 3].sum(axis, dtype=np.int64) for axis in (1, 2))
    total = np.maximum(columns.sum(1), 1)
    middle = np.stack([columns @ (np.arange(w) + 0.5), rows @ (np.arange(h) + 0.5)], axis=1) / total[:, None]
    lens = capture.intrinsics.astype(np.float64)
    local = np.concatenate([(middle - lens[:, :2, 2]) / lens[:, [0, 1], [0, 1]], np.ones((len(middle), 1))], axis=1)
    turn, shift = capture.view[:, :3, :3].astype(np.float64), capture.view[:, :3, 3].astype(np.float64)
    ray = np.einsum("iab,ia->ib", turn, local)
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    return -np.einsum("iab,ia->ib", turn, shift), ray, columns.any(1)
