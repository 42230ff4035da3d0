"""What single training clips are worth: the numbers of a method that was trained without them, one at a time."""

from __future__ import annotations

import math

import numpy as np

from tasks.evaluation.metrics import declared, squared_errors
from tasks.values import Animation, Metrics, Motion


def evaluate_left_out(animation: Animation, truth: Motion, test: Motion) -> Metrics:
    """The error on the unseen clips and on the training clip that was left out, which comes after them.

    animation, truth: (F, N, 3) points on the frames of ``test`` and of the clip -> ``rmse``, ``rmse_left_out``.
    """
    squared = squared_errors(animation.points, truth.points)
    unseen, held = squared[: test.frames], squared[test.frames :]
    return declared({"rmse": math.sqrt(unseen.mean()), "rmse_left_out": math.sqrt(held.mean())}, test.unit)


def spread(scores: dict) -> Metrics:
    """Results of :func:`evaluate_left_out` for several clips, together: the standard deviation of the error on the
    unseen clips; the mean error on the clips left out, each clip as heavy as another, and its standard deviation."""
    first = next(iter(scores.values()))
    values = np.array([score.values for score in scores.values()])
    unseen, held = (values[:, first.names.index(name)] for name in ("rmse", "rmse_left_out"))
    deviation = [float(x.std(ddof=1)) if len(x) > 1 else 0.0 for x in (unseen, held)]
    names = ("rmse_spread", "rmse_left_out", "rmse_left_out_spread")
    return Metrics(names, (first.units[0],) * 3, np.array([deviation[0], float(held.mean()), deviation[1]]))
