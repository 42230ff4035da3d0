"""Skin weights of given bones, point by point (Le & Deng 2012, section 4.1), by exchange of bones.

With sum w = 1 the error of a point is a quadratic form of its weights alone,

    |sum_b w_b D_b h - u|^2 = w^T Q w,   Q_bc = h^T D_b^T D_c h - c_b - c_c + |u|^2,   c_b = <D_b h, u>,

whose parts D_b^T D_c are sums over frames taken once for all points. Of the bones outside the support the one that
lowers w^T Q w most along the line towards it comes in; of five the least useful goes out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from tasks.bones.graph import Graph, alone
from tasks.bones.products import product
from tasks.bones.trajectories import Trajectories
from tasks.geometry.parallel import for_chunks
from tasks.geometry.simplex import solve
from tasks.geometry.simplex import value as value_of

POINTS = 256  # points a thread takes at a time
TILE = 8  # points whose correlations with all bones are computed together
_PAIRS = [(i, j) for i in range(4) for j in range(i, 4)]  # the upper triangle, row by row
_GAIN = 1e-4  # relative gain below which an exchange is not worth its solve


@dataclass(frozen=True)
class Forms:
    """What the bones contribute to Q, for all points.

    rows: (B, 4, P), <D_b h, u> = sum_ip h_i rows[b, i, p] path_p, a mean over frames like all that follows; linear:
    (P, 4 B), the same laid out for all bones at once, column i B + b; square: (B, 10, B), h^T D_b^T D_c h =
    sum_k square[b, k, c] (h h^T)_k, upper triangle row by row; own: (10, B), square[b, :, b] with the bones innermost.
    """

    rows: np.ndarray
    linear: np.ndarray
    square: np.ndarray
    own: np.ndarray


def forms(paths: Trajectories, offsets: np.ndarray) -> Forms:
    """offsets: (B, 4, 3, F)."""
    count = len(offsets)
    flat = offsets.reshape(count * 4, -1)
    gram = product(flat, flat.T).reshape(count, 4, count, 4) / paths.frames
    square = np.empty((count, 10, count))
    for k, (i, j) in enumerate(_PAIRS):
        square[:, k] = gram[:, i, :, j] if i == j else gram[:, i, :, j] + gram[:, j, :, i]
    rows = _rows(paths, offsets)
    own = np.ascontiguousarray(np.einsum("bkb->kb", square))
    return Forms(rows, _side_by_side(rows), square, own)


def _rows(paths: Trajectories, offsets: np.ndarray) -> np.ndarray:
    flat = offsets.reshape(len(offsets) * 4, -1)
    return product(flat, paths.basis).reshape(len(offsets), 4, -1) / paths.frames


def _side_by_side(rows: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(rows.transpose(2, 1, 0)).reshape(rows.shape[2], -1)


def nearest_bone(paths: Trajectories, offsets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The one bone that explains each point best: (N,) int32, and its squared error, (N,) mean over frames.

    offsets: (B, 4, 3, F).
    """
    label, error = np.empty(len(paths.rest), np.int32), np.empty(len(paths.rest))
    linear, own = _side_by_side(_rows(paths, offsets)), np.empty((10, len(offsets)))
    for k, (i, j) in enumerate(_PAIRS):
        own[k] = (1 if i == j else 2) * np.sum(offsets[:, i] * offsets[:, j], axis=(1, 2)) / paths.frames

    def work(start: int, stop: int) -> None:
        _nearest_bone(paths.rest, paths.path, paths.lengths, paths.frames, linear, own, label, error, start, stop)

    for_chunks(work, len(label), POINTS)
    return label, error


def exchange(
    paths: Trajectories,
    bones: Forms,
    index: np.ndarray,
    value: np.ndarray,
    *,
    rounds: int,
    smoothness: float,
    graph: Graph | None,
    locality: float,
    centres: np.ndarray,
) -> np.ndarray:
    """Improves sparse weights in place; returns each point's squared error, (N,) mean over frames.

    index: (N, S) int32, -1 for an empty place; value: (N, S) float64; rounds: exchanges tried, 0 keeps the support;
    smoothness: weight of |w - mean of the neighbours' w|^2; graph: see :mod:`tasks.bones.graph`;
    locality: weight of sum_b w_b |h - centre_b|^2, centres: (B, 3): far bones are for what near ones cannot explain.
    """
    error = np.empty(len(index))
    last = (index.copy(), value.copy())  # neighbours' weights are those of the round before, for any order of points
    graph = alone(len(index)) if graph is None else graph

    def work(start: int, stop: int) -> None:
        _exchange(
            paths.rest,
            paths.path,
            paths.lengths,
            paths.frames,
            bones.rows,
            bones.linear,
            bones.square,
            bones.own,
            index,
            value,
            error,
            rounds,
            smoothness,
            graph,
            last,
            locality,
            centres,
            start,
            stop,
        )

    for_chunks(work, len(index), POINTS)
    return error


@njit(cache=True, nogil=True)
def correlate(rest, path, linear, low, high, raw, correlation):
    """correlation[n - low, b] = <D_b h_n, u_n>, mean over frames, for the points low..high and all bones."""
    columns = linear.shape[1]
    count = columns // 4
    width = path.shape[1]
    whole = width - width % 4
    for n in range(low, high):
        row = raw[n - low]
        row[:] = 0.0
        for p in range(0, whole, 4):
            a0, a1 = np.float64(path[n, p]), np.float64(path[n, p + 1])
            a2, a3 = np.float64(path[n, p + 2]), np.float64(path[n, p + 3])
            for j in range(columns):
                row[j] += a0 * linear[p, j] + a1 * linear[p + 1, j] + a2 * linear[p + 2, j] + a3 * linear[p + 3, j]
        for p in range(whole, width):
            a0 = np.float64(path[n, p])
            for j in range(columns):
                row[j] += a0 * linear[p, j]
        h0, h1, h2 = rest[n, 0], rest[n, 1], rest[n, 2]
        for b in range(count):
            correlation[n - low, b] = h0 * row[b] + h1 * row[count + b] + h2 * row[2 * count + b] + row[3 * count + b]


@njit(cache=True, nogil=True)
def _correlate_few(h, path, rows, bones, correlation):
    """correlation[b] = <D_b h, u> of one point for the given bones; zero for all others."""
    correlation[:] = 0.0
    for b in bones:
        if b < 0:
            continue
        r0, r1, r2, r3 = rows[b, 0], rows[b, 1], rows[b, 2], rows[b, 3]
        total = 0.0
        for p in range(len(path)):
            total += path[p] * (h[0] * r0[p] + h[1] * r1[p] + h[2] * r2[p] + h[3] * r3[p])
        correlation[b] = total


@njit(cache=True, nogil=True)
def products_of(h, out):
    """The ten different entries of h h^T."""
    k = 0
    for i in range(4):
        for j in range(i, 4):
            out[k] = h[i] * h[j]
            k += 1


@njit(cache=True, nogil=True)
def _nearest_bone(rest, path, length, frames, linear, own, label, error, start, stop):
    count = own.shape[1]
    raw, correlation, hh = np.empty((TILE, 4 * count)), np.empty((TILE, count)), np.empty(10)
    for low in range(start, stop, TILE):
        high = min(low + TILE, stop)
        correlate(rest, path, linear, low, high, raw, correlation)
        for n in range(low, high):
            products_of(rest[n], hh)
            best, least = 0, np.inf
            for b in range(count):
                total = length[n] / frames - 2.0 * correlation[n - low, b]
                for k in range(10):
                    total += hh[k] * own[k, b]
                if total < least:
                    best, least = b, total
            label[n], error[n] = best, max(least, 0.0)


@njit(cache=True, nogil=True)
def _exchange(
    rest,
    path,
    length,
    frames,
    rows,
    linear,
    square,
    own,
    index,
    value,
    error,
    rounds,
    smoothness,
    graph,
    last,
    locality,
    centres,
    start,
    stop,
):
    count, slots = len(square), index.shape[1]
    raw, correlation = np.empty((TILE, 4 * count)), np.empty((TILE, count))
    hh = np.empty(10)
    reach = np.empty(count)
    bones, w = np.empty(slots + 1, np.int64), np.empty(slots + 1)
    q = np.empty((slots + 1, slots + 1))
    for low in range(start, stop, TILE):
        high = min(low + TILE, stop)
        if rounds > 0:
            correlate(rest, path, linear, low, high, raw, correlation)
        for n in range(low, high):
            c, e = correlation[n - low], length[n] / frames
            if rounds == 0:
                _correlate_few(rest[n], path[n], rows, index[n], c)
            products_of(rest[n], hh)
            if smoothness > 0.0:
                _pull(n, graph, last, smoothness, c)
            if locality > 0.0:
                for b in range(count):
                    x, y, z = rest[n, 0] - centres[b, 0], rest[n, 1] - centres[b, 1], rest[n, 2] - centres[b, 2]
                    c[b] -= 0.5 * locality * (x * x + y * y + z * z)
            size = 0
            for s in range(slots):
                if index[n, s] >= 0:
                    bones[size], w[size] = index[n, s], value[n, s]
                    size += 1
            quadratic_form(square, hh, c, e, smoothness, bones, size, q)
            size = solve(q, bones, w, size)
            now = value_of(q, w, size)
            for _ in range(rounds):
                found = best_bone(square, own, hh, c, e, smoothness, bones, w, size, now, reach, -1)
                if found < 0:
                    break
                before = now
                size, now = bring_in(square, hh, c, e, smoothness, bones, w, size, slots, now, q, found)
                if now >= before:
                    break
            error[n] = max(now, 0.0)
            for s in range(slots):
                index[n, s], value[n, s] = (bones[s], w[s]) if s < size else (-1, 0.0)


@njit(cache=True, nogil=True)
def _pull(n, graph, last, smoothness, c):
    """|w - m|^2 = |w|^2 - 2 <w, m> + ...: since sum w = 1 the mean m of the neighbours just adds to c."""
    indptr, indices, shares = graph
    old_index, old_value = last
    for a in range(indptr[n], indptr[n + 1]):
        other = indices[a]
        for s in range(old_index.shape[1]):
            if old_index[other, s] >= 0:
                c[old_index[other, s]] += smoothness * shares[a] * old_value[other, s]


@njit(cache=True, nogil=True)
def quadratic_form(square, hh, c, e, smoothness, bones, size, q):
    """q[:size, :size] = Q among the given bones."""
    for s in range(size):
        for r in range(s, size):
            total = e - c[bones[s]] - c[bones[r]]
            for k in range(10):
                total += hh[k] * square[bones[s], k, bones[r]]
            q[s, r] = q[r, s] = total + (smoothness if s == r else 0.0)


@njit(cache=True, nogil=True)
def best_bone(square, own, hh, c, e, smoothness, bones, w, size, now, reach, banned):
    """The bone outside the support, and not banned, towards which w^T Q w falls most along a line, or -1."""
    count = len(square)
    shift = e
    for b in range(count):
        reach[b] = 0.0
    for s in range(size):
        shift -= w[s] * c[bones[s]]
        for k in range(0, 10, 2):
            f0, f1 = w[s] * hh[k], w[s] * hh[k + 1]
            row0, row1 = square[bones[s], k], square[bones[s], k + 1]
            for b in range(count):
                reach[b] += f0 * row0[b] + f1 * row1[b]
    best, most = -1, _GAIN * now
    for b in range(count):
        along = reach[b] + shift - c[b]  # <r, d_b>
        if along >= now or b == banned:
            continue
        alone = e - 2.0 * c[b] + smoothness
        for k in range(10):
            alone += hh[k] * own[k, b]
        gap = now - along
        gain = gap * gap / max(now - 2.0 * along + alone, gap)  # the step stops at w_b = 1
        if gain > most:
            inside = False
            for s in range(size):
                inside = inside or bones[s] == b
            if not inside:
                best, most = b, gain
    return best


@njit(cache=True, nogil=True)
def bring_in(square, hh, c, e, smoothness, bones, w, size, slots, now, q, found):
    """Adds a bone, solves, and if the support is too large drops the bone that costs least.

    The support and weights are left as they were where that brings nothing. Returns size and value.
    """
    old_bones, old_w = bones.copy(), w.copy()
    bones[size], w[size] = found, 0.0
    quadratic_form(square, hh, c, e, smoothness, bones, size + 1, q)
    new_size = solve(q, bones, w, size + 1)
    if new_size <= slots:
        value = value_of(q, w, new_size)
        if value < now:
            return new_size, value
        bones[:], w[:] = old_bones, old_w
        return size, now
    full_q, full_bones, full_w = q.copy(), bones.copy(), w.copy()
    best_size, best, best_bones, best_w = size, now, old_bones, old_w
    for out in range(new_size):
        rest = 1.0 - full_w[out]
        if rest <= 0.0:
            continue
        left = 0
        for s in range(new_size):
            if s == out:
                continue
            bones[left], w[left] = full_bones[s], full_w[s] / rest
            column = 0
            for r in range(new_size):
                if r != out:
                    q[left, column] = full_q[s, r]
                    column += 1
            left += 1
        left = solve(q, bones, w, left)
        value = value_of(q, w, left)
        if value < best:
            best_size, best, best_bones, best_w = left, value, bones.copy(), w.copy()
    bones[:], w[:] = best_bones, best_w
    return best_size, best
