"""PartMM, and FullMM where there is one part: motion matching, the paper's method."""

from __future__ import annotations

from typing import Annotated, Literal

from tasks.geometry.skinning import skin
from tasks.motion.matching import Way, match
from tasks.values import Animation, Poses, Training


def animate(
    training: Training,
    query: Poses,
    *,
    k: Annotated[int, "[1, inf)"],
    patch: Annotated[int, "[1, inf)"],
    levels: Annotated[int, "[1, inf)"],
    lambda_: Annotated[float, "(0, 1]"],
    temperature: Annotated[float, "(0, inf)"],
    represent: Literal["root", "part", "residual"],
    align: bool,
    dynamics: Annotated[float, "[0, inf)"],
    shrink: Annotated[
        bool,
        "not shrink or represent == 'residual': false without represent=residual (there is nothing to shrink towards)",
        "not (shrink and sources): false with sources (they are not shrunk)",
    ],
    mirror: bool,
    sources: Annotated[int, "[0, inf)"],
    every: Annotated[int, "[1, inf)", "sources or every == 1: 1 without sources (windows are of all frames)"],
) -> Animation:
    """Poses -> points by partwise motion matching (GaussiAnimate 3.3, eq. 7-10 and alg. 1), then skinning by W.

    k: windows blended for each part; patch: frames of a window (p); levels: most pyramid levels, of which as many are
    used as let every frame lie in a window, min(levels, 1 + floor(log2(F / p))); lambda_: weight of a finer level.
    temperature: of the softmax over windows, in units of the best window's distance.
    represent: what bones are stored relative to: the model's ``root`` (the paper), the ``part``'s root joint, or as a
    ``residual`` on what skinning of the skeleton predicts for them.
    align: turn matched bones to the query's joints by eq. 9, about the part's root joint. Residuals are seen from the
    posed skeleton already: nothing is left to align.
    dynamics: weight of gravity, velocity, acceleration and angular velocity of the root in the key; 0 is the paper's.
    shrink: take as much of each bone's residual as proved right when training clips were matched against each other
    (``residual``).
    mirror: match the training clips' mirror images as well, where the character is symmetric.
    sources: instead of the mean of windows, blend as many training frames, those whose pose with its past comes
    nearest, by the shares that predict the query's pose from theirs (:mod:`tasks.motion.affine`); 0 is the paper's.
    every: of which only every so many-th of a clip is a candidate: neighbours say the same.

    Clips of the query shorter than a patch are padded with their last pose. Raises InputError for poses of another
    skeleton, matrices that are no rotations, and training clips all shorter than a patch.
    """
    way = Way(k, patch, levels, lambda_, temperature, represent, align, dynamics, shrink, mirror, sources, every)
    found = match(training, query, way)
    points = skin(training.skinning.rest, training.skinning.weights, found.bones)
    return Animation(
        points=points, bones=found.bones, sources=found.sources, distance=found.distance, parts=training.parts.names
    )
