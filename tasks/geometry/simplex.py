"""Least squares over the simplex: min w^T Q w with w >= 0, sum w = 1, for the few bones of one point."""

from __future__ import annotations

import numpy as np
from numba import njit

_RIDGE = 1e-9  # relative to the mean diagonal: keeps the solve of two bones that move alike from dividing by zero


@njit(cache=True, nogil=True)
def value(q, w, size):
    total = 0.0
    for s in range(size):
        for r in range(size):
            total += w[s] * w[r] * q[s, r]
    return total


@njit(cache=True, nogil=True)
def solve(q, bones, w, size):
    """Minimises w^T Q w over the simplex from a feasible w, dropping bones whose weight reaches zero.

    q, bones and w are packed to the bones that stay. Returns their number.
    """
    goal, matrix = np.empty(size), np.empty((size, size))
    while size > 1:
        top = 0
        for s in range(1, size):
            if w[s] > w[top]:
                top = s
        _swap(q, bones, w, 0, top, size)
        _interior(q, goal, matrix, size)
        step, stop = 1.0, -1
        for s in range(size):
            if goal[s] <= 0.0 and w[s] <= step * (w[s] - goal[s]):
                step, stop = w[s] / (w[s] - goal[s]) if w[s] > goal[s] else 0.0, s
        for s in range(size):
            w[s] += step * (goal[s] - w[s])
        if stop < 0:
            break
        _swap(q, bones, w, stop, size - 1, size)
        size -= 1
    total = 0.0
    for s in range(size):
        w[s] = max(w[s], 0.0)
        total += w[s]
    for s in range(size):
        w[s] /= total
    return size


@njit(cache=True, nogil=True)
def _interior(q, goal, matrix, size):
    """goal[:size] minimises w^T Q w with sum w = 1 only: Cholesky on differences from bone 0, the heaviest."""
    n = size - 1
    trace = 0.0
    for s in range(n):
        for r in range(n):
            matrix[s, r] = q[s + 1, r + 1] - q[s + 1, 0] - q[0, r + 1] + q[0, 0]
        goal[s + 1] = q[0, 0] - q[s + 1, 0]
        trace += abs(matrix[s, s])  # of bones that move alike rounding may leave less than nothing
    ridge = _RIDGE * trace / n + 1e-300
    for s in range(n):
        matrix[s, s] += ridge
    for s in range(n):
        for r in range(s + 1):
            total = matrix[s, r]
            for k in range(r):
                total -= matrix[s, k] * matrix[r, k]
            matrix[s, r] = np.sqrt(max(total, ridge)) if s == r else total / matrix[r, r]
    for s in range(n):
        for k in range(s):
            goal[s + 1] -= matrix[s, k] * goal[k + 1]
        goal[s + 1] /= matrix[s, s]
    for s in range(n - 1, -1, -1):
        for k in range(s + 1, n):
            goal[s + 1] -= matrix[k, s] * goal[k + 1]
        goal[s + 1] /= matrix[s, s]
    goal[0] = 1.0
    for s in range(n):
        goal[0] -= goal[s + 1]


@njit(cache=True, nogil=True)
def _swap(q, bones, w, a, b, size):
    if a == b:
        return
    bones[a], bones[b] = bones[b], bones[a]
    w[a], w[b] = w[b], w[a]
    for s in range(size):
        q[a, s], q[b, s] = q[b, s], q[a, s]
    for s in range(size):
        q[s, a], q[s, b] = q[s, b], q[s, a]
