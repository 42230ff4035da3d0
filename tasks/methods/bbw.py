"""Linear blend skinning with bounded biharmonic weights: the baseline for animals, whose data brings no weights."""

from __future__ import annotations

from typing import Annotated

import numpy as np

from tasks.geometry.kinematics import forward
from tasks.geometry.skinning import skin
from tasks.motion.harmonic import biharmonic_weights
from tasks.motion.query import check_poses
from tasks.values import Animation, Poses, Training


def animate(training: Training, query: Poses, *, cells: Annotated[int, "[8, inf)"]) -> Animation:
    """Poses -> points by forward kinematics and weights that shape and bones alone decide (Jacobson et al. 2011).

    cells: of the lattice that they are solved on, at most; 3,000 take some 10 s. Raises InputError for poses of another
    skeleton, matrices that are no rotations, and too few cells.
    """
    check_poses(query, training.skeleton, "query")
    skeleton = training.skeleton
    weights = biharmonic_weights(training.canonical, skeleton, cells=cells)
    transforms = forward(np.asarray(skeleton.parents), skeleton.joints, query.rotations, query.translations)
    return Animation(points=skin(training.canonical.points, weights, transforms))
