"""Kernel ridge regression part by part, on the same database that is matched."""

from __future__ import annotations

from typing import Literal

import numpy as np

from tasks.errors import InputError
from tasks.geometry.skinning import skin
from tasks.motion import kernel
from tasks.motion.posed import Posed
from tasks.motion.query import check_poses
from tasks.motion.regression import features, from_numbers, shape_units, to_numbers
from tasks.values import Animation, Poses, Training


def animate(
    training: Training,
    query: Poses,
    *,
    represent: Literal["root", "residual"],
    dynamics: float,
    lag: int,
    lags: int,
    width: float,
    ridge: float,
    tune: bool,
    landmarks: int,
) -> Animation:
    """Poses -> points: each part's bones by Gaussian kernel ridge regression on its pose, then skinning by W.

    No gradient steps: the database is the model. Matching averages the few frames that come closest; this weighs all.
    represent: regress bones relative to the model's ``root``, or their ``residual`` on skinning of the skeleton.
    dynamics: weight of the root's gravity, velocity, acceleration and angular velocity among the features.
    lag, lags: features of now and of ``lags`` earlier moments, ``lag`` frames apart.
    width, ridge, tune, landmarks: see :func:`tasks.motion.kernel.fit`; tuning looks at training clips alone.
    Raises InputError for bad poses (as PartMM) and numbers out of range.
    """
    for name, good, expected, found in (
        ("lag", lag >= 1, "1 or more frames", lag),
        ("lags", lags >= 0, "0 or more", lags),
        ("width", width > 0, "a positive number", width),
        ("ridge", ridge > 0, "a positive number", ridge),
        ("dynamics", dynamics >= 0, "0 (off) or a positive weight", dynamics),
        ("landmarks", landmarks >= 2, "2 or more frames", landmarks),
    ):
        if not good:
            raise InputError(f"animate.{name}", expected=expected, found=str(found))
    check_poses(query, training.skeleton, "query")
    known, asked = Posed(training, training.database.poses), Posed(training, query)
    numbers = to_numbers(known.encode(training.database.bones, represent))
    unit = shape_units(training)
    past = [lag * i for i in range(lags + 1)]
    made = np.zeros((len(asked.world), *numbers.shape[1:]))
    for part, affinity in enumerate(training.parts.affinity):
        follows = np.flatnonzero(affinity > 0)
        joints = known.key_joints(part)
        x, z = (features(posed, joints, dynamics=dynamics, lags=past) for posed in (known, asked))
        y = (numbers[:, follows] * unit[follows]).reshape(len(x), -1)
        model = kernel.fit(x, y, known.poses.clip_start, width=width, ridge=ridge, tune=tune, landmarks=landmarks)
        made[:, follows] += affinity[follows, None] * model(z).reshape(len(z), len(follows), 6) / unit[follows]
    bones = asked.decode(from_numbers(made), represent).astype(np.float32)
    points = skin(training.skinning.rest, training.skinning.weights, bones)
    return Animation(points=points, bones=bones, parts=training.parts.names)
