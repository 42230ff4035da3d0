"""Each bone's own linear answer to being shaken, and part by part what the pose explains of the rest."""

from __future__ import annotations

from typing import Annotated

import numpy as np

from tasks.geometry.skinning import skin
from tasks.motion import kernel, response
from tasks.motion.posed import Posed
from tasks.motion.query import check_poses
from tasks.motion.regression import features, from_numbers, joint_weights, shape_units, to_numbers
from tasks.values import Animation, Poses, Training


def animate(
    training: Training,
    query: Poses,
    *,
    lag: Annotated[int, "[1, inf)"],
    lags: Annotated[int, "[0, inf)"],
    pose: bool,
    width: Annotated[float, "(0, inf)"],
    ridge: Annotated[float, "(0, inf)"],
    landmarks: Annotated[int, "[2, inf)"],
) -> Animation:
    """Poses -> points: residuals on the skeleton's skinning, in two steps, then skinning by W.

    First :mod:`tasks.motion.response`, bone by bone, on now and ``lags`` earlier moments, ``lag`` frames apart. Then,
    with ``pose``, kernel ridge regression on each part's pose of what that leaves of clips it did not see; width, ridge
    and landmarks as in :func:`tasks.motion.kernel.fit`, tuned on left-out training clips. Not in the paper.
    Raises InputError for bad poses.
    """
    check_poses(query, training.skeleton, "query")
    known, asked = Posed(training, training.database.poses), Posed(training, query)
    unit = shape_units(training)
    left = to_numbers(known.encode(training.database.bones, "residual")) * unit
    made = np.zeros((len(asked.world), *left.shape[1:]))
    past = [lag * i for i in range(lags + 1)]
    for bone in range(left.shape[1]):
        x, z = (response.shaking(posed, bone, past) for posed in (known, asked))
        filters, unseen = response.fit(x, left[:, bone], known.poses.clip_start)
        made[:, bone] = z @ filters
        left[:, bone] -= unseen
    clip = np.repeat(np.arange(len(known.poses.clip_start) - 1), np.diff(known.poses.clip_start))
    for part, affinity in enumerate(training.parts.affinity if pose else ()):
        follows, joints = np.flatnonzero(affinity > 0), known.key_joints(part)
        heavy = joint_weights(known, part, joints)
        x, z = (features(posed, joints, heavy, dynamics=0.0, lags=[0]) for posed in (known, asked))
        y = left[:, follows].reshape(len(left), -1)
        rest = kernel.fit(x, y, clip, width=width, ridge=ridge, tune=True, landmarks=landmarks)
        made[:, follows] += affinity[follows, None] * rest(z).reshape(len(z), len(follows), 6)
    bones = asked.decode(from_numbers(made / unit), "residual").astype(np.float32)
    points = skin(training.skinning.rest, training.skinning.weights, bones)
    return Animation(points=points, bones=bones, parts=training.parts.names)
