"""Structural similarity as a training loss: value and gradient in one go, by separable blurs in numba.

Wang et al. 2004 with an 11 x 11 Gaussian window of sigma 1.5 and data range 1; zeros beyond the border and the mean
over the whole image, as Kerbl et al. 2023 train with. The number in reports is another: tasks/evaluation/images.py.
"""

from __future__ import annotations

import numpy as np
import torch
from numba import njit
from torch import Tensor

from tasks.errors import InputError
from tasks.geometry.parallel import for_chunks

HALF = 5
SIGMA = 1.5
C1, C2 = 0.01**2, 0.03**2
ROWS = 64  # a chunk of them
FAST = {"contract", "nsz", "arcp"}


def ssim(image: Tensor, truth: Tensor) -> Tensor:
    """Mean SSIM of two images, differentiable in the first.

    image, truth: (H, W, D) in 0..1, float32 or float64 on the processor, any number D of channels. Raises InputError
    where the shapes or types differ.
    """
    if image.ndim != 3 or image.shape != truth.shape or image.dtype != truth.dtype:
        expected = f"an image (H, W, D) like the truth's {tuple(truth.shape)} {truth.dtype}"
        raise InputError("ssim.image", expected=expected, found=f"{tuple(image.shape)} {image.dtype}")
    return _Ssim.apply(image, truth)


class _Ssim(torch.autograd.Function):
    @staticmethod
    def forward(ctx, image, truth):
        x, y = (t.detach().contiguous().numpy() for t in (image, truth))
        value, ctx.gradient = _value_and_gradient(x, y, ctx.needs_input_grad[0])
        return image.new_tensor(value)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, slope):
        return torch.from_numpy(ctx.gradient) * slope, None


def _value_and_gradient(x: np.ndarray, y: np.ndarray, wanted: bool) -> tuple[float, np.ndarray | None]:
    """x, y: (H, W, D). The gradient by x is of x's shape, or None where it is not wanted."""
    height, width, channels = x.shape
    taps = np.exp(-0.5 * (np.arange(-HALF, HALF + 1) / SIGMA) ** 2)
    taps = (taps / taps.sum())[: HALF + 1].astype(x.dtype)  # symmetric: from the edge to the middle
    flat, true = x.reshape(height, -1), y.reshape(height, -1)
    fields = np.zeros((5, height + 2 * HALF, width * channels), x.dtype)
    slopes = np.zeros((3, height + 2 * HALF, width * channels), x.dtype)
    sums = np.empty(height, np.float64)
    for_chunks(lambda a, b: products(a, b, flat, true, fields), height, ROWS)
    for_chunks(lambda a, b: compare(a, b, fields, taps, channels, slopes, sums), height, ROWS)
    value = float(sums.sum() / x.size)
    if not wanted:
        return value, None
    gradient = np.empty_like(flat)
    for_chunks(lambda a, b: spread(a, b, flat, true, slopes, taps, channels, gradient), height, ROWS)
    return value, gradient.reshape(x.shape)


@njit(cache=True, nogil=True, error_model="numpy", fastmath=FAST)
def products(first, last, x, y, fields):
    """x, y, xx, yy, xy of rows first..last-1 into fields (5, H + 2 HALF, W D)."""
    for i in range(first, last):
        for k in range(x.shape[1]):
            fields[0, i + HALF, k] = x[i, k]
        for k in range(x.shape[1]):
            fields[1, i + HALF, k] = y[i, k]
        for k in range(x.shape[1]):
            fields[2, i + HALF, k] = x[i, k] * x[i, k]
        for k in range(x.shape[1]):
            fields[3, i + HALF, k] = y[i, k] * y[i, k]
        for k in range(x.shape[1]):
            fields[4, i + HALF, k] = x[i, k] * y[i, k]


@njit(cache=True, nogil=True, error_model="numpy")
def blur_row(field, i, taps, channels, line, out):
    """Row i of a field blurred down and across. line: (W D + 2 HALF D,), zero at its ends."""
    middle = line[HALF * channels : HALF * channels + len(out)]
    row = field[i + HALF]
    for k in range(len(out)):
        middle[k] = taps[HALF] * row[k]
    for t in range(HALF):
        above, below = field[i + t], field[i + 2 * HALF - t]
        for k in range(len(out)):
            middle[k] += taps[t] * (above[k] + below[k])
    for k in range(len(out)):
        out[k] = taps[HALF] * middle[k]
    for t in range(HALF):
        left, right = line[t * channels :], line[(2 * HALF - t) * channels :]
        for k in range(len(out)):
            out[k] += taps[t] * (left[k] + right[k])


@njit(cache=True, nogil=True, error_model="numpy", fastmath=FAST)
def compare(first, last, fields, taps, channels, slopes, sums):
    """SSIM of rows first..last-1 summed into sums; its slopes by the blurred x, xx and xy into slopes."""
    real = fields.dtype.type
    two, c1, c2 = real(2.0), real(C1), real(C2)
    length = fields.shape[2]
    line = np.zeros(length + 2 * HALF * channels, fields.dtype)
    blurred = np.empty((5, length), fields.dtype)
    values = np.empty(length, fields.dtype)
    for i in range(first, last):
        for f in range(5):
            blur_row(fields[f], i, taps, channels, line, blurred[f])
        for k in range(length):
            x, y = blurred[0, k], blurred[1, k]
            a1, b1 = two * x * y + c1, x * x + y * y + c1
            a2 = two * (blurred[4, k] - x * y) + c2
            b2 = (blurred[2, k] - x * x) + (blurred[3, k] - y * y) + c2
            scale = real(1.0) / (b1 * b2)
            s = a1 * a2 * scale
            values[k] = s
            of_xx, of_xy = -s / b2, two * a1 * scale
            slopes[0, i + HALF, k] = two * y * a2 * scale - two * x * s / b1 - two * x * of_xx - y * of_xy
            slopes[1, i + HALF, k] = of_xx
            slopes[2, i + HALF, k] = of_xy
        total = 0.0
        for k in range(length):
            total += values[k]
        sums[i] = total


@njit(cache=True, nogil=True, error_model="numpy", fastmath=FAST)
def spread(first, last, x, y, slopes, taps, channels, gradient):
    """Gradient of the mean by x, rows first..last-1: the blur is its own adjoint."""
    real = x.dtype.type
    length = x.shape[1]
    share = real(1.0) / real(x.size)
    line = np.zeros(length + 2 * HALF * channels, x.dtype)
    blurred = np.empty((3, length), x.dtype)
    for i in range(first, last):
        for f in range(3):
            blur_row(slopes[f], i, taps, channels, line, blurred[f])
        for k in range(length):
            direct = blurred[0, k] + real(2.0) * x[i, k] * blurred[1, k] + y[i, k] * blurred[2, k]
            gradient[i, k] = share * direct
