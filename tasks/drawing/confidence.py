"""The error that was expected of unseen frames, beside that of the methods."""

from __future__ import annotations

import numpy as np

from tasks.drawing import plot
from tasks.evaluation.metrics import frame_rmse
from tasks.values import Animation, Confidence, Motion, Picture


def confidence_picture(confidence: Confidence, animations: dict[str, Animation], test: Motion) -> Picture:
    """Error of some methods along the unseen frames, and what was to be expected."""
    frames = np.arange(test.frames, dtype=float)
    factor, unit = (1000.0, "mm") if test.unit == "m" else (1.0, "unit")
    lines = {"expected": confidence.expected} if confidence.expected.any() else {}
    lines |= {label: frame_rmse(animation.points, test.points) for label, animation in animations.items()}
    series = [plot.Series(name, frames, factor * np.asarray(y, float)) for name, y in lines.items()]
    clips = [(float(clip.start), name) for name, clip in zip(test.clip_names, test.clips(), strict=True)]
    drawing = plot.lines(series, x="unseen frame", y=f"RMSE [{unit}]", marks=clips)
    return Picture("confidence", f"{test.name}: error expected from the distance to the database", None, drawing)
