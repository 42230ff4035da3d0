"""Kernel ridge regression bone by bone: of the poses of the joints that carry it, and of how it is shaken itself."""

from __future__ import annotations

from typing import Annotated

import numpy as np

from tasks.geometry.skinning import skin
from tasks.motion import bonewise, kernel
from tasks.motion.mirror import mirrored
from tasks.motion.posed import Posed
from tasks.motion.query import check_poses
from tasks.motion.regression import from_numbers
from tasks.values import Animation, Poses, Training


def animate(
    training: Training,
    query: Poses,
    *,
    dynamics: Annotated[float, "[0, inf)"],
    reach: Annotated[int, "[0, inf)"],
    width: Annotated[float, "(0, inf)"],
    ridge: Annotated[float, "(0, inf)"],
    landmarks: Annotated[int, "[2, inf)"],
    mirror: bool,
) -> Animation:
    """Poses -> points: each bone by kernel ridge regression, then skinning by W. Not in the paper.

    Each bone's transform is told twice, as residual on the skeleton's skinning and relative to the model's root: one
    factorisation serves both. The answers are averaged; the share of the second, and what multiples of ``width`` and
    ``dynamics`` are used, are the same for all bones and predict left-out training clips best.
    dynamics: weight of gravity, velocity, acceleration and angular velocity, of the root and of the bone's own place.
    reach: features of now and of 1, 2, 4, ... frames ago, up to so many; 0 for now alone.
    width, ridge, landmarks: see :func:`tasks.motion.kernel.fit`.
    mirror: learn from the training clips' mirror images as well, where the character is symmetric and that predicts
    left-out clips better.
    Raises InputError for bad poses (as PartMM).
    """
    check_poses(query, training.skeleton, "query")
    known, asked = Posed(training, training.database.poses), Posed(training, query)
    lags = [0, *(2**i for i in range(reach.bit_length()))]
    told = bonewise.Told(known, training.database.bones, lags)
    image = mirrored(training) if mirror else None
    more = None if image is None else bonewise.Told(Posed(training, image[0], known), image[1], lags)
    choice = bonewise.choose(told, more, dynamics=dynamics, width=width, ridge=ridge)
    numbers = np.empty((2, len(asked.world), told.numbers.shape[1], 6))
    query_told = bonewise.Told(asked, None, lags)
    for bone in range(numbers.shape[2]):
        x, z = (t.features(bone, choice.dynamics) for t in (told, query_told))
        pair = (more.features(bone, choice.dynamics), more.numbers[:, bone]) if choice.mirror else None
        settings = {"width": choice.width, "ridge": ridge, "tune": False, "landmarks": landmarks}
        made = kernel.fit(x, told.numbers[:, bone], told.clip, more=pair, **settings)(z)
        numbers[:, :, bone] = made.reshape(len(z), 2, 6).transpose(1, 0, 2)
    answer = bonewise.both(query_told, *numbers, choice.share)
    bones = asked.decode(from_numbers(answer / told.unit), "residual").astype(np.float32)
    points = skin(training.skinning.rest, training.skinning.weights, bones)
    return Animation(points=points, bones=bones, parts=training.parts.names)
