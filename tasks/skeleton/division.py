"""Bones of two segments cut in two: an ear that folds in few frames is one bone to an error over all of them."""

from __future__ import annotations

import numpy as np

from tasks.geometry import rigid
from tasks.geometry.moments import fit_rigid, skin_moments
from tasks.geometry.skinning import skin
from tasks.skeleton.inner_bones import SMALLEST, Bones, relative_turn

_PEAK = 98.0  # percentile over the frames: few of them may show the fold
_MISSED = 1.0  # degrees by which a bone's points must miss at the peak to be looked at
_POINTS, _HALF = 12, 4  # least points of a bone that is cut, and of its halves
_GAIN = 0.55  # of the error at the peak: what two halves may leave
_APART = 1.2  # of the bone's RMS extent: distance of the halves' middles; a tube cut lengthwise has less
_ROUNDS = 5  # of SSDR before a cut is judged
_SETTLED = 10  # rounds of sharing points out between two halves


def divide(bones: Bones, size: float, *, angle: float, at_most: int, rounds: int) -> Bones:
    """Cuts the bone whose points miss most at the peak of the motion, over their extent, in two that move as rigid
    pieces; again and again, as long as the halves turn more than ``angle`` degrees apart, lie one behind the other and
    leave little of the error, up to ``at_most`` bones. size: the shape's diagonal; rounds: of SSDR after every cut that
    stays, before what is left is looked at."""
    refused: set[int] = set()  # by the first of a bone's points
    while bones.count < at_most:
        owner = bones.weights.argmax(axis=1)
        missed = peak_angles(bones, size)
        worst = [int(b) for b in np.argsort(-missed) if missed[b] >= np.radians(_MISSED)]
        bone = next((b for b in worst if int(np.argmax(owner == b)) not in refused), None)
        if bone is None:
            return bones
        points = np.flatnonzero(owner == bone)
        cut = _cut(bones, bone, points, np.radians(angle))
        if cut is not None and _sound(bones, cut, bone, points):
            bones = cut.improve(rounds)
        else:
            refused.add(int(points[0]))
    return bones


def peak_angles(bones: Bones, size: float) -> np.ndarray:
    """(B,) RMS distance in radians of extent by which a bone's own points miss at the peak; zero for few points."""
    squared, owner = _squared(bones, np.arange(len(bones.rest))), bones.weights.argmax(axis=1)
    out = np.zeros(bones.count)
    for b in range(bones.count):
        own = np.flatnonzero(owner == b)
        if len(own) >= _POINTS:
            out[b] = np.sqrt(_peak(squared[:, own])) / max(_extent(bones.rest[own]), SMALLEST * size)
    return out


def _cut(bones: Bones, bone: int, points: np.ndarray, angle: float) -> Bones | None:
    """One bone more, its points shared out between both halves; None where one gets next to none, they turn less than
    ``angle`` radians apart or do not lie one behind the other."""
    rest = bones.rest[points]
    half, pair = _halves(bones, bone, points)
    if min(half.sum(), (~half).sum()) < _HALF or relative_turn(pair)[0, 1] <= angle:
        return None
    if np.linalg.norm(rest[half].mean(axis=0) - rest[~half].mean(axis=0)) <= _APART * _extent(rest):
        return None
    transforms = np.concatenate([bones.transforms, pair[:, 1:]], axis=1)
    transforms[:, bone] = pair[:, 0]
    weights = np.concatenate([bones.weights, np.zeros((len(bones.rest), 1), bones.weights.dtype)], axis=1)
    weights[points[half], -1], weights[points[half], bone] = weights[points[half], bone], 0.0
    return bones.refit(transforms, weights).improve(_ROUNDS)


def _halves(bones: Bones, bone: int, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(K,) whether a point of the bone is in the second half, and the rigid motion of both (F, 2, 3, 4): two means,
    begun on both sides of the median of the points' main motion within the bone."""
    paths, rest = bones.paths[:, points].astype(np.float64), bones.rest[points]
    turn, shift = bones.transforms[:, bone, :, :3], bones.transforms[:, bone, :, 3]
    within = (np.einsum("fji,fnj->nfi", turn, paths - shift[:, None]) - rest[:, None]).reshape(len(points), -1)
    score = np.linalg.svd(within - within.mean(axis=0), full_matrices=False)[0][:, 0]
    half, pair = score > np.median(score), rigid.identity(len(paths), 2, dtype=np.float64)
    for _ in range(_SETTLED):
        member = np.stack([~half, half], axis=1).astype(np.float32)
        pair = fit_rigid(skin_moments(rest, member, bones.paths[:, points]), pair, 1)
        errors = [np.sum((rigid.apply(pair[:, k, None], rest) - paths) ** 2, axis=(0, 2)) for k in (0, 1)]
        nearer = errors[1] < errors[0]
        if (nearer == half).all() or min(nearer.sum(), (~nearer).sum()) < _HALF:
            break
        half = nearer
    return half, pair


def _sound(bones: Bones, cut: Bones, bone: int, points: np.ndarray) -> bool:
    owned = np.bincount(cut.weights.argmax(axis=1), minlength=cut.count)[[bone, -1]]
    left, before = (np.sqrt(_peak(_squared(b, points))) for b in (cut, bones))
    return bool(owned.min() >= _HALF and left < _GAIN * before)


def _squared(bones: Bones, points: np.ndarray) -> np.ndarray:
    """(F, K) squared distances of some points from where the bones put them."""
    made = skin(bones.rest[points], bones.weights[points], bones.transforms)
    return np.sum((made.astype(np.float64) - bones.paths[:, points]) ** 2, axis=2)


def _peak(squared: np.ndarray) -> float:
    return float(np.percentile(squared.mean(axis=1), _PEAK))


def _extent(points: np.ndarray) -> float:
    return float(np.sqrt(((points - points.mean(axis=0)) ** 2).sum(axis=1).mean()))
