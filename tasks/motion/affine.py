"""Shares that sum to one and give back what lies between the sources: a blend of matched frames by ordinary kriging.

A softmax of distances weighs every source by itself: ten frames of one moment count ten times, and the blend is pulled
to where sources are many. Here the shares are those by which the sources' *poses* best predict the query's, under
Matern's kernel (Cressie 1993, 3.2): sources that say the same divide their share among them, and one that lies opposite
may get a negative one. Every frame still is a sum of known training frames.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from tasks.geometry.parallel import for_chunks
from tasks.geometry.rotations import from_quaternion
from tasks.motion.blending import Sources
from tasks.motion.kernel import matern, squared_distances
from tasks.motion.search import Keys

REACH = 16  # frames back that poses are compared by: now and 1, 2, 4, ... ago
WIDTH, RIDGE = 1.5, 0.03  # of the kernel, in medians of the distance; left-out training clips of both garments
SIZE = 64  # numbers that a pose with its past is told by: the most varying ones
SAMPLE = 1000  # frames that these are found on
CHUNK = 32  # frames at once


@dataclass(frozen=True)
class Space:
    """Where poses of one part with their past are compared. frames: (F, R) the training frames; basis: (D, R); weights:
    (J,) of the joints; unit: the median distance."""

    frames: np.ndarray
    basis: np.ndarray
    weights: np.ndarray
    unit: float


def space(keys: Keys, weights: np.ndarray) -> Space:
    """The space of a part's training frames. weights: (J,) how much each joint says."""
    told = describe(keys, weights)
    some = told[np.unique(np.linspace(0, len(told) - 1, min(SAMPLE, len(told))).round().astype(int))]
    basis = np.linalg.svd(some - some.mean(0), full_matrices=False)[2][:SIZE].T
    apart = squared_distances(some @ basis, some @ basis)
    unit = float(np.sqrt(np.median(apart[apart > 0]))) if (apart > 0).any() else 1.0
    return Space(told @ basis, basis, weights, unit)


def describe(keys: Keys, weights: np.ndarray) -> np.ndarray:
    """(F, D) float64: rotation matrices of the joints and the vectors beside them, now and some frames ago; before a
    clip's first frame, as there."""
    heavy = np.sqrt(weights / (2.0 * weights.sum()))[:, None, None]
    turns = (heavy * from_quaternion(keys.rotations.astype(np.float64))).reshape(len(keys.rotations), -1)
    now = np.concatenate([turns, keys.extra.reshape(len(turns), -1)], axis=1)
    lags = np.array([0, *(2**i for i in range(REACH.bit_length()))])
    back = [np.maximum(np.arange(b - a)[:, None] - lags, 0) + a for a, b in pairwise(keys.clip_start)]
    return now[np.concatenate(back)].reshape(len(now), -1) / np.sqrt(len(lags))


def nearest_moments(asked: np.ndarray, known: Space, most: int) -> Sources:
    """The ``most`` training frames whose poses with their past lie nearest to each frame's, (T, R), and the shares by
    which theirs predict it."""
    most = min(most, len(known.frames))
    near, share = np.empty((len(asked), most), np.int32), np.empty((len(asked), most))

    def work(a: int, b: int) -> None:
        here = asked[a:b] / known.unit
        far = squared_distances(here, known.frames / known.unit)
        near[a:b] = np.sort(np.argpartition(far, most - 1, axis=1)[:, :most], axis=1)
        there = known.frames[near[a:b]] / known.unit
        size = (there**2).sum(2)
        apart = size[:, :, None] + size[:, None, :] - 2.0 * there @ there.transpose(0, 2, 1)
        gram = matern(np.maximum(apart, 0.0) / WIDTH**2) + RIDGE * np.eye(most)
        to = matern(np.take_along_axis(far, near[a:b], 1) / WIDTH**2)
        solved = np.linalg.solve(gram, np.stack([to, np.ones_like(to)], axis=2))
        rest = (1.0 - solved[:, :, 0].sum(1)) / solved[:, :, 1].sum(1)
        share[a:b] = solved[:, :, 0] + rest[:, None] * solved[:, :, 1]

    for_chunks(work, len(asked), CHUNK)
    return Sources(near, share, np.full(len(near), most))
