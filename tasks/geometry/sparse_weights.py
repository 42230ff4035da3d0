"""Skin weights of given transforms: per point, the sparse convex combination that follows the motion best."""

from __future__ import annotations

import numpy as np
from numba import njit

from tasks.geometry.moments import homogeneous
from tasks.geometry.parallel import for_chunks
from tasks.geometry.simplex import solve, value

CHUNK = 512


def fit_weights(
    rest: np.ndarray,
    points: np.ndarray,
    transforms: np.ndarray,
    *,
    influences: int,
    exchanges: int,
    start: np.ndarray | None = None,
) -> np.ndarray:
    """min sum_f |sum_b w_b T_fb h_n - x_fn|^2 with w >= 0, sum w = 1 and at most ``influences`` non-zeros
    (Le & Deng 2012, eq. 3-6, solved by exchange over all transforms rather than over a list of candidates).

    rest: (N, 3); points: (F, N, 3); transforms: (F, B, 3, 4); start: (N, B) weights whose support is improved
    (points without any begin from twice the influences, of which the least useful go) -> (N, B) float32. Sums over
    frames are taken first, so the solve of a point does not grow with F.
    """
    frames, bones = transforms.shape[:2]
    t = transforms.astype(np.float64).transpose(0, 2, 1, 3).reshape(3 * frames, 4 * bones)
    gram = (t.T @ t).reshape(bones, 4, bones, 4).transpose(1, 3, 0, 2).reshape(16, bones * bones)
    h = homogeneous(rest)

    def part(a: int, b: int) -> np.ndarray:
        x = points[:, a:b].astype(np.float64).transpose(1, 0, 2).reshape(b - a, 3 * frames)
        hh = (h[a:b, :, None] * h[a:b, None]).reshape(b - a, 16)
        quadratic = (hh @ gram).reshape(b - a, bones, bones)
        linear = ((x @ t).reshape(b - a, bones, 4) * h[a:b, None]).sum(2)
        # with sum w = 1 the error is w^T q w; q is the Gram matrix of the single-bone residuals
        q = quadratic - linear[:, :, None] - linear[:, None, :] + (x * x).sum(1)[:, None, None]
        first = np.zeros((b - a, bones)) if start is None else start[a:b].astype(np.float64)
        return _solve_points(q, first, influences, exchanges)

    none = np.zeros((0, bones))
    return np.concatenate([none, *for_chunks(part, len(rest), CHUNK)]).astype(np.float32)


@njit(cache=True, nogil=True)
def _solve_points(q: np.ndarray, start: np.ndarray, influences: int, exchanges: int) -> np.ndarray:
    out = np.zeros(q.shape[:2])
    for n in range(len(q)):
        _solve_point(q[n], start[n], influences, exchanges, out[n])
    return out


@njit(cache=True, nogil=True)
def _solve_point(q: np.ndarray, start: np.ndarray, influences: int, exchanges: int, w: np.ndarray) -> None:
    """From the start's support, or from a wide one narrowed down, try exchanges: the bone of steepest descent comes
    in, above the limit the least useful goes out."""
    room = 2 * influences + 1
    support, values = np.empty(room, np.int64), np.zeros(room)
    size = 0
    while size < influences:
        best = -1
        for b in range(len(q)):
            if start[b] > 0.0 and (best < 0 or start[b] > start[best]) and not _holds(support, size, b):
                best = b
        if best < 0:
            break
        support[size] = best
        size += 1
    if size == 0:
        best = 0
        for b in range(len(q)):
            if q[b, b] < q[best, best]:
                best = b
        support[0], values[0], size = best, 1.0, 1
        size, error = _grow(q, support, values, size, 2 * influences)
        while size > influences:
            size, error = _drop_one(q, support, values, size)
    else:
        size, error = _descend(q, support, values, size)
    refused = np.zeros(len(q), np.bool_)
    for _ in range(exchanges):
        add = _steepest(q, support, values, size, error, refused)
        if add < 0:
            break
        new_support, new_values = support.copy(), values.copy()
        new_support[size], new_values[size] = add, 0.0
        new_size, new_error = _descend(q, new_support, new_values, size + 1)
        if new_size > influences:
            new_size, new_error = _drop_one(q, new_support, new_values, new_size)
        if new_error < error * (1.0 - 1e-6):
            support, values, size, error = new_support, new_values, new_size, new_error
        else:
            refused[add] = True
    for i in range(size):
        w[support[i]] = values[i]


@njit(cache=True, nogil=True)
def _holds(support: np.ndarray, size: int, b: int) -> bool:
    # a generator would not compile
    for i in range(size):  # noqa: SIM110
        if support[i] == b:
            return True
    return False


@njit(cache=True, nogil=True)
def _steepest(q, support, values, size, error, refused) -> int:
    """The bone outside the support that lowers w^T q w most along the line from w to it, or -1 where none does."""
    add, most = -1, 1e-6 * error
    for b in range(len(q)):
        if refused[b] or _holds(support, size, b):
            continue
        g = 0.0
        for i in range(size):
            g += q[b, support[i]] * values[i]
        if g < error:
            gain = (error - g) ** 2 / max(error - 2.0 * g + q[b, b], 1e-300)
            if gain > most:
                add, most = b, gain
    return add


@njit(cache=True, nogil=True)
def _grow(q: np.ndarray, support: np.ndarray, values: np.ndarray, size: int, limit: int) -> tuple[int, float]:
    """Adds the bone of steepest descent until ``limit`` are in or none helps."""
    error = q[support[0], support[0]]
    refused = np.zeros(len(q), np.bool_)
    for _ in range(2 * limit):
        add = _steepest(q, support, values, size, error, refused) if size < limit else -1
        if add < 0:
            break
        refused[add] = True  # a bone that fell out again does not come back
        support[size], values[size] = add, 0.0
        size, error = _descend(q, support, values, size + 1)
    return size, error


@njit(cache=True, nogil=True)
def _drop_one(q: np.ndarray, support: np.ndarray, values: np.ndarray, size: int) -> tuple[int, float]:
    """Tries to leave out each member in turn and keeps the set of least error."""
    best_error, best_size = np.inf, 0
    best_support, best_values = support.copy(), values.copy()
    for leave in range(size):
        s, v = support.copy(), values.copy()
        for i in range(leave, size - 1):
            s[i], v[i] = s[i + 1], v[i + 1]
        k, e = _descend(q, s, v, size - 1)
        if e < best_error:
            best_error, best_size = e, k
            best_support[:] = s
            best_values[:] = v
    support[:] = best_support
    values[:] = best_values
    return best_size, best_error


@njit(cache=True, nogil=True)
def _descend(q: np.ndarray, support: np.ndarray, values: np.ndarray, size: int) -> tuple[int, float]:
    """Minimum of w^T q w over the simplex on ``support``, from the values; from their mean where they are nought."""
    few, total = np.empty((size, size)), 0.0
    for i in range(size):
        total += values[i]
        for j in range(size):
            few[i, j] = q[support[i], support[j]]
    for i in range(size):
        values[i] = values[i] / total if total > 0.0 else 1.0 / size
    size = solve(few, support, values, size)
    return size, value(few, values, size)
