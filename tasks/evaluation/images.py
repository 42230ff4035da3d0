"""How near rendered images are to the true ones: PSNR, SSIM, FLIP, and LPIPS where its weights are given.

Images are compared over the capture's background, with values in 0..1 as the files have them (sRGB).
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import correlate1d

from tasks.errors import InputError
from tasks.evaluation.metrics import declared
from tasks.values import Capture, Metrics

WINDOW, SIGMA = 11, 1.5
C1, C2 = 0.01**2, 0.03**2
LEAST_ERROR = 1e-10  # equal images have 100 dB


def evaluate_views(rendered: Capture, truth: Capture, *, ssim_down: bool, lpips: str | None) -> Metrics:
    """Means over the images of the numbers of each.

    ssim_down: also SSIM of shrunken images (see :func:`ssim_shrunk`), which some report as SSIM; lpips: a file with the
    weights of LPIPS, without which that number is left out. Raises InputError where the captures do not match.
    """
    _check(rendered, truth)
    perceptual = None
    if lpips is not None:
        from tasks.evaluation.lpips import load

        perceptual = load(lpips)
    rows = []
    for i in range(len(truth.images)):
        image, true = (over_background(c.images[i], truth.background) for c in (rendered, truth))
        row = {"psnr": psnr(image, true), "ssim": ssim(image, true), "flip": flip(image, true)}
        row |= {"ssim_down": ssim_shrunk(image, true)} if ssim_down else {}
        row |= {"lpips": perceptual(image, true)} if perceptual else {}
        rows.append(row)
    return declared({name: float(np.mean([row[name] for row in rows])) for name in rows[0]}, truth.unit)


def over_background(image: np.ndarray, background: np.ndarray) -> np.ndarray:
    """(H, W, 4) uint8 of straight colour and alpha -> (H, W, 3) float64 in 0..1 over a colour (3,) in 0..1."""
    values = image.astype(np.float64) / 255.0
    alpha = values[:, :, 3:]
    return values[:, :, :3] * alpha + (1.0 - alpha) * np.asarray(background, np.float64)


def psnr(image: np.ndarray, truth: np.ndarray) -> float:
    """10 log10(1 / mean squared error), in dB; at most 100, which equal images have. image, truth: (H, W, D)."""
    return float(-10.0 * np.log10(max(np.mean((image - truth) ** 2), LEAST_ERROR)))


def ssim(image: np.ndarray, truth: np.ndarray) -> float:
    """Structural similarity (Wang et al. 2004): 11 x 11 Gaussian window of sigma 1.5, data range 1, K 0.01 and 0.03.

    image, truth: (H, W, D) at their own size. The mean over channels and over all windows that lie within the image.
    """
    x, y = np.asarray(image, np.float64), np.asarray(truth, np.float64)
    mx, my = _windows(x), _windows(y)
    vx, vy, cov = _windows(x * x) - mx * mx, _windows(y * y) - my * my, _windows(x * y) - mx * my
    values = (2 * mx * my + C1) * (2 * cov + C2) / ((mx * mx + my * my + C1) * (vx + vy + C2))
    return float(values.mean())


def ssim_shrunk(image: np.ndarray, truth: np.ndarray) -> float:
    """SSIM after averaging over squares of round(min(H, W) / 256) pixels, as Wang's own script and piq do unasked.

    Higher than SSIM wherever it shrinks (from 384 pixels on), so never to be held against it.
    """
    side = max(1, round(min(image.shape[:2]) / 256))
    rows, columns = image.shape[0] // side, image.shape[1] // side

    def shrunk(a: np.ndarray) -> np.ndarray:
        squares = a[: rows * side, : columns * side].reshape(rows, side, columns, side, -1)
        return squares.mean(axis=(1, 3))

    return ssim(shrunk(image), shrunk(truth))


def flip(image: np.ndarray, truth: np.ndarray) -> float:
    """Mean LDR-FLIP (Andersson et al. 2020), 0 for equal images, at its own default of 67 pixels a degree.

    Seen from so near that the authors' default viewer (0.7 m from a 4k screen of 0.7 m) tells single pixels apart.
    """
    from flip_evaluator import evaluate

    errors = evaluate(truth.astype(np.float32), image.astype(np.float32), "LDR", applyMagma=False)[0]
    return float(np.mean(errors, dtype=np.float64))


def _windows(values: np.ndarray) -> np.ndarray:
    """Gaussian means over every window that lies within the image."""
    taps = np.exp(-0.5 * ((np.arange(WINDOW) - WINDOW // 2) / SIGMA) ** 2)
    taps /= taps.sum()
    inside = slice(WINDOW // 2, -(WINDOW // 2))
    return correlate1d(correlate1d(values, taps, axis=0), taps, axis=1)[inside, inside]


def _check(rendered: Capture, truth: Capture) -> None:
    where = f"{truth.name}: rendered images"
    if rendered.images.shape != truth.images.shape:
        raise InputError(where, expected=f"shape {truth.images.shape}", found=str(rendered.images.shape))
    if len(truth.images) == 0:
        raise InputError(f"{truth.name}: images", expected="at least one", found="none")
    if min(truth.size) < WINDOW:
        raise InputError(f"{truth.name}: images", expected=f"at least {WINDOW} pixels a side", found=str(truth.size))
    for name in ("camera", "frame"):
        if not np.array_equal(getattr(rendered, name), getattr(truth, name)):
            raise InputError(where, expected=f"the {name}s of the true ones", found="others")
