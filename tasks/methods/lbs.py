"""Linear blend skinning with the skeleton's own weights: the first baseline, no free-form bones at all."""

from __future__ import annotations

import numpy as np

from tasks.geometry.kinematics import forward
from tasks.geometry.skinning import skin
from tasks.motion.query import check_poses
from tasks.values import Animation, Poses, Training


def animate(training: Training, query: Poses) -> Animation:
    """Poses -> points by forward kinematics and the skeleton's weights (N, J).

    Raises InputError for poses of another skeleton and matrices that are no rotations.
    """
    check_poses(query, training.skeleton, "query")
    skeleton = training.skeleton
    transforms = forward(np.asarray(skeleton.parents), skeleton.joints, query.rotations, query.translations)
    return Animation(points=skin(training.canonical.points, skeleton.weights, transforms))
