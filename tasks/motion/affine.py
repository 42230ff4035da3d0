"""Shares that sum to one and give back what lies between the sources: a blend of matched frames by ordinary kriging.

A softmax of distances weighs every source by itself: ten frames of one moment count ten times, and the blend is pulled
to where sources are many. Here the shares are those by which the sources' *poses* best predict the query's, under
Matern's kernel (Cressie 1993, 3.2): sources that say the same divide their share among them, and one that lies opposite
may get a negative one. Every frame still is a sum of known training frames.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
from numba import njit
from scipy.linalg import eigh

from tasks.geometry.parallel import for_chunks
from tasks.geometry.rotations import from_quaternion
from tasks.motion.blending import Sources
from tasks.motion.kernel import matern
from tasks.motion.search import Keys

REACH = 16  # frames back that poses are compared by: now and 1, 2, 4, ... ago
WIDTH, RIDGE = 1.5, 0.03  # of the kernel, in medians of the distance; left-out training clips of both garments
SIZE = 64  # numbers that a pose with its past is told by: the most varying ones
SAMPLE = 500  # frames that these are found on; twice as many tell left-out clips no better
LAGS = np.array([0, *(2**i for i in range(REACH.bit_length()))])
CHUNK, DESCRIBED = 32, 512  # frames at once: matched, described
BLAS_ALONE = 2**18  # multiplications up to which OpenBLAS stays in its caller's thread


@dataclass(frozen=True)
class Space:
    """Where poses of one part with their past are compared. frames: (F, R) of the training frames ``index``, (F,), in
    units of the median distance between them; basis: (D, R) that brings descriptions there; weights: (J,) of the
    joints."""

    frames: np.ndarray
    index: np.ndarray
    basis: np.ndarray
    weights: np.ndarray

    @cached_property
    def columns(self) -> np.ndarray:
        """(R, F): frames innermost, for vector units."""
        return np.ascontiguousarray(self.frames.T)

    def without(self, frames: np.ndarray) -> Space:
        """The same, some training frames left out."""
        kept = ~np.isin(self.index, frames)
        return replace(self, frames=self.frames[kept], index=self.index[kept])


def space(keys: Keys, weights: np.ndarray, every: int = 1) -> Space:
    """The space of a part's training frames, of each clip's every so many-th. weights: (J,) how much each joint says.

    Neighbouring frames say nearly the same: of a given number of sources, fewer of each moment come from more moments.
    """
    now, back = _now(keys, weights), _back(keys)
    some = np.unique(np.linspace(0, len(now) - 1, min(SAMPLE, len(now))).round().astype(int))
    told = now[back[some]].reshape(len(some), -1)
    centred, size = told - told.mean(0), min(SIZE, *told.shape)
    basis = eigh(centred.T @ centred, subset_by_index=(told.shape[1] - size, told.shape[1] - 1))[1][:, ::-1]
    told = _product(told, basis)
    apart = np.empty((len(told), len(told)))
    _squared_distances(told, np.ascontiguousarray(told.T), apart)
    unit = float(np.sqrt(np.median(apart[apart > 0]))) if (apart > 0).any() else 1.0
    basis = np.ascontiguousarray(basis / unit)
    index = np.concatenate([np.arange(a, b, every) for a, b in pairwise(keys.clip_start)])
    return Space(_described(now, back[index], basis), index.astype(np.int32), basis, weights)


def describe(keys: Keys, known: Space) -> np.ndarray:
    """Frames in the space, (F, R) float64: rotation matrices of the joints and the vectors beside them, now and some
    frames ago; before a clip's first frame, as there."""
    return _described(_now(keys, known.weights), _back(keys), known.basis)


def _now(keys: Keys, weights: np.ndarray) -> np.ndarray:
    heavy = np.sqrt(weights / (2.0 * weights.sum() * len(LAGS)))[:, None, None]
    turns = (heavy * from_quaternion(keys.rotations.astype(np.float64))).reshape(len(keys.rotations), -1)
    return np.concatenate([turns, keys.extra.reshape(len(turns), -1) / np.sqrt(len(LAGS))], axis=1)


def _back(keys: Keys) -> np.ndarray:
    """(F, L) the frames that a description is made of."""
    return np.concatenate([np.maximum(np.arange(b - a)[:, None] - LAGS, 0) + a for a, b in pairwise(keys.clip_start)])


def _described(now: np.ndarray, back: np.ndarray, basis: np.ndarray) -> np.ndarray:
    out = np.empty((len(back), basis.shape[1]))

    def work(a: int, b: int) -> None:
        out[a:b] = _product(now[back[a:b]].reshape(b - a, -1), basis)

    for_chunks(work, len(out), DESCRIBED)
    return out


def _product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """a @ b in blocks so small that BLAS starts no threads, which ours, or another part's, would have to wait for."""
    rows = max(BLAS_ALONE // b.size, 1)
    whole = len(a) // rows * rows
    first = (a[:whole].reshape(whole // rows, rows, a.shape[1]) @ b).reshape(whole, b.shape[1])
    return np.concatenate([first, a[whole:] @ b])


def nearest_moments(asked: np.ndarray, known: Space, most: int) -> Sources:
    """The ``most`` training frames whose poses with their past lie nearest to each frame's, (T, R), and the shares by
    which theirs predict it; with the variance of that prediction."""
    most = min(most, len(known.frames))
    near, share = np.empty((len(asked), most), np.int32), np.empty((len(asked), most))
    variance = np.empty(len(asked))

    def work(a: int, b: int) -> None:
        far = np.empty((b - a, len(known.frames)))
        _squared_distances(asked[a:b], known.columns, far)
        near[a:b] = np.sort(np.argpartition(far, most - 1, axis=1)[:, :most], axis=1)
        to = matern(np.take_along_axis(far, near[a:b], 1) / WIDTH**2)
        _kriging(known.frames, near[a:b], to, share[a:b], variance[a:b])

    for_chunks(work, len(asked), CHUNK)
    return Sources(known.index[near], share, np.full(len(near), most), variance)


@njit(cache=True, nogil=True)
def _squared_distances(asked, columns, out):
    """(T, R), (R, F) -> (T, F). BLAS would be faster alone, but not where several threads call it."""
    dims = len(columns)
    for t in range(len(asked)):
        row = out[t]
        row[:] = 0.0
        for d in range(0, dims - dims % 4, 4):
            x0, x1, x2, x3 = columns[d], columns[d + 1], columns[d + 2], columns[d + 3]
            a, b, c, e = asked[t, d], asked[t, d + 1], asked[t, d + 2], asked[t, d + 3]
            for u in range(len(row)):
                row[u] += (a - x0[u]) ** 2 + (b - x1[u]) ** 2 + (c - x2[u]) ** 2 + (e - x3[u]) ** 2
        for d in range(dims - dims % 4, dims):
            for u in range(len(row)):
                row[u] += (asked[t, d] - columns[d, u]) ** 2


@njit(cache=True, nogil=True)
def _kriging(frames, near, to, share, variance):
    """Shares w that sum to one and minimise the variance of sum_m w_m y(frame m) - y(asked), row by row, and what it
    comes to where the kernel's own is one.

    With U^T U = K + ridge I, columns of U^-T [to, 1] stand beside U while it is made: one pass for all.
    """
    rows, most = near.shape
    dims = frames.shape[1]
    there = np.empty((dims, most))
    size = np.empty(most)
    system = np.empty((most, most + 2))
    for t in range(rows):
        for m in range(most):
            total = 0.0
            for d in range(dims):
                value = frames[near[t, m], d]
                there[d, m] = value
                total += value * value
            size[m] = total
        _gram(there, system)
        for i in range(most):
            for j in range(i, most):
                r = np.sqrt(3.0 * max(size[i] + size[j] - 2.0 * system[i, j], 0.0)) / WIDTH
                system[i, j] = (1.0 + r) * np.exp(-r)
            system[i, i] += RIDGE
            system[i, most], system[i, most + 1] = to[t, i], 1.0
        _eliminate(system)
        for i in range(most - 1, -1, -1):
            a, b = system[i, most], system[i, most + 1]
            for j in range(i + 1, most):
                a -= system[i, j] * system[j, most]
                b -= system[i, j] * system[j, most + 1]
            system[i, most], system[i, most + 1] = a / system[i, i], b / system[i, i]
        told, ones = system[:, most].sum(), system[:, most + 1].sum()
        level = (1.0 - told) / ones
        variance[t] = 1.0 + level
        for i in range(most):
            share[t, i] = system[i, most] + level * system[i, most + 1]
            variance[t] -= share[t, i] * to[t, i]


@njit(cache=True, nogil=True)
def _gram(x, out):
    """Upper triangle of x^T x, x (D, M); four rows at once, so that the inner loop computes more than it loads."""
    dims, most = x.shape
    out[:, :most] = 0.0
    for d in range(0, dims - dims % 4, 4):
        x0, x1, x2, x3 = x[d], x[d + 1], x[d + 2], x[d + 3]
        for i in range(most):
            a, b, c, e, row = x0[i], x1[i], x2[i], x3[i], out[i]
            for j in range(i, most):
                row[j] += a * x0[j] + b * x1[j] + c * x2[j] + e * x3[j]
    for d in range(dims - dims % 4, dims):
        for i in range(most):
            for j in range(i, most):
                out[i, j] += x[d, i] * x[d, j]


@njit(cache=True, nogil=True)
def _eliminate(a):
    """Cholesky's U of the upper triangle of a's square part, in place, and U^-T of the columns beside it; four rows at
    once."""
    rows, columns = a.shape
    for first in range(0, rows, 4):
        last = min(first + 4, rows)
        for k in range(first, last):
            for p in range(first, k):
                s = a[p, k]
                for j in range(k, columns):
                    a[k, j] -= s * a[p, j]
            scale = 1.0 / np.sqrt(a[k, k])
            for j in range(k, columns):
                a[k, j] *= scale
        if last == rows:
            break
        u0, u1, u2, u3 = a[first], a[first + 1], a[first + 2], a[first + 3]
        for i in range(last, rows):
            b, c, d, e, row = u0[i], u1[i], u2[i], u3[i], a[i]
            for j in range(i, columns):
                row[j] -= b * u0[j] + c * u1[j] + d * u2[j] + e * u3[j]
