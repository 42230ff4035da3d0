"""Bones as kernel regression by parts foretells them, and how far off that should be.

The same for training frames, each clip foretold by the others: what comes behind sees of training what it will see of
a query. A Gaussian process's variance (Rasmussen and Williams 2006, 2.26) says how far a pose lies from the database.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tasks.motion import kernel
from tasks.motion.posed import Posed
from tasks.motion.regression import features, from_numbers, joint_weights, shape_units, to_numbers

SAMPLE = 500  # frames that width and ridge are chosen on


@dataclass(frozen=True)
class Foretold:
    """bones: (F, B, 3, 4) on canonical points; variance: (F, P) of each part, 1 is to know nothing."""

    bones: np.ndarray
    variance: np.ndarray


def foretell(
    known: Posed,
    image: tuple[Posed, np.ndarray] | None,
    asked: Posed,
    *,
    dynamics: float,
    lags: list[int],
    width: float,
    ridge: float,
    landmarks: int,
) -> tuple[Foretold, Foretold]:
    """The training frames, each clip without itself and its image, and the frames that are asked. image: mirrored poses
    and bones to learn from as well; settings: see :mod:`tasks.methods.part_kernel`. With a single clip nothing is tuned
    and its own frames are told with nothing left out."""
    training = known.training
    unit = shape_units(training)
    numbers = to_numbers(known.encode(training.database.bones, "residual"))
    start = known.poses.clip_start
    clip = np.repeat(np.arange(len(start) - 1), np.diff(start))
    rows = kernel.landmarks_of(len(clip), landmarks if image is None else landmarks // 2)
    some = kernel.landmarks_of(len(rows), SAMPLE)
    others = None if image is None else to_numbers(image[0].encode(image[1], "residual"))[rows]
    parts, several = training.parts.affinity, len(start) > 2
    out = [
        Foretold(np.zeros((len(p.world), *unit.shape)), np.zeros((len(p.world), len(parts)))) for p in (known, asked)
    ]
    for part, affinity in enumerate(parts):
        follows, joints = np.flatnonzero(affinity > 0), known.key_joints(part)
        heavy = joint_weights(known, part, joints)
        seen = [known, asked] if image is None else [known, asked, image[0]]
        x, z, *more = (features(p, joints, heavy, dynamics=dynamics, lags=lags) for p in seen)
        y = (numbers[rows][:, follows] * unit[follows]).reshape(len(rows), -1)
        apart = kernel.squared_distances(x[rows], x[rows])
        median = float(np.median(apart[apart > 0])) if (apart > 0).any() else 1.0
        inner = apart[np.ix_(some, some)] / median
        w, r, centred = width, ridge, True
        if several:
            w, r, centred = kernel.best_settings(inner, y[some], clip[rows][some], width, ridge)
        centres, owner = x[rows], clip[rows]
        if image is not None:
            centres, owner = np.concatenate([centres, more[0][rows]]), np.concatenate([owner, owner])
            y = np.concatenate([y, (others[:, follows] * unit[follows]).reshape(len(rows), -1)])
        process = _Process(centres, y, owner, np.sqrt(median) * w, r, centred)
        for made, answers in zip(out, (process.left_out(x, clip) if several else process(x), process(z)), strict=True):
            told = answers[0].reshape(len(answers[0]), len(follows), 6) / unit[follows]
            made.bones[:, follows] += affinity[follows, None] * told
            made.variance[:, part] = answers[1]
    return tuple(
        Foretold(posed.decode(from_numbers(made.bones), "residual"), made.variance)
        for posed, made in zip((known, asked), out, strict=True)
    )


class _Process:
    """Kernel regression whose inverse matrix is kept. owner: (M,) the clip that each centre is of."""

    def __init__(self, centres, y, owner, scale: float, ridge: float, centred: bool) -> None:
        self.centres, self.owner, self.scale = centres, owner, scale
        self.y, self.centred = y, centred
        gram = kernel.correlation(centres, centres, scale)
        gram[np.diag_indices_from(gram)] += ridge
        self.inverse = kernel.inverted(gram)

    def __call__(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(T, D) -> (T, Y) and the variance (T,)."""
        mean = self._mean(np.ones(len(self.y), bool))
        near = kernel.correlation(z, self.centres, self.scale)
        solved = near @ self.inverse
        return mean + solved @ (self.y - mean), np.maximum(1.0 - (solved * near).sum(1), 0.0)

    def left_out(self, x: np.ndarray, clip: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The same for training frames, each without the centres of its own clip: with those, c, and the others, o, the
        inverse of the others' matrix is Q_oo - Q_oc Q_cc^-1 Q_co."""
        made, variance = np.empty((len(x), self.y.shape[1])), np.empty(len(x))
        for c in np.unique(clip):
            mine, own = clip == c, self.owner == c
            mean = self._mean(~own)
            near = kernel.correlation(x[mine], self.centres, self.scale)
            near[:, own] = 0.0
            solved = near @ self.inverse
            apart = np.linalg.solve(self.inverse[np.ix_(own, own)], solved[:, own].T).T
            solved -= apart @ self.inverse[own]
            made[mine] = mean + solved[:, ~own] @ (self.y[~own] - mean)
            variance[mine] = np.maximum(1.0 - (solved * near).sum(1), 0.0)
        return made, variance

    def _mean(self, of: np.ndarray) -> np.ndarray:
        return self.y[of].mean(0) if self.centred else np.zeros(self.y.shape[1])
