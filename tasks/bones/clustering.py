"""Rigid motion clusters by splitting and reassignment (LBG-VQ; Le & Deng 2014, section 4).

Points whose paths one rigid motion explains belong together. Clusters are split at badly explained points far from
the cluster's middle until the ceiling is reached, then merged back one pair at a time: that gives the error against
the count of clusters in one go, from which the count is chosen.
"""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from scipy.spatial import cKDTree

from tasks.bones import transforms, weights
from tasks.bones.refit import rigid_transforms
from tasks.bones.stray import trusted
from tasks.bones.trajectories import Trajectories, compress
from tasks.geometry.measure import diagonal
from tasks.values import Canonical, Clusters, Motion

_SAMPLE = 2000  # points clustered; all points are then assigned to the clusters found
_FRAMES = 48  # frames that they are clustered by, spread over all; more find no better clusters
_COMPRESSION = 2e-3  # error allowed to the compressed paths, relative to the shape's extent: clusters are far coarser
_SEED_POINTS = 12  # points a new cluster starts from
_LEAST = 3  # points below which a cluster has no rigid motion of its own
_POLISH = 8  # reassignments once the count is chosen
_PATIENCE = 4  # rounds of splitting without a new cluster, because small ones keep falling empty
_CONSIDERABLE = 0.01  # part of the mean cluster's error below which a cluster is not split


def cluster(
    train: Motion,
    canonical: Canonical,
    *,
    max_bones: Annotated[int, "[1, inf)"],
    count: Literal["auto", "fixed"],
    slack: Annotated[float, "[0, inf)"],
    exact: Annotated[float, "[0, inf)"],
    rounds: Annotated[int, "[1, inf)"],
    seed: int,
) -> Clusters:
    """Rigid motion clusters of points.

    max_bones: ceiling; count: "fixed" takes as many as the points allow, "auto" the smallest count whose error is
    below `exact` (fraction of the canonical diagonal) or within `slack` (relative) of the error at the ceiling;
    rounds: reassignments after every split.
    """
    rng = np.random.default_rng(seed)
    sound = trusted(train.points, canonical.points, canonical.faces)
    good = np.nonzero(sound)[0]
    sample = np.sort(rng.choice(good, min(len(good), _SAMPLE), replace=False))
    extent = diagonal(canonical.points[sample])
    frames = np.unique(np.linspace(0, train.frames - 1, min(train.frames, _FRAMES)).round().astype(int))
    some = train.points if len(frames) == train.frames else train.points[frames]
    paths = compress(some, canonical.points, tolerance=_COMPRESSION * extent, sample=sample)
    part = paths.take(sample)
    floor = exact * extent
    labels = split(part, np.zeros(len(sample), np.int32), min(max_bones, len(sample) // _LEAST), rounds, floor)
    counts, errors, states = _merge_down(part, labels)
    if count == "auto":
        chosen = choose_count(counts, errors, len(sample), slack, floor)
        labels = _reassign(part, states[chosen], _POLISH)
    found = _all_points(paths, part, labels, sound)
    moved = rigid_transforms(train.points, canonical.points, found, sound)
    return Clusters(found, moved, sound, counts, errors)


def choose_count(counts: np.ndarray, errors: np.ndarray, points: int, slack: float, floor: float) -> int:
    """Position of the smallest count that explains the motion as well as the largest one, but for `slack`.

    Every cluster has six numbers to fit a frame of three for each point, so many clusters fit noise: errors are
    compared per degree of freedom left. An error below `floor` is good enough by itself.
    """
    free = np.maximum(1.0 - 2.0 * counts / points, 0.05)
    fair = errors / np.sqrt(free)
    good = (fair <= (1.0 + slack) * fair[-1]) | (errors <= floor)
    return int(np.argmax(good))


def _fit(part: Trajectories, labels: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Sums K (B, 4, 4) and Y (B, 4, 3, F) of each cluster and its best rigid offsets (B, 4, 3, F)."""
    k, y = transforms.sums(part, labels[:, None], np.ones((len(labels), 1)), int(labels.max()) + 1)
    k = k[np.arange(len(k)), np.arange(len(k))]
    return k, y, transforms.rigid_fit(k, y)[0]


def split(part: Trajectories, labels: np.ndarray, ceiling: int, rounds: int, floor: float) -> np.ndarray:
    """Labels of at most `ceiling` clusters from fewer: all clusters with a considerable error are split at once.

    labels: (N,) int32 in 0..B-1 to start from; rounds: reassignments after every split; floor: vertex RMSE at which
    there is nothing left to split.
    """
    place = part.rest[:, :3]
    near = cKDTree(place).query(place, k=min(_SEED_POINTS, len(labels)))[1].reshape(len(labels), -1)
    most, stalled = 0, 0
    while stalled < _PATIENCE:
        found, error = weights.nearest_bone(part, _fit(part, labels)[2])
        count = int(labels.max()) + 1
        if count >= ceiling or part.alignment.scale * np.sqrt(error.mean()) <= floor:
            break
        most, stalled = max(most, count), stalled + 1 if count <= most else 0
        labels = numbered(found)
        seeds = _seeds(part, labels, error, near, ceiling - int(labels.max()) - 1)
        for new, seed in enumerate(seeds, start=int(labels.max()) + 1):
            members = near[seed]
            labels[members[labels[members] == labels[seed]]] = new
        labels = _reassign(part, numbered(labels), rounds)
    return labels


def _seeds(part: Trajectories, labels: np.ndarray, error: np.ndarray, near: np.ndarray, room: int) -> list[int]:
    """The points at which clusters are split, worst cluster first: those of greatest (e - e_min)(d - d_min).

    e is the median error around the point, so that a stray point does not get a cluster of its own.
    """
    calm = np.median(error[near], axis=1)
    total = np.bincount(labels, error)
    order = [c for c in np.argsort(-total, kind="stable") if total[c] > _CONSIDERABLE * total.mean()]
    seeds = []
    for c in order[:room]:
        members = np.nonzero(labels == c)[0]
        place = part.rest[members, :3]
        distance = np.linalg.norm(place - place.mean(0), axis=1)
        worth = (calm[members] - calm[members].min()) * (distance - distance.min())
        seeds.append(int(members[np.argmax(worth)]))
    return seeds


def _reassign(part: Trajectories, labels: np.ndarray, rounds: int) -> np.ndarray:
    """Rounds of fitting rigid motions and giving each point to the one that explains it best."""
    for _ in range(rounds):
        offsets = _fit(part, labels)[2]
        found = weights.nearest_bone(part, offsets)[0]
        small = np.bincount(found, minlength=int(labels.max()) + 1) < _LEAST
        if small[found].any() and not small.all():
            kept = np.nonzero(~small)[0]
            found = weights.nearest_bone(part, offsets[kept])[0]
        labels = numbered(found)
    return labels


def numbered(labels: np.ndarray) -> np.ndarray:
    """The same clusters numbered without gaps, (N,) int32."""
    used = np.bincount(labels) > 0
    return (np.cumsum(used) - 1).astype(np.int32)[labels]


def _merge_down(part: Trajectories, labels: np.ndarray) -> tuple[np.ndarray, np.ndarray, list[np.ndarray]]:
    """Merges the two clusters that cost least, again and again.

    Returns counts rising from one, the vertex RMSE at each and the labels at each. Sums of clusters just add, so a
    merger needs no look at the points.
    """
    k, y, _ = _fit(part, labels)
    gain = transforms.rigid_fit(k, y)[1]
    alive = np.ones(len(k), bool)
    cost = np.full((len(k), len(k)), np.inf)
    for b in range(len(k) - 1):
        _pair_costs(k, y, gain, b, np.arange(b + 1, len(k)), cost)
    energy, current = part.squared, labels.copy()
    states, errors = [current.copy()], [part.rmse(energy + gain.sum())]
    for _ in range(len(k) - 1):
        a, b = np.unravel_index(np.argmin(cost), cost.shape)
        k[a] += k[b]
        y[a] += y[b]
        gain[a] += gain[b] + cost[a, b]
        alive[b] = False
        cost[b], cost[:, b] = np.inf, np.inf
        others = np.nonzero(alive)[0]
        _pair_costs(k, y, gain, int(a), others[others != a], cost)
        current[current == b] = a
        states.append(current.copy())
        errors.append(part.rmse(energy + gain[alive].sum()))
    counts = np.arange(1, len(states) + 1)
    return counts, np.array(errors[::-1]), [numbered(s) for s in states[::-1]]


def _pair_costs(k: np.ndarray, y: np.ndarray, gain: np.ndarray, a: int, others: np.ndarray, cost: np.ndarray) -> None:
    """cost[i, j], i < j: what merging adds to the squared error; filled for the pairs of a with others."""
    if len(others) == 0:
        return
    together = transforms.rigid_fit(k[a] + k[others], y[a] + y[others])[1]
    cost[np.minimum(a, others), np.maximum(a, others)] = together - gain[a] - gain[others]


def _all_points(paths: Trajectories, part: Trajectories, labels: np.ndarray, sound: np.ndarray) -> np.ndarray:
    """Labels of all points, (N,) int32, by the clusters of the sample; each holds a point that is to be trusted."""
    offsets = _fit(part, labels)[2]
    found = weights.nearest_bone(paths, offsets)[0]
    kept = np.unique(found[sound])
    if len(kept) < len(offsets):
        found = weights.nearest_bone(paths, offsets[kept])[0]
    return found
