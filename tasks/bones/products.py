"""Matrix products whose bits do not depend on the number of threads.

A BLAS may split a sum differently for another number of threads. These kernels add in one fixed order; they are used
wherever a result feeds an iteration that would carry such a difference to the outside.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from tasks.geometry.parallel import for_chunks

_ROWS = 32  # rows of a product that a thread takes at a time, or more of small ones:
_WORTH = 1 << 20  # multiplications below which a thread is not worth its start


def product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """a @ b in float64. a: (M, K), b: (K, L) -> (M, L)."""
    a, b = np.ascontiguousarray(a, np.float64), np.ascontiguousarray(b, np.float64)
    out = np.zeros((a.shape[0], b.shape[1]))
    rows = max(_ROWS, _WORTH // max(b.size, 1))
    for_chunks(lambda start, stop: add_product(a, b, out, start, stop), len(a), rows)
    return out


@njit(cache=True, nogil=True)
def add_product(a, b, out, start, stop):
    """out[start:stop] += a[start:stop] @ b, four terms at a time so that a row of out is touched less often."""
    terms, columns = b.shape
    whole = terms - terms % 4
    for i in range(start, stop):
        for k in range(0, whole, 4):
            a0, a1, a2, a3 = a[i, k], a[i, k + 1], a[i, k + 2], a[i, k + 3]
            for j in range(columns):
                out[i, j] += a0 * b[k, j] + a1 * b[k + 1, j] + a2 * b[k + 2, j] + a3 * b[k + 3, j]
        for k in range(whole, terms):
            for j in range(columns):
                out[i, j] += a[i, k] * b[k, j]


@njit(cache=True, nogil=True)
def orthonormalise(columns, basis, count):
    """Gram-Schmidt, twice, in place. columns: (L, K) rows of vectors to be made orthonormal to each other and to
    basis[:count]; a vector that holds nothing new becomes zero."""
    for i in range(len(columns)):
        length = np.sqrt(np.sum(columns[i] ** 2))
        for _ in range(2):
            for j in range(count + i):
                other = basis[j] if j < count else columns[j - count]
                dot = 0.0
                for k in range(columns.shape[1]):
                    dot += columns[i, k] * other[k]
                for k in range(columns.shape[1]):
                    columns[i, k] -= dot * other[k]
        left = np.sqrt(np.sum(columns[i] ** 2))
        if left > 1e-10 * length and left > 0.0:
            columns[i] /= left
        else:
            columns[i] = 0.0
