"""Kernel regression part by part, and the cloth itself, simulated where regression does not know."""

from __future__ import annotations

from typing import Annotated

import numpy as np

from tasks.errors import InputError
from tasks.geometry import rigid
from tasks.geometry.measure import diagonal
from tasks.geometry.parallel import for_chunks
from tasks.geometry.skinning import skin
from tasks.motion.cloth import fabric, simulate
from tasks.motion.foretold import Foretold, foretell
from tasks.motion.mirror import mirrored
from tasks.motion.outline import find_outline
from tasks.motion.posed import FRAME_CHUNK, Posed
from tasks.motion.projection import project
from tasks.motion.query import check_poses
from tasks.values import Animation, Poses, Training

LEAST = 1e-3  # of the variance of knowing nothing: no pose is known for certain
ROUNDS = 3  # of fitting bones to the points; what is left after them is a tenth of a millimetre less with each


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

    Where the database knows a pose, the cloth is held to what is foretold; where it does not, it hangs and swings by
    itself, over a body that the training frames outline. What is foretold should err by e, which is calibrated on
    training clips as the others foretell them; the simulation's error is measured on the same clips, and both answers
    are averaged by the inverse squares of their errors. Where that predicts the left-out clips no better than what is
    foretold alone (skin, fur, animals), and with a single clip, the latter is the answer.
    dynamics, reach, width, ridge, landmarks, mirror: of the regression, as in :mod:`tasks.methods.part_kernel`, tuned.
    pull: rad/s, stiffness of the hold where e is as in the mean of the training clips; it grows with 1 / e^2.
    substeps: of a frame; density, stretch, drag, friction: kg/m^2, N/m of a thread, 1/s and Coulomb's, of the cloth. In
    data of unknown unit the shape's diagonal is two metres.
    Raises InputError for bad poses (as PartMM) and bare points.
    """
    check_poses(query, training.skeleton, "query")
    faces, rest = training.canonical.faces, training.skinning.rest
    if faces is None:
        do = "use method=part_kernel"
        raise InputError("dataset", expected="a mesh, whose edges hold the cloth", found="bare points", do=do)
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
    truth, fps = training.motion.points, training.motion.fps
    foretold = [skin(rest, training.skinning.weights, t.bones) for t in (told, made)]
    answer = Animation(points=foretold[1], bones=made.bones.astype(np.float32), parts=training.parts.names)
    if len(known.poses.clip_start) < 3:
        return answer
    metre = 1.0 if training.motion.unit == "m" else diagonal(rest) / 2.0
    cloth = fabric(rest / metre, faces, density=density, stretch=stretch, drag=drag, friction=friction)
    worlds = [np.concatenate([p.world[..., :3], p.world[..., 3:] / metre], axis=3) for p in (known, asked)]
    body = find_outline(training.skeleton, training.skeleton.joints / metre, worlds[0], truth / metre)
    wrong = ((foretold[0].astype(np.float64) - truth) ** 2).sum(2)
    doubts = [_doubt(training, t) for t in (told, made)]
    scale = wrong.mean(0) / doubts[0].mean(0)
    usual = wrong.mean()
    expected = [np.maximum(scale * d, 1e-12 * usual) for d in doubts]  # squared errors, (F, N)

    def hang(which: int, posed: Posed) -> np.ndarray:
        stiff = pull * usual / expected[which]
        start, target = posed.poses.clip_start, foretold[which] / metre
        return metre * simulate(cloth, body, worlds[which], target, stiff, start, fps=fps, substeps=substeps)

    hung = hang(0, known)
    error = ((hung - truth) ** 2).sum(2).mean(0)
    mixed = hung + (error / (error + expected[0]))[..., None] * (foretold[0] - hung)
    if not ((mixed - truth) ** 2).sum() < wrong.sum():
        return answer
    hung = hang(1, asked)
    mixed = hung + (error / (error + expected[1]))[..., None] * (foretold[1] - hung)
    bones = _fitted(training, made.bones, mixed)
    return Animation(skin(rest, training.skinning.weights, bones), bones.astype(np.float32), parts=training.parts.names)


def _doubt(training: Training, told: Foretold) -> np.ndarray:
    """What a point's squared error goes with: the root of its parts' variance, (F, N)."""
    share = training.skinning.weights.astype(np.float64) @ training.parts.affinity.T
    return np.sqrt(told.variance @ share.T + LEAST)


def _fitted(training: Training, bones: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Bones moved so that skinning comes close to the points (F, N, 3): each by the rigid motion that its own points
    make from where they are, some times over."""
    rest, weights = training.skinning.rest, training.skinning.weights.astype(np.float64)
    mass = np.maximum(weights.sum(0), 1e-12)
    out = np.array(bones, np.float64)

    def work(a: int, b: int) -> None:
        for _ in range(ROUNDS):
            at, to = skin(rest, weights, out[a:b]).astype(np.float64), points[a:b]
            centre, goal = (np.einsum("nb,fni->fbi", weights, p, optimize=True) / mass[:, None] for p in (at, to))
            pairs = (to[..., :, None] * at[..., None, :]).reshape(b - a, len(rest), 9)
            spread = np.einsum("nb,fnk->fbk", weights, pairs, optimize=True).reshape(b - a, -1, 3, 3)
            turn = project(spread - mass[:, None, None] * goal[..., :, None] * centre[..., None, :])
            moved = rigid.make(turn, goal - (turn @ centre[..., None])[..., 0])
            out[a:b] = rigid.compose(moved, out[a:b])

    for_chunks(work, len(out), FRAME_CHUNK)
    return out
