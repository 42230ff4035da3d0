"""Kernel ridge regression whose settings are chosen by leaving whole clips out."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from numba import njit
from scipy.linalg import cho_factor, cho_solve

WIDTHS, RIDGES = (0.5, 1.0, 2.0, 4.0), (0.1, 1.0, 10.0)  # multiples of the settings that are tried
JITTER = 1e-9


@dataclass(frozen=True)
class Ridge:
    """y(x) = mean + k(x, centres) coefficients. centres: (M, D); coefficients: (M, Y); mean: (Y,); width: the kernel's,
    in the unit of x."""

    centres: np.ndarray
    coefficients: np.ndarray
    mean: np.ndarray
    width: float

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """(F, D) -> (F, Y)."""
        return self.mean + correlation(x, self.centres, self.width) @ self.coefficients


def fit(
    x: np.ndarray,
    y: np.ndarray,
    clip: np.ndarray,
    *,
    width: float,
    ridge: float,
    tune: bool,
    landmarks: int,
    more: tuple[np.ndarray, np.ndarray] | None = None,
) -> Ridge:
    """Kernel ridge regression of y (F, Y) on x (F, D), with Matern's kernel of smoothness 3/2. clip: (F,) of a frame.

    width: of the kernel, in units of the median distance between frames; ridge: added to the kernel's diagonal.
    tune: try multiples of both, and a mean of zero beside the training mean, and keep what predicts left-out clips best
    in the least-squares sense (needs two clips).
    landmarks: at most so many frames become centres, evenly taken; the others still count (Nystroem), while tuning
    sees the centres only.
    more: a second x and y of the same frames, such as their mirror image; with ``tune`` left aside where
    clips that are left out together with their own image are predicted better without it.
    """
    chosen = landmarks_of(len(x), landmarks)
    apart = squared_distances(x[chosen], x[chosen])
    unit = float(np.median(apart[apart > 0])) if (apart > 0).any() else 1.0
    centred, several = True, len(np.unique(clip)) > 1
    if tune and several:
        width, ridge, centred = best_settings(apart / unit, y[chosen], clip[chosen], width, ridge)
    scale = np.sqrt(unit) * width
    if more is not None:
        both = tuple(np.concatenate(pair) for pair in zip((x, y), more, strict=True))
        if not (tune and several) or _gains(x, y, *both, clip, scale, ridge, centred, landmarks):
            x, y = both
            chosen = landmarks_of(len(x), landmarks)
    centres = x[chosen]
    mean = y.mean(0) if centred else np.zeros(y.shape[1])
    left, right = correlation(centres, centres, scale), y - mean
    if len(chosen) == len(x):
        left[np.diag_indices_from(left)] += ridge
    else:
        cross = correlation(centres, x, scale)
        left, right = cross @ cross.T + ridge * left, cross @ right
    left[np.diag_indices_from(left)] += JITTER * np.trace(left) / len(left)
    factor = cho_factor(left.T, overwrite_a=True)  # symmetric: transposed it is as LAPACK wants it
    return Ridge(centres, cho_solve(factor, right), mean, scale)


def correlation(a: np.ndarray, b: np.ndarray, scale: float) -> np.ndarray:
    """matern(squared_distances(a, b) / scale^2) in one pass over memory. (M, D), (N, D) -> (M, N)."""
    out = a @ b.T
    _correlate((a * a).sum(1), (b * b).sum(1), 3.0 / scale**2, out)
    return out


@njit(cache=True, nogil=True)
def _correlate(a, b, factor, products):
    for m in range(len(a)):
        for n in range(len(b)):
            r = np.sqrt(factor * max(a[m] + b[n] - 2.0 * products[m, n], 0.0))
            products[m, n] = (1.0 + r) * np.exp(-r)


def matern(squared: np.ndarray) -> np.ndarray:
    """Matern's kernel of smoothness 3/2 of squared distances in units of its width: (1 + sqrt 3 r) exp(-sqrt 3 r)."""
    r = np.sqrt(3.0 * squared)
    return (1.0 + r) * np.exp(-r)


def squared_distances(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(M, D), (N, D) -> (M, N)."""
    return np.maximum((a * a).sum(1)[:, None] + (b * b).sum(1) - 2.0 * a @ b.T, 0.0)


def inverted(gram: np.ndarray) -> np.ndarray:
    """The inverse of a positive definite matrix."""
    return cho_solve(cho_factor(gram), np.eye(len(gram)))


def left_out(inverse: np.ndarray, y: np.ndarray, clip: np.ndarray, *, centred: bool) -> np.ndarray:
    """Errors (F, Y) of the regression on every clip when trained without it, in closed form.

    inverse: Q = (K + ridge I)^-1; leaving a block c out leaves the error Q_cc^-1 (Q (y - m))_c, m the mean of the rest.
    """
    errors = np.empty_like(y)
    for c in np.unique(clip):
        mine = clip == c
        mean = y[~mine].mean(0) if centred else np.zeros(y.shape[1])
        errors[mine] = np.linalg.solve(inverse[np.ix_(mine, mine)], inverse[mine] @ (y - mean))
    return errors


def best_settings(
    apart: np.ndarray, y: np.ndarray, clip: np.ndarray, width: float, ridge: float
) -> tuple[float, float, bool]:
    """Width, ridge and whether y is centred: of multiples of those given, what predicts left-out clips best.

    apart: (F, F) squared distances in units of their median.
    """
    best = (np.inf, width, ridge, True)
    for w, r in product(WIDTHS, RIDGES):
        gram = matern(apart / (width * w) ** 2) + ridge * r * np.eye(len(apart))
        inverse = inverted(gram)
        for centred in (True, False):
            error = float((left_out(inverse, y, clip, centred=centred) ** 2).sum())
            best = min(best, (error, width * w, ridge * r, centred))
    return best[1:]


def landmarks_of(count: int, most: int) -> np.ndarray:
    """At most so many of ``count`` frames, evenly taken."""
    return np.unique(np.linspace(0, count - 1, min(most, count)).round().astype(int))


def _gains(x, y, x_both, y_both, clip, scale, ridge, centred, landmarks) -> bool:
    """Whether left-out clips are predicted better with the second half of x_both and y_both than with x and y alone."""
    some = landmarks_of(len(x), landmarks // 2)
    errors = []
    for a, b, rows in ((x, y, some), (x_both, y_both, np.concatenate([some, len(x) + some]))):
        gram = matern(squared_distances(a[rows], a[rows]) / scale**2) + ridge * np.eye(len(rows))
        wrong = left_out(inverted(gram), b[rows], clip[rows % len(x)], centred=centred)[: len(some)]
        errors.append(float((wrong**2).sum()))
    return errors[1] < errors[0]
