"""Smooth skinning decomposition with rigid bones (Le & Deng 2012): the paper's free-form bones.

Skin weights (:mod:`tasks.bones.weights`), rest shape (:mod:`tasks.bones.rest`) and rigid bone transforms
(:mod:`tasks.bones.transforms`) take turns, with Nesterov extrapolation of the transforms between rounds. Two things
keep it out of poor local optima at little cost: it starts with more bones than wanted and removes those that are missed
least, and it works on a sample of the points until the bones stand, for their transforms need far fewer points than a
dense mesh has.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from scipy.spatial import cKDTree

from tasks.bones import transforms, weights
from tasks.bones.clustering import numbered, split
from tasks.bones.graph import Graph, moving_together
from tasks.bones.losses import losses
from tasks.bones.rest import refine
from tasks.bones.skinned import skinned_rmse
from tasks.bones.trajectories import Trajectories, compress
from tasks.values import Canonical, Clusters, Motion, Skinning

_SPAN = 1000  # points from which the basis of all paths is taken, and the fewest that a fit is made on
_SWEEPS = 2  # Gauss-Seidel sweeps a round: more bring nothing
_SETTLE = 6  # sweeps at the end, on frozen weights
_LLOYD = 4  # reassignments after each split of the start
_STILL = 1e-5  # error relative to the shape's radius at which nothing is left to split: float32 resolves no less
_WARM_UP = 4  # rounds with surplus bones
_REMOVED = 0.18  # part of the bones removed at a time
_BETWEEN = 2  # rounds after each removal
_SHARED = 0.1  # overlap above which two bones are not removed together: each may be what replaces the other
_FIRST_EXCHANGES = 3  # exchanges a point makes in the first round of a run


def ssdr(
    train: Motion,
    canonical: Canonical,
    clusters: Clusters,
    *,
    influences: Annotated[int, "[1, inf)"],
    surplus: Annotated[int, "[0, inf)"],
    iterations: Annotated[int, "[0, inf)"],
    polish: Annotated[int, "[1, inf)"],
    points_per_bone: Annotated[int, "[6, inf)"],
    smoothness: Annotated[float, "[0, inf)"],
    locality: Annotated[float, "[0, inf)"],
    firmness: Annotated[float, "[0, inf)"],
    compression: Annotated[float, "(0, inf)"],
    prune: Annotated[float, "[0, 1)", "prune * influences < 1: below 1 / influences"],
    seed: int,
) -> Skinning:
    """Weights W (N, B), rest points v (N, 3) and rigid transforms T (F, B, 3, 4) that minimise
    sum |sum_b w_nb T_fb v_n - x_fn|^2.

    influences: most bones a point may have; surplus: bones at the start beyond those wanted; iterations: rounds
    once the surplus is gone; polish: rounds on all points after those; points_per_bone: points that take part before;
    smoothness: weight of the squared difference to the neighbours' mean weights, against squared errors relative to
    the shape's radius; locality: pull to near bones, sum_b w_nb |v_n - centre_b|^2 (in radii) per degree of evidence,
    i.e. times the clusters' squared error over F: few frames need it, many hardly feel it; firmness: frames that the
    canonical points count for as the rest shape; compression: error allowed to the compressed paths, as a fraction of
    the clusters' own error; prune: weights below are removed in the last rounds. B is the number of clusters. Points
    that move like nothing around them get weights but do not move bones.
    Cost: linear in N and in F.
    history: vertex RMSE after every round, of the sample first, the last exactly that of the result.
    Source: Le & Deng, SIGGRAPH Asia 2012, eq. 2-8,
    solved as described in the modules named above.
    """
    rng = np.random.default_rng(seed)
    sound = clusters.sound
    good = np.nonzero(sound)[0]
    wanted = int(clusters.labels.max()) + 1
    size = min(len(good), max(_SPAN, points_per_bone * wanted))
    chosen = np.sort(rng.choice(good, size, replace=False))
    coarse = _clusters_error(train, canonical, clusters, chosen)
    paths = compress(train.points, canonical.points, tolerance=compression * coarse, sample=_thinned(chosen))
    near_first = locality * (coarse / paths.alignment.scale) ** 2 / train.frames
    part = paths.take(chosen)
    bones = _start(part, clusters.labels[chosen], wanted + surplus, influences)
    usual = {"locality": near_first, "firmness": firmness}
    history = _alternate(bones, _WARM_UP if len(bones.offsets) > wanted else 0, **usual)
    while len(bones.offsets) > wanted:
        _remove(bones, wanted)
        history += _alternate(bones, _BETWEEN, **usual)
    history += _alternate(bones, iterations, **usual)
    history += _finish(train, canonical, paths, bones, polish, sound, smoothness, prune, usual)
    rest = paths.alignment.canonical(bones.paths.rest).astype(np.float32)
    moved = paths.alignment.to_world(bones.offsets).astype(np.float32)
    reached = skinned_rmse(rest, bones.index, bones.value.astype(np.float32), moved, train.points)
    return Skinning(rest, _dense(bones), moved, np.append(history, reached))


@dataclass
class _Bones:
    """The state of the decomposition. paths: from the rest shape as it is now; home: (N, 4) canonical points;
    index: (N, S) int32, -1 for none; value: (N, S); offsets: (B, 4, 3, F)."""

    paths: Trajectories
    home: np.ndarray
    index: np.ndarray
    value: np.ndarray
    offsets: np.ndarray


def _thinned(chosen: np.ndarray) -> np.ndarray:
    return chosen[:: math.ceil(len(chosen) / _SPAN)]


def _clusters_error(train: Motion, canonical: Canonical, clusters: Clusters, chosen: np.ndarray) -> float:
    """Vertex RMSE of the rigid clusters on some of the points: the scale against which other errors are small."""
    chosen = _thinned(chosen)
    labels = clusters.labels[chosen][:, None]
    whole = np.ones(labels.shape, np.float32)
    return skinned_rmse(canonical.points[chosen], labels, whole, clusters.transforms, train.points[:, chosen])


def _start(part: Trajectories, labels: np.ndarray, count: int, influences: int) -> _Bones:
    """Rigid clusters, split further to the given count; every point follows its own."""
    labels = split(part, numbered(labels), count, _LLOYD, _STILL * part.alignment.scale)
    index = np.full((len(labels), influences), -1, np.int32)
    value = np.zeros(index.shape)
    index[:, 0], value[:, 0] = labels, 1.0
    k, y = transforms.sums(part, index, value, int(labels.max()) + 1)
    each = np.arange(len(k))
    return _Bones(part, part.rest, index, value, transforms.rigid_fit(k[each, each], y)[0])


def _alternate(
    bones: _Bones,
    rounds: int,
    *,
    graph: Graph | None = None,
    sound: np.ndarray | None = None,
    smoothness: float = 0.0,
    locality: float,
    firmness: float,
    prune: float = 0.0,
) -> list[float]:
    """Rounds of weights, transforms and rest points, in place. Returns the vertex RMSE after each.

    The extrapolation grows while the error falls and starts anew when it rises; the rest shape follows the transforms
    that were found, not the extrapolated ones, which it would run after. Points look for other bones in every second
    round only.
    """
    history, before, step = [], bones.offsets, 0.0
    for i in range(rounds):
        paths = bones.paths
        guess = transforms.extrapolate(bones.offsets, before, step) if step > 0 else bones.offsets.copy()
        forms = weights.forms(paths, guess)
        exchanges = _FIRST_EXCHANGES if i == 0 else (i + 1) % 2
        weights.exchange(
            paths,
            forms,
            bones.index,
            bones.value,
            rounds=exchanges,
            smoothness=smoothness,
            graph=graph,
            locality=locality,
            centres=_centres(bones),
        )
        _prune(bones, prune)
        k, y = transforms.sums(paths, _counted(bones.index, sound), bones.value, len(guess))
        error = paths.rmse(paths.squared + transforms.sweep(k, y, guess, _SWEEPS))
        before, bones.offsets = bones.offsets, guess
        step = 0.0 if history and error > history[-1] else min(0.95, max(0.4, step + 0.1))
        history.append(error)
        bones.paths = refine(paths, guess, bones.index, bones.value, bones.home, firmness)
    return history


def _finish(
    train: Motion,
    canonical: Canonical,
    paths: Trajectories,
    bones: _Bones,
    rounds: int,
    sound: np.ndarray,
    smoothness: float,
    prune: float,
    usual: dict[str, float],
) -> list[float]:
    """From the sample to all points: each starts with the weights of the sample's nearest point."""
    near = cKDTree(bones.home[:, :3]).query(paths.rest[:, :3])[1]
    bones.index, bones.value = bones.index[near], bones.value[near]
    bones.paths, bones.home = paths, paths.rest
    graph = moving_together(train.points, canonical.points, canonical.faces) if smoothness > 0 else None
    history = _alternate(bones, rounds, graph=graph, sound=sound, smoothness=smoothness, prune=prune, **usual)
    k, y = transforms.sums(bones.paths, _counted(bones.index, sound), bones.value, len(bones.offsets))
    transforms.sweep(k, y, bones.offsets, _SETTLE)
    return history


def _centres(bones: _Bones) -> np.ndarray:
    """(B, 3) mean position of each bone's points, by weight, in aligned coordinates."""
    count = len(bones.offsets)
    owner, share = np.where(bones.index >= 0, bones.index, count).ravel(), bones.value.ravel()
    total = np.bincount(owner, share, minlength=count + 1)[:count]
    place = np.repeat(bones.paths.rest[:, :3], bones.index.shape[1], axis=0)
    each = [np.bincount(owner, share * place[:, d], minlength=count + 1)[:count] for d in range(3)]
    return np.stack(each, axis=1) / np.maximum(total, 1e-300)[:, None]


def _counted(index: np.ndarray, sound: np.ndarray | None) -> np.ndarray:
    """The weights that bones are fitted to: points that are not sound take part in none."""
    return index if sound is None or sound.all() else np.where(sound[:, None], index, -1).astype(np.int32)


def _remove(bones: _Bones, wanted: int) -> None:
    """Removes some of the bones that are missed least, in place; never two that share many points."""
    part, count = bones.paths, len(bones.offsets)
    room = min(count - wanted, max(1, int(_REMOVED * count)))
    loss = losses(part, weights.forms(part, bones.offsets), bones.index, bones.value)
    k, _ = transforms.sums(part, bones.index, bones.value, count)
    size = np.sqrt(np.einsum("bb->b", k[:, :, 3, 3])) + 1e-300
    overlap = k[:, :, 3, 3] / (size[:, None] * size)
    gone: list[int] = []
    for b in np.argsort(loss, kind="stable"):
        if len(gone) < room and all(overlap[b, c] < _SHARED for c in gone):
            gone.append(int(b))
    kept = np.setdiff1d(np.arange(count), gone)
    number = np.full(count + 1, -1, np.int32)
    number[kept] = np.arange(len(kept))
    bones.offsets = np.ascontiguousarray(bones.offsets[kept])
    bones.index = number[bones.index]
    bones.value[bones.index < 0] = 0.0
    lost = bones.value.sum(1) < 1e-6
    if lost.any():
        nearest = weights.nearest_bone(part, bones.offsets)[0]
        bones.index[lost], bones.value[lost] = -1, 0.0
        bones.index[lost, 0], bones.value[lost, 0] = nearest[lost], 1.0
    bones.value /= bones.value.sum(1, keepdims=True)


def _prune(bones: _Bones, least: float) -> None:
    """Drops weights below `least`, in place; the rest sum to one again."""
    small = (bones.value < least) & (bones.value < bones.value.max(1, keepdims=True))
    bones.value[small] = 0.0
    bones.index[bones.value <= 0.0] = -1
    bones.value /= bones.value.sum(1, keepdims=True)


def _dense(bones: _Bones) -> np.ndarray:
    """Weights as (N, B) float32."""
    out = np.zeros((len(bones.index), len(bones.offsets)), np.float32)
    rows, places = np.nonzero(bones.index >= 0)
    out[rows, bones.index[rows, places]] = bones.value[rows, places]
    return out
