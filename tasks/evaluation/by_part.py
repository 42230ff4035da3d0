"""Where on the shape a result errs: by clip and part of the skeleton."""

from __future__ import annotations

import numpy as np

from tasks.evaluation.metrics import clip_keys, declared, squared_errors
from tasks.values import Animation, Metrics, Motion, Parts, Skinning


def evaluate_parts(animation: Animation, test: Motion, skinning: Skinning, parts: Parts) -> Metrics:
    """RMSE of each part's vertices in each clip: "part_rmse@clip, part". A vertex belongs to the part that holds most
    of its skin weight, through the free-form bones; parts without a vertex are left out."""
    owner = (skinning.weights.astype(np.float64) @ parts.affinity.T).argmax(1)
    squared = squared_errors(animation.points, test.points)
    found = {
        f"part_rmse@{key}, {name}": float(np.sqrt(squared[clip][:, owner == part].mean()))
        for key, clip in zip(clip_keys(test.clip_names), test.clips(), strict=True)
        for part, name in enumerate(parts.names)
        if (owner == part).any()
    }
    return declared(found, test.unit)
