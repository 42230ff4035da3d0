"""What is foretold of a cloth and the cloth simulated about it, both weighed by their errors on training clips.

Where the database knows a pose, the cloth is held to what is foretold; where it does not, it hangs and swings by
itself, over a body that the training frames outline. What is foretold should err by e, which is calibrated on training
clips as the others foretell them; the simulation's error is measured on the same clips, and both answers are averaged
by the inverse squares of their errors.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tasks.errors import InputError
from tasks.geometry import rigid
from tasks.geometry.measure import diagonal
from tasks.geometry.parallel import for_chunks
from tasks.geometry.skinning import skin
from tasks.motion.cloth import fabric, simulate
from tasks.motion.foretold import Foretold
from tasks.motion.outline import find_outline
from tasks.motion.posed import FRAME_CHUNK, Posed
from tasks.motion.projection import project
from tasks.values import Training

LEAST = 1e-3  # of the variance of knowing nothing: no pose is known for certain
PULLS = (0.5, 1.0, 1.5)  # multiples of the hold's stiffness that are tried
ROUNDS = 3  # of fitting bones to the points; what is left after them is a tenth of a millimetre less with each


@dataclass(frozen=True)
class Hanging:
    """pull: rad/s, stiffness of the hold where e is as in the mean of the training clips; it grows with 1 / e^2. Of
    some multiples the one is taken that predicts left-out clips best.
    substeps: of a frame; density, stretch, drag, friction: kg/m^2, N/m of a thread, 1/s and Coulomb's, of the cloth."""

    pull: float
    substeps: int
    density: float
    stretch: float
    drag: float
    friction: float


def check_mesh(training: Training, instead: str) -> None:
    """Raises InputError for bare points; instead: the method that takes them."""
    if training.canonical.faces is None:
        do = f"use method={instead}"
        raise InputError("dataset", expected="a mesh, whose edges hold the cloth", found="bare points", do=do)


def hung(known: tuple[Posed, Foretold], asked: tuple[Posed, Foretold], how: Hanging) -> np.ndarray:
    """Bones in the frames that are asked, (F, B, 3, 4) float64. known: the training frames, each clip as the others
    foretell it.

    Where the weighed answer predicts the left-out clips no better than what is foretold alone (skin, fur, animals), and
    with a single clip, the latter is the answer. In data of unknown unit the shape's diagonal is two metres.
    """
    training, bones = known[0].training, asked[1].bones
    if len(known[0].poses.clip_start) < 3:
        return bones
    rest, weights, truth = training.skinning.rest, training.skinning.weights, training.motion.points
    metre = 1.0 if training.motion.unit == "m" else diagonal(rest) / 2.0
    cloth = fabric(
        rest / metre,
        training.canonical.faces,
        density=how.density,
        stretch=how.stretch,
        drag=how.drag,
        friction=how.friction,
    )
    worlds = [np.concatenate([p.world[..., :3], p.world[..., 3:] / metre], axis=3) for p, _ in (known, asked)]
    body = find_outline(training.skeleton, training.skeleton.joints / metre, worlds[0], truth / metre)
    foretold = [skin(rest, weights, told.bones) for _, told in (known, asked)]
    wrong = ((foretold[0].astype(np.float64) - truth) ** 2).sum(2)
    expected = _expected(training, wrong, known[1], asked[1])

    def swung(which: int, posed: Posed, pull: float) -> np.ndarray:
        stiff = pull * how.pull * wrong.mean() / expected[which]
        start, target = posed.poses.clip_start, foretold[which] / metre
        fps, substeps = training.motion.fps, how.substeps
        return metre * simulate(cloth, body, worlds[which], target, stiff, start, fps=fps, substeps=substeps)

    def weighed(which: int, points: np.ndarray, error: np.ndarray) -> np.ndarray:
        return points + (error / (error + expected[which]))[..., None] * (foretold[which] - points)

    best, pull, error = float(wrong.sum()), None, None
    for tried in PULLS:
        own = swung(0, known[0], tried)
        mean = ((own - truth) ** 2).sum(2).mean(0)
        left = float(((weighed(0, own, mean) - truth) ** 2).sum())
        if left < best:
            best, pull, error = left, tried, mean
    if pull is None:
        return bones
    return fitted(training, bones, weighed(1, swung(1, asked[0], pull), error))


def _expected(training: Training, wrong: np.ndarray, *told: Foretold) -> list[np.ndarray]:
    """Squared errors of points, (F, N) each: they go with the root of the variance of a point's parts, times what makes
    the first of these ``wrong`` (F, N) as a whole."""
    share = training.skinning.weights.astype(np.float64) @ training.parts.affinity.T
    doubts = [np.sqrt(t.variance @ share.T + LEAST) for t in told]
    scale = wrong.mean(0) / doubts[0].mean(0)
    return [np.maximum(scale * d, 1e-12 * wrong.mean()) for d in doubts]


def fitted(training: Training, bones: np.ndarray, points: np.ndarray) -> np.ndarray:
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
