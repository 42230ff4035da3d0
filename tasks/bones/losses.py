"""What each bone is worth: how much worse its points would be explained without it."""

from __future__ import annotations

import numpy as np
from numba import njit

from tasks.bones.trajectories import Trajectories
from tasks.bones.weights import POINTS, TILE, Forms, best_bone, bring_in, correlate, products_of, quadratic_form
from tasks.geometry.parallel import for_chunks
from tasks.geometry.simplex import solve
from tasks.geometry.simplex import value as value_of


def losses(paths: Trajectories, bones: Forms, index: np.ndarray, value: np.ndarray) -> np.ndarray:
    """How much the squared error would rise without each bone, if every point could take one other in its place.

    index, value: see :func:`tasks.bones.weights.exchange` -> (B,) sum over points of means over frames.
    """
    loss = np.empty(index.shape)

    def work(start: int, stop: int) -> None:
        length, frames = paths.lengths, paths.frames
        _losses(
            paths.rest,
            paths.path,
            length,
            frames,
            bones.linear,
            bones.square,
            bones.own,
            index,
            value,
            loss,
            start,
            stop,
        )

    for_chunks(work, len(index), POINTS)
    return np.bincount(np.maximum(index, 0).ravel(), loss.ravel(), minlength=len(bones.square))


@njit(cache=True, nogil=True)
def _losses(rest, path, length, frames, linear, square, own, index, value, loss, start, stop):
    count, slots = len(square), index.shape[1]
    raw, correlation = np.empty((TILE, 4 * count)), np.empty((TILE, count))
    hh = np.empty(10)
    reach = np.empty(count)
    bones, w = np.empty(slots + 1, np.int64), np.empty(slots + 1)
    q = np.empty((slots + 1, slots + 1))
    for low in range(start, stop, TILE):
        high = min(low + TILE, stop)
        correlate(rest, path, linear, low, high, raw, correlation)
        for n in range(low, high):
            c, e = correlation[n - low], length[n] / frames
            products_of(rest[n], hh)
            whole = -1.0
            for out in range(-1, slots):
                loss_of_all = out < 0
                if not loss_of_all and index[n, out] < 0:
                    loss[n, out] = 0.0
                    continue
                size, total = 0, 0.0
                for s in range(slots):
                    if index[n, s] >= 0 and s != out:
                        bones[size], w[size] = index[n, s], value[n, s]
                        total += w[size]
                        size += 1
                banned = -1 if loss_of_all else index[n, out]
                if size == 0 or total <= 0.0:
                    bones[0] = _best_alone(own, hh, c, e, banned)
                    w[0], size, total = 1.0, 1, 1.0
                for s in range(size):
                    w[s] /= total
                quadratic_form(square, hh, c, e, 0.0, bones, size, q)
                size = solve(q, bones, w, size)
                now = value_of(q, w, size)
                if loss_of_all:
                    whole = now
                    continue
                found = best_bone(square, own, hh, c, e, 0.0, bones, w, size, now, reach, banned)
                if found >= 0:
                    size, now = bring_in(square, hh, c, e, 0.0, bones, w, size, slots, now, q, found)
                loss[n, out] = max(now - whole, 0.0)


@njit(cache=True, nogil=True)
def _best_alone(own, hh, c, e, banned):
    best, least = 0, np.inf
    for b in range(own.shape[1]):
        if b == banned:
            continue
        total = e - 2.0 * c[b]
        for k in range(10):
            total += hh[k] * own[k, b]
        if total < least:
            best, least = b, total
    return best
