"""Smooth skinning decomposition with rigid bones (Le & Deng 2012): the paper's free-form bones.

From motion clusters, alternate between skin weights (:mod:`tasks.bones.weights`) and rigid bone transforms
(:mod:`tasks.bones.transforms`) with Nesterov extrapolation of the transforms between rounds.
"""

from __future__ import annotations

import numpy as np

from tasks.bones import transforms, weights
from tasks.bones.graph import moving_together
from tasks.bones.trajectories import Trajectories, compress
from tasks.errors import InputError
from tasks.geometry.measure import vertex_rmse
from tasks.geometry.skinning import skin
from tasks.values import Canonical, Clusters, Motion, Skinning

_SAMPLE = 1000  # points from which the basis of all paths is taken
_SWEEPS = 2  # Gauss-Seidel sweeps a round: more bring nothing
_SETTLE = 6  # sweeps after pruning, on frozen weights
_FULL_SEARCH = 2  # first rounds with several exchanges a point


def ssdr(
    train: Motion,
    canonical: Canonical,
    clusters: Clusters,
    *,
    influences: int,
    iterations: int,
    smoothness: float,
    compression: float,
    prune: float,
    seed: int,
) -> Skinning:
    """Weights W (N, B) and rigid transforms T (F, B, 3, 4) that minimise sum |sum_b w_nb T_fb v_n - x_fn|^2.

    influences: most bones a point may have; iterations: rounds; smoothness: weight of the squared difference to the
    neighbours' mean weights, against squared errors relative to the shape's radius; compression: error allowed to the
    compressed paths, as a fraction of the clusters' own error; prune: weights below are removed at the end.
    Raises InputError for settings out of range. Source: Le & Deng, SIGGRAPH Asia 2012, eq. 2-8, solved as described in
    the modules named above.
    """
    _check(influences, iterations, prune)
    paths, offsets = _start(train, canonical, clusters, compression, seed)
    graph = moving_together(train.points, canonical.points, canonical.faces)
    index = np.full((len(canonical.points), influences), -1, np.int32)
    index[:, 0] = clusters.labels
    value = np.zeros(index.shape)
    value[:, 0] = 1.0
    history = _alternate(paths, graph, index, value, offsets, iterations, smoothness)
    _settle(paths, graph, index, value, offsets, prune, smoothness)
    dense = _dense(index, value, len(offsets))
    moved = paths.alignment.to_world(offsets).astype(np.float32)
    reached = vertex_rmse(skin(canonical.points, dense, moved), train.points)
    return Skinning(canonical.points.astype(np.float32), dense, moved, np.append(history, reached))


def _check(influences: int, iterations: int, prune: float) -> None:
    if influences < 1:
        raise InputError("bones.influences", expected="at least 1", found=str(influences))
    if iterations < 1:
        raise InputError("bones.iterations", expected="at least 1", found=str(iterations))
    if not 0.0 <= prune * influences < 1.0:
        raise InputError("bones.prune", expected="at least 0 and below 1 / influences", found=str(prune))


def _start(
    train: Motion, canonical: Canonical, clusters: Clusters, compression: float, seed: int
) -> tuple[Trajectories, np.ndarray]:
    """Compressed paths and the clusters' transforms as offsets."""
    rng = np.random.default_rng(seed)
    count = len(canonical.points)
    sample = np.sort(rng.choice(count, min(count, _SAMPLE), replace=False))
    chosen, labels = canonical.points[sample].astype(np.float64), clusters.labels[sample]
    total = 0.0
    for t, x in zip(clusters.transforms, train.points, strict=True):
        moved = np.einsum("nij,nj->ni", t[labels][..., :3].astype(np.float64), chosen) + t[labels][..., 3]
        total += float(np.sum((moved - x[sample]) ** 2))
    tolerance = compression * np.sqrt(total / (len(sample) * train.frames))
    paths = compress(train.points, canonical.points, tolerance=tolerance, sample=sample)
    return paths, paths.alignment.from_world(clusters.transforms)


def _alternate(
    paths: Trajectories,
    graph: tuple[np.ndarray, np.ndarray, np.ndarray],
    index: np.ndarray,
    value: np.ndarray,
    offsets: np.ndarray,
    iterations: int,
    smoothness: float,
) -> list[float]:
    """Rounds of weights and transforms, in place. Returns the vertex RMSE after each round.

    The extrapolation grows while the error falls and starts anew when it rises.
    """
    whole = float(np.sum(paths.path.astype(np.float64) ** 2))
    history, before, step = [], offsets.copy(), 0.0
    for i in range(iterations):
        guess = transforms.extrapolate(offsets, before, step) if step > 0 else offsets.copy()
        rounds = 3 if i < _FULL_SEARCH else (i + 1) % 2
        bones = weights.forms(paths, guess)
        weights.exchange(paths, bones, index, value, rounds=rounds, smoothness=smoothness, graph=graph)
        k, y = transforms.sums(paths, index, value, len(offsets))
        error = paths.rmse(whole + transforms.sweep(k, y, guess, _SWEEPS))
        before[:] = offsets
        offsets[:] = guess
        rising = bool(history) and error > history[-1]
        step = 0.0 if rising else min(0.95, max(0.4, step + 0.1))
        history.append(error)
    return history


def _settle(
    paths: Trajectories,
    graph: tuple[np.ndarray, np.ndarray, np.ndarray],
    index: np.ndarray,
    value: np.ndarray,
    offsets: np.ndarray,
    prune: float,
    smoothness: float,
) -> None:
    """Removes small weights and fits what is left, transforms last, so that both agree."""
    for _ in range(2):
        _prune(index, value, prune)
        k, y = transforms.sums(paths, index, value, len(offsets))
        transforms.sweep(k, y, offsets, _SWEEPS)
        bones = weights.forms(paths, offsets)
        weights.exchange(paths, bones, index, value, rounds=0, smoothness=smoothness, graph=graph)
    _prune(index, value, prune)
    k, y = transforms.sums(paths, index, value, len(offsets))
    transforms.sweep(k, y, offsets, _SETTLE)


def _prune(index: np.ndarray, value: np.ndarray, least: float) -> None:
    """Drops weights below `least`, in place; the rest sum to one again."""
    small = (value < least) & (value < value.max(1, keepdims=True))
    value[small] = 0.0
    index[value <= 0.0] = -1
    value /= value.sum(1, keepdims=True)


def _dense(index: np.ndarray, value: np.ndarray, count: int) -> np.ndarray:
    """(N, S) sparse weights -> (N, B) float32."""
    out = np.zeros((len(index), count), np.float32)
    rows, places = np.nonzero(index >= 0)
    out[rows, index[rows, places]] = value[rows, places]
    return out
