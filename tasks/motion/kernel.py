"""Kernel ridge regression whose settings are chosen by leaving whole clips out."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.linalg import cho_factor, cho_solve

WIDTHS, RIDGES = (0.5, 1.0, 2.0, 4.0), (0.1, 1.0, 10.0)  # multiples of the settings that are tried
JITTER = 1e-9


@dataclass(frozen=True)
class Ridge:
    """y(x) = mean + k(x, centres) coefficients. centres: (M, D); coefficients: (M, Y); mean: (Y,); scale: twice the
    kernel's squared width."""

    centres: np.ndarray
    coefficients: np.ndarray
    mean: np.ndarray
    scale: float

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """(F, D) -> (F, Y)."""
        return self.mean + np.exp(-squared_distances(x, self.centres) / self.scale) @ self.coefficients


def fit(
    x: np.ndarray, y: np.ndarray, clip_start: np.ndarray, *, width: float, ridge: float, tune: bool, landmarks: int
) -> Ridge:
    """Gaussian kernel ridge regression of y (F, Y) on x (F, D).

    width: of the kernel, in units of the median distance between frames; ridge: added to the kernel's diagonal.
    tune: try multiples of both, and a mean of zero beside the training mean, and keep what predicts left-out clips best
    in the least-squares sense (needs two clips).
    landmarks: at most so many frames become centres, evenly taken; the others still count (Nystroem), while tuning
    sees the centres only.
    """
    chosen = np.unique(np.linspace(0, len(x) - 1, min(landmarks, len(x))).round().astype(int))
    centres, known = x[chosen], y[chosen]
    apart = squared_distances(centres, centres)
    unit = 2.0 * float(np.median(apart[apart > 0])) if (apart > 0).any() else 1.0
    centred = True
    if tune and len(clip_start) > 2:
        clip = np.searchsorted(clip_start, chosen, side="right") - 1
        width, ridge, centred = _best(apart / unit, known, clip, width, ridge)
    mean = y.mean(0) if centred else np.zeros(y.shape[1])
    scale = unit * width**2
    inner = np.exp(-apart / scale)
    if len(chosen) == len(x):
        left, right = inner + ridge * np.eye(len(x)), y - mean
    else:
        cross = np.exp(-squared_distances(centres, x) / scale)
        left, right = cross @ cross.T + ridge * inner, cross @ (y - mean)
    left[np.diag_indices_from(left)] += JITTER * np.trace(left) / len(left)
    return Ridge(centres, cho_solve(cho_factor(left), right), mean, scale)


def squared_distances(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(M, D), (N, D) -> (M, N)."""
    return np.maximum((a * a).sum(1)[:, None] + (b * b).sum(1) - 2.0 * a @ b.T, 0.0)


def left_out_errors(inverse: np.ndarray, y: np.ndarray, clip: np.ndarray, centred: bool) -> float:
    """Sum of squared errors of the regression on every clip when trained without it, in closed form.

    inverse: Q = (K + ridge I)^-1; leaving a block c out leaves the error Q_cc^-1 (Q (y - m))_c, m the mean of the rest.
    """
    total = 0.0
    for c in np.unique(clip):
        mine = clip == c
        mean = y[~mine].mean(0) if centred else np.zeros(y.shape[1])
        error = np.linalg.solve(inverse[np.ix_(mine, mine)], inverse[mine] @ (y - mean))
        total += float((error**2).sum())
    return total


def _best(apart: np.ndarray, y: np.ndarray, clip: np.ndarray, width: float, ridge: float) -> tuple[float, float, bool]:
    best = (np.inf, width, ridge, True)
    for w, r in product(WIDTHS, RIDGES):
        gram = np.exp(-apart / (width * w) ** 2) + ridge * r * np.eye(len(apart))
        inverse = cho_solve(cho_factor(gram), np.eye(len(gram)))
        for centred in (True, False):
            best = min(best, (left_out_errors(inverse, y, clip, centred), width * w, ridge * r, centred))
    return best[1:]
