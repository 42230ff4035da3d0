"""Kernel ridge regression part by part, on the same database that is matched."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np

from tasks.geometry.skinning import skin
from tasks.motion import kernel
from tasks.motion.mirror import mirrored
from tasks.motion.posed import Posed
from tasks.motion.query import check_poses
from tasks.motion.regression import features, from_numbers, joint_weights, shape_units, to_numbers
from tasks.values import Animation, Poses, Training


def animate(
    training: Training,
    query: Poses,
    *,
    represent: Literal["root", "residual"],
    dynamics: Annotated[float, "[0, inf)"],
    reach: Annotated[int, "[0, inf)"],
    width: Annotated[float, "(0, inf)"],
    ridge: Annotated[float, "(0, inf)"],
    tune: bool,
    landmarks: Annotated[int, "[2, inf)"],
    mirror: bool,
) -> Animation:
    """Poses -> points: each part's bones by kernel ridge regression on its pose, then skinning by W.

    No gradient steps: the database is the model. Matching averages the few frames that come closest; this weighs all.
    represent: regress bones relative to the model's ``root``, or their ``residual`` on skinning of the skeleton.
    dynamics: weight of the root's gravity, velocity, acceleration and angular velocity among the features.
    reach: features of now and of 1, 2, 4, ... frames ago, up to so many; 0 for now alone.
    width, ridge, tune, landmarks: see :func:`tasks.motion.kernel.fit`; tuning looks at training clips alone.
    mirror: learn from the training clips' mirror images as well, where the character is symmetric and, with
    ``tune``, where that predicts left-out clips better.
    Raises InputError for bad poses (as PartMM).
    """
    check_poses(query, training.skeleton, "query")
    known, asked = Posed(training, training.database.poses), Posed(training, query)
    image = mirrored(training) if mirror else None
    learnt = [known] if image is None else [known, Posed(training, image[0], known)]
    bones = [training.database.bones] if image is None else [training.database.bones, image[1]]
    numbers = [to_numbers(p.encode(b, represent)) for p, b in zip(learnt, bones, strict=True)]
    unit = shape_units(training)
    lags = [0, *(2**i for i in range(reach.bit_length()))]
    clip = np.repeat(np.arange(len(known.poses.clip_start) - 1), np.diff(known.poses.clip_start))
    made = np.zeros((len(asked.world), *numbers[0].shape[1:]))
    for part, affinity in enumerate(training.parts.affinity):
        follows, joints = np.flatnonzero(affinity > 0), known.key_joints(part)
        heavy = joint_weights(known, part, joints)
        *x, z = (features(p, joints, heavy, dynamics=dynamics, lags=lags) for p in (*learnt, asked))
        y = [(n[:, follows] * unit[follows]).reshape(len(n), -1) for n in numbers]
        more = (x[1], y[1]) if len(x) > 1 else None
        model = kernel.fit(x[0], y[0], clip, width=width, ridge=ridge, tune=tune, landmarks=landmarks, more=more)
        made[:, follows] += affinity[follows, None] * model(z).reshape(len(z), len(follows), 6) / unit[follows]
    answer = asked.decode(from_numbers(made), represent).astype(np.float32)
    points = skin(training.skinning.rest, training.skinning.weights, answer)
    return Animation(points=points, bones=answer, parts=training.parts.names)
