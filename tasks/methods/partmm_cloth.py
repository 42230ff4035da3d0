"""Motion matching part by part, and the cloth itself, simulated where no training pose comes close."""

from __future__ import annotations

from typing import Annotated

import numpy as np

from tasks.geometry.skinning import skin
from tasks.motion.foretold import Foretold
from tasks.motion.hung import Hanging, check_mesh, hung
from tasks.motion.matching import Way, match_prepared, prepare
from tasks.motion.posed import Posed
from tasks.motion.query import check_poses
from tasks.values import Animation, Poses, Training


def animate(
    training: Training,
    query: Poses,
    *,
    k: Annotated[int, "[1, inf)"],
    patch: Annotated[int, "[1, inf)"],
    dynamics: Annotated[float, "[0, inf)"],
    mirror: bool,
    sources: Annotated[int, "[1, inf)"],
    every: Annotated[int, "[1, inf)"],
    pull: Annotated[float, "(0, inf)"],
    substeps: Annotated[int, "[1, inf)"],
    density: Annotated[float, "(0, inf)"],
    stretch: Annotated[float, "(0, inf)"],
    drag: Annotated[float, "[0, inf)"],
    friction: Annotated[float, "[0, inf)"],
) -> Animation:
    """Poses -> points: bones matched, cloth simulated about them, both weighed. Not in the paper.

    k, patch: of the windows whose distance is told; dynamics, mirror, sources, every: of matching, as in
    :mod:`tasks.methods.partmm` with residuals. The sources that are named are those of the matched answer.
    pull, substeps, density, stretch, drag, friction: of the cloth, as in :class:`tasks.motion.hung.Hanging`.
    Raises InputError for bad poses and clips too short (as PartMM), and bare points.
    """
    check_poses(query, training.skeleton, "query")
    check_mesh(training, "partmm_plus")
    way = Way(k, patch, 1, 1.0, 1.0, "residual", False, dynamics, False, mirror, sources, every)
    ready = prepare(training, way)
    known, asked = Posed(training, training.database.poses), Posed(training, query)
    found = match_prepared(ready, query)
    several = len(known.poses.clip_start) > 2
    seen = match_prepared(ready, known.poses, left_out=True) if several else found
    told, made = (Foretold(m.bones.astype(np.float64), m.variance) for m in (seen, found))
    bones = hung((known, told), (asked, made), Hanging(pull, substeps, density, stretch, drag, friction))
    points = skin(training.skinning.rest, training.skinning.weights, bones)
    return Animation(
        points, bones.astype(np.float32), sources=found.sources, distance=found.distance, parts=training.parts.names
    )
