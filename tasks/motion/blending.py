"""From nearest windows to bones: which training frames each frame is blended of, their alignment and their mean."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from tasks.geometry.parallel import for_chunks
from tasks.motion.projection import mean_turn
from tasks.motion.search import Matches

FRAME_CHUNK = 64
NEGLIGIBLE = 1e-4  # sources of a smaller share are dropped: a tenth of a millimetre in a metre


@dataclass(frozen=True)
class Sources:
    """The training frames that each query frame is blended of. frame: (T, M) int32; share: (T, M) float64, rows sum to
    one; count: (T,) how many of the M are in use; variance: (T,) of what they predict where that is known, 1 is to know
    nothing."""

    frame: np.ndarray
    share: np.ndarray
    count: np.ndarray
    variance: np.ndarray | None = None


@dataclass(frozen=True)
class PartMotion:
    """One part in its own frame. joints: (F, J, 4) float64 quaternions of its joints, anchor: (F, 3) the point that it
    is aligned about."""

    joints: np.ndarray
    anchor: np.ndarray


def level_shares(levels: int, lambda_: float) -> np.ndarray:
    """Final share of each pyramid level, coarsest first, of T_l = (1 - lambda) T_(l-1) + lambda T_match (eq. 10)."""
    share = np.full(levels, lambda_)
    share[0] = 1.0
    return share * (1.0 - lambda_) ** np.arange(levels - 1, -1, -1)


def window_weights(distance: np.ndarray, temperature: float) -> np.ndarray:
    """Softmax of minus the distances in units of ``temperature`` times the best one, (..., k) -> (..., k) float64.

    Measuring in units of the best distance makes the choice free of scale, and lets an exact match take all.
    """
    distance = distance.astype(np.float64)
    best = np.where(np.isfinite(distance[..., :1]), distance[..., :1], 0.0)  # a row of inf is no window at all
    weight = np.exp(-(distance - best) / (temperature * best + 1e-6))
    return weight / np.maximum(weight.sum(-1, keepdims=True), 1e-300)


def gather(matches: Matches, strides: list[int], *, patch: int, lambda_: float, temperature: float) -> Sources:
    """Averages overlapping windows and pyramid levels (coarsest first) into one row of sources a frame."""
    frames = int(matches.count[0]) + (patch - 1) * strides[0]
    k = matches.start.shape[2]
    weight = window_weights(matches.distance, temperature) * level_shares(len(strides), lambda_)[:, None, None]
    width = len(strides) * patch * k
    source = np.zeros((frames, width), np.int32)
    share = np.zeros((frames, width))
    count = np.zeros(frames, np.int64)
    _gather(
        matches.start,
        weight,
        matches.count,
        np.array(strides),
        patch,
        int(matches.start.max()) + 1,
        source,
        share,
        count,
    )
    return Sources(source, share, count)


@njit(cache=True, nogil=True)
def _gather(start, weight, count, strides, patch, reach, source, share, used):
    slot = np.full(reach + patch * strides.max(), -1)  # where a training frame stands in the row, for merging
    for f in range(len(source)):
        for level in range(len(strides)):
            stride = strides[level]
            covering = 0
            for i in range(patch):
                covering += 0 <= f - i * stride < count[level]
            for i in range(patch):
                t = f - i * stride
                if t < 0 or t >= count[level]:
                    continue
                for m in range(start.shape[2]):
                    part = weight[level, t, m] / covering
                    if part <= 0.0:
                        continue
                    g = start[level, t, m] + i * stride
                    if slot[g] < 0:
                        slot[g] = used[f]
                        source[f, used[f]] = g
                        used[f] += 1
                    share[f, slot[g]] += part
        kept, total = 0, 0.0
        for m in range(used[f]):
            slot[source[f, m]] = -1
            if share[f, m] >= NEGLIGIBLE:
                source[f, kept], share[f, kept] = source[f, m], share[f, m]
                total += share[f, m]
                kept += 1
        used[f] = kept
        share[f, :kept] /= total


def strongest(sources: Sources, k: int) -> np.ndarray:
    """The k training frames of the largest share, (T, k) int32, repeated where there are fewer."""
    live = np.arange(sources.share.shape[1]) < sources.count[:, None]
    order = np.argsort(np.where(live, -sources.share, 1.0), axis=1, kind="stable")[:, :k]
    order = np.take_along_axis(order, np.minimum(np.arange(k), sources.count[:, None] - 1), 1)
    return np.take_along_axis(sources.frame, order, 1)


def blend(
    sources: Sources,
    values: np.ndarray,
    which: np.ndarray,
    query: PartMotion | None = None,
    training: PartMotion | None = None,
) -> np.ndarray:
    """Weighted mean of the sources' bones, where motions are given each aligned to the query first.

    values: (F, B, 3, 4) training bones as frames; which: (M,) of the B -> (T, M, 3, 4) float64; the linear part is a
    mean of rotations, to be projected to SO(3) once the parts are merged.
    query, training: turn each source by the rotation that brings its joints closest to the query's, project(sum_j
    R_query,j R_source,j^T) (eq. 9), about the part's anchor, and carry it to the query's anchor.
    """
    out = np.zeros((len(sources.frame), len(which), 3, 4))
    align = query is not None and training is not None
    if not align:
        query = training = PartMotion(np.zeros((len(out), 0, 4)), np.zeros((len(out), 3)))

    def work(a: int, b: int) -> None:
        _blend(
            sources.frame[a:b],
            sources.share[a:b],
            sources.count[a:b],
            values,
            which,
            query.joints[a:b],
            training.joints,
            query.anchor[a:b],
            training.anchor,
            align,
            out[a:b],
        )

    for_chunks(work, len(out), FRAME_CHUNK)
    return out


@njit(cache=True, nogil=True)
def _blend(frame, share, count, values, which, joints, keys, anchor, key_anchor, align, out):
    turn, shift = np.eye(3), np.zeros(3)
    for t in range(len(frame)):
        for m in range(count[t]):
            g, w = frame[t, m], share[t, m]
            if align:
                mean_turn(joints[t], keys[g], turn)
                for r in range(3):
                    shift[r] = anchor[t, r]
                    for c in range(3):
                        shift[r] -= turn[r, c] * key_anchor[g, c]
            for b in range(len(which)):
                value = values[g, which[b]]
                for r in range(3):
                    x, y, z = w * turn[r, 0], w * turn[r, 1], w * turn[r, 2]
                    for c in range(4):
                        out[t, b, r, c] += x * value[0, c] + y * value[1, c] + z * value[2, c]
                    out[t, b, r, 3] += w * shift[r]
