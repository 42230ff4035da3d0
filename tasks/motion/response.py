"""How a bone answers to being shaken: a linear filter on the motion of the place that it hangs on.

A soft part on a damped spring lags and swings by its place's acceleration, seen in the place's own axes, and sags by
gravity. To first order its residual is a convolution of those with the spring's own response, which is the same in
every clip: that is why it carries over to motions that no training frame resembles, where matching poses cannot.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from tasks.geometry.measure import diagonal
from tasks.motion.dynamics import root_dynamics
from tasks.motion.posed import Posed

RIDGES = (0.1, 1.0, 10.0, 100.0, 1000.0)
GRAVITY = 5.0  # body diagonals/s^2, for a body of two metres: what accelerations are measured in
SPIN = 10.0  # rad/s that weigh as much


def shaking(posed: Posed, bone: int, lags: list[int]) -> np.ndarray:
    """What a bone's place goes through, in its own axes: gravity, acceleration and angular velocity of where skinning
    carries the bone, now and ``lags`` frames ago (before a clip's first frame, as there), and a constant. (F, D)."""
    moving = root_dynamics(posed.predicted[:, bone], np.zeros(3), posed.poses.clip_start, posed.training.database.fps)
    size = diagonal(posed.training.canonical.points)
    now = np.concatenate([moving[:, 2] / (GRAVITY * size), moving[:, 3] / SPIN], axis=1)
    back = [np.maximum(np.arange(b - a)[:, None] - np.array(lags), 0) + a for a, b in pairwise(posed.poses.clip_start)]
    past = now[np.concatenate(back)].reshape(len(now), -1)
    return np.concatenate([moving[:, 0], past, np.ones((len(now), 1))], axis=1)


def fit(x: np.ndarray, y: np.ndarray, clip_start: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Ridge regression of y (F, Y) on x (F, D): coefficients (D, Y), and each clip as the others predict it (F, Y).
    The ridge is the one that predicts left-out clips best; where none beats zero, or where a lone clip leaves nothing
    to judge by (pieces of one clip are too alike to be left out in turn), both are zero."""
    clips = [slice(int(a), int(b)) for a, b in pairwise(clip_start)]
    grams, products = [x[c].T @ x[c] for c in clips], [x[c].T @ y[c] for c in clips]
    gram, product, eye = sum(grams), sum(products), np.eye(x.shape[1])
    best, ridge, left_out = float((y**2).sum()), None, np.zeros_like(y)
    for candidate in RIDGES if len(clips) > 1 else ():
        made = np.concatenate(
            [
                x[c] @ np.linalg.solve(gram - g + candidate * eye, product - p)
                for c, g, p in zip(clips, grams, products, strict=True)
            ]
        )
        error = float(((y - made) ** 2).sum())
        if error < best:
            best, ridge, left_out = error, candidate, made
    if ridge is None:
        return np.zeros((x.shape[1], y.shape[1])), left_out
    return np.linalg.solve(gram + ridge * eye, product), left_out
