"""Kernel regression part by part, and the cloth itself, simulated where regression does not know."""

from __future__ import annotations

from typing import Annotated

import numpy as np

from tasks.geometry.skinning import skin
from tasks.motion.foretold import foretell
from tasks.motion.hung import Hanging, check_mesh, hung
from tasks.motion.mirror import mirrored
from tasks.motion.posed import Posed
from tasks.motion.query import check_poses
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
    pull: Annotated[float, "(0, inf)"],
    substeps: Annotated[int, "[1, inf)"],
    density: Annotated[float, "(0, inf)"],
    stretch: Annotated[float, "(0, inf)"],
    drag: Annotated[float, "[0, inf)"],
    friction: Annotated[float, "[0, inf)"],
) -> Animation:
    """Poses -> points: bones foretold by kernel regression, cloth simulated about them, both weighed. Not in the paper.

    dynamics, reach, width, ridge, landmarks, mirror: of the regression, as in :mod:`tasks.methods.part_kernel`, tuned.
    pull, substeps, density, stretch, drag, friction: of the cloth, as in :class:`tasks.motion.hung.Hanging`.
    Raises InputError for bad poses (as PartMM) and bare points.
    """
    check_poses(query, training.skeleton, "query")
    check_mesh(training, "part_kernel")
    known, asked = Posed(training, training.database.poses), Posed(training, query)
    image = mirrored(training) if mirror else None
    told, made = foretell(
        known,
        None if image is None else (Posed(training, image[0], known), image[1]),
        asked,
        dynamics=dynamics,
        lags=[0, *(2**i for i in range(reach.bit_length()))],
        width=width,
        ridge=ridge,
        landmarks=landmarks,
    )
    bones = hung((known, told), (asked, made), Hanging(pull, substeps, density, stretch, drag, friction))
    points = skin(training.skinning.rest, training.skinning.weights, bones)
    return Animation(points, bones.astype(np.float32), parts=training.parts.names)
