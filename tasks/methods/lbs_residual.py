"""Skinning of the skeleton plus a constant: each bone's mean residual over the training frames."""

from __future__ import annotations

import numpy as np

from tasks.geometry import rigid
from tasks.geometry.skinning import skin
from tasks.motion.posed import Posed
from tasks.motion.projection import project
from tasks.motion.query import check_poses
from tasks.values import Animation, Poses, Training


def animate(training: Training, query: Poses) -> Animation:
    """Poses -> points: where the skeleton's skinning carries each free-form bone, moved by what it missed on average.

    A row that keeps others honest: whatever learns from the pose must beat it. Raises InputError for bad poses.
    """
    check_poses(query, training.skeleton, "query")
    known, asked = Posed(training, training.database.poses), Posed(training, query)
    mean = known.encode(training.database.bones, "residual").mean(0)
    frames = np.broadcast_to(rigid.make(project(mean[..., :3]), mean[..., 3]), (len(asked.world), *mean.shape))
    bones = asked.decode(frames, "residual").astype(np.float32)
    return Animation(points=skin(training.skinning.rest, training.skinning.weights, bones), bones=bones)
