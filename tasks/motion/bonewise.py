"""What a single bone's transform is regressed on, and settings for all bones by leaving training clips out."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np

from tasks.motion import kernel
from tasks.motion.posed import Posed
from tasks.motion.regression import LEAST, from_numbers, joint_weights, shape_units, to_numbers, with_past

WIDTHS, DYNAMICS = (0.5, 1.0, 2.0), (1.0, 2.0)  # multiples of the settings that are tried
SAMPLE = 800  # frames, images counted, that the choice is made on
REPRESENT = ("residual", "root")


class Told:
    """Poses, and bones where they are known, as regressions bone by bone see them.

    numbers: (F, B, 12) the bone's six numbers as residual and seen from the root, times ``unit`` (B, 6); clip: (F,).
    """

    def __init__(self, posed: Posed, bones: np.ndarray | None, lags: list[int]) -> None:
        self.posed, self._lags = posed, lags
        self.unit = shape_units(posed.training)
        start = posed.poses.clip_start
        self.clip = np.repeat(np.arange(len(start) - 1), np.diff(start))
        if bones is not None:
            each = [to_numbers(posed.encode(bones, way)) * self.unit for way in REPRESENT]
            self.numbers = np.concatenate(each, axis=2)

    def features(self, bone: int, dynamics: float) -> np.ndarray:
        """(F, D) float64: :meth:`pose` and, so much heavier than in matching, :meth:`shaken`."""
        return np.concatenate([self.pose(bone), dynamics * self.shaken(bone)], axis=1)

    def pose(self, bone: int) -> np.ndarray:
        """Rotations of the joints below the root, weighed by what they say of the bone, with their past."""
        joints, weights = _carrying(self.posed, bone)
        turns = self.posed.poses.rotations[:, joints] * np.sqrt(weights / (2.0 * weights.sum()))[:, None, None]
        return with_past(turns.reshape(len(turns), -1), self.posed.poses.clip_start, self._lags)

    def shaken(self, bone: int) -> np.ndarray:
        """Dynamics of the root, and of the place where skinning carries the bone, with their past."""
        posed = self.posed
        own = posed.moving(posed.predicted[:, bone], np.zeros(3))
        now = np.concatenate([posed.dynamics, own], axis=1).reshape(len(own), -1)
        return with_past(now, posed.poses.clip_start, self._lags)


@dataclass(frozen=True)
class Choice:
    """What predicts left-out clips best. share: of the answer seen from the root; mirror: whether images help."""

    width: float
    dynamics: float
    share: float
    mirror: bool


def choose(told: Told, more: Told | None, *, dynamics: float, width: float, ridge: float) -> Choice:
    """Settings for all bones, on frames taken evenly; with a single clip, those given and residuals alone.

    more: mirror images of the same frames, left out together with what they are images of.
    """
    if len(np.unique(told.clip)) < 2:
        return Choice(width, dynamics, 0.0, more is not None)
    frames, most = len(told.clip), SAMPLE if more is None else SAMPLE // 2
    rows = np.unique(np.linspace(0, frames - 1, min(most, frames)).round().astype(int))
    tried = [(width * w, dynamics * d) for w, d in product(WIDTHS, DYNAMICS)]
    true = told.numbers[rows, :, :6]
    made, error, best = _best(told, more, rows, tried, ridge)
    gains = more is not None
    if gains:
        alone = _best(told, None, rows, tried, ridge)
        if alone[1] <= error:
            (made, error, best), gains = alone, False
    whole = np.zeros((len(told.clip), *true.shape[1:]))
    whole[rows] = made[:, :, 6:]
    residual, root = made[:, :, :6], as_residual(told, whole)[rows]
    apart = residual - root
    share = float((apart * (residual - true)).sum() / max(float((apart**2).sum()), 1e-30))
    width, dynamics = tried[best]
    return Choice(width, dynamics, float(np.clip(share, 0.0, 1.0)), gains)


def _best(
    told: Told, more: Told | None, rows: np.ndarray, tried: list[tuple[float, float]], ridge: float
) -> tuple[np.ndarray, float, int]:
    """What the best settings predict, (R, B, 12), its residuals' squared error, and which they are."""
    found = left_out(told, more, rows, tried, ridge)
    errors = ((found[..., :6] - told.numbers[rows, :, :6]) ** 2).sum((1, 2, 3))
    best = int(np.argmin(errors))
    return found[best], float(errors[best]), best


def both(told: Told, residual: np.ndarray, root: np.ndarray, share: float) -> np.ndarray:
    """(F, B, 6) both answers in one, as residuals times the unit."""
    return residual if share == 0.0 else (1.0 - share) * residual + share * as_residual(told, root)


def as_residual(told: Told, root: np.ndarray) -> np.ndarray:
    """Bones as seen from the root -> as residuals, (F, B, 6) times the unit."""
    bones = told.posed.decode(from_numbers(root / told.unit), "root")
    return to_numbers(told.posed.encode(bones, "residual")) * told.unit


def _carrying(posed: Posed, bone: int) -> tuple[np.ndarray, np.ndarray]:
    """Joints below the root and their weights: half by the skin that they share with the bone alone, half by what they
    say of the parts that it follows."""
    inner = posed.inner.copy()
    inner[posed.root] = False
    joints = np.flatnonzero(inner if inner.any() else posed.inner)
    alone = np.sqrt(posed.affinity[bone, joints])
    alone = np.maximum(alone, LEAST * alone.max()) if alone.max() > 0 else np.ones(len(joints))
    of_parts = np.zeros(len(inner))
    for part, follows in enumerate(posed.training.parts.affinity[:, bone]):
        if follows > 0:
            mine = posed.key_joints(part)
            heavy = joint_weights(posed, part, mine)
            of_parts[mine] += follows * heavy / heavy.sum()
    weights = alone / alone.sum() + of_parts[joints]
    some = weights > 0
    return joints[some], weights[some]


def left_out(
    told: Told, more: Told | None, rows: np.ndarray, tried: list[tuple[float, float]], ridge: float
) -> np.ndarray:
    """(S, R, B, 12) every bone in the frames ``rows`` as the other clips predict it, by settings (width, dynamics)."""
    made = np.empty((len(tried), len(rows), *told.numbers.shape[1:]))
    both = [told] if more is None else [told, more]
    clip = np.tile(told.clip[rows], len(both))
    for bone in range(told.numbers.shape[1]):
        pose, shaken = (np.concatenate([part(t, bone)[rows] for t in both]) for part in (Told.pose, Told.shaken))
        y = np.concatenate([t.numbers[rows, bone] for t in both])
        pose, shaken = (kernel.squared_distances(x, x) for x in (pose, shaken))
        for i, (width, dynamics) in enumerate(tried):
            apart = pose + dynamics**2 * shaken
            inside = apart[: len(rows), : len(rows)]
            unit = float(np.median(inside[inside > 0])) if (inside > 0).any() else 1.0
            gram = kernel.matern(apart / (unit * width**2)) + ridge * np.eye(len(apart))
            made[i, :, bone] = (y - kernel.left_out(kernel.inverted(gram), y, clip, centred=True))[: len(rows)]
    return made
