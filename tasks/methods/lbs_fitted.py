"""Linear blend skinning by the skeleton, its weights fitted to the training frames: the best that LBS can do."""

from __future__ import annotations

from typing import Annotated

import numpy as np

from tasks.geometry import rigid
from tasks.geometry.skinning import skin
from tasks.motion.fitting import fit_weights
from tasks.motion.posed import Posed
from tasks.motion.query import check_poses
from tasks.values import Animation, Poses, Training


def animate(
    training: Training, query: Poses, *, influences: Annotated[int, "[1, inf)"], keep: Annotated[float, "[0, inf)"]
) -> Animation:
    """Poses -> points by forward kinematics and weights that were fitted to the training points.

    influences: joints a point may follow; keep: pull towards the skeleton's own weights, which decide where the
    training frames do not. Raises InputError for bad poses.
    """
    check_poses(query, training.skeleton, "query")
    known, asked = Posed(training, training.database.poses), Posed(training, query)
    away = rigid.inverse(known.world[:, known.root])[:, None]  # global motion tells nothing about weights
    seen, joints = rigid.apply(away, training.motion.points), known.model
    rest, own = training.canonical.points, training.skeleton.weights
    weights = fit_weights(seen, rest, joints, own, influences=influences, keep=keep)
    return Animation(points=skin(rest, weights, asked.world.astype(np.float32)))
