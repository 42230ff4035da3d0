"""Partwise motion matching: poses of the inner skeleton in, transforms of the free-form bones out."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal

import numpy as np

from tasks.errors import InputError
from tasks.geometry import rigid
from tasks.motion.affine import Space, describe, nearest_moments, space
from tasks.motion.blending import PartMotion, Sources, blend, gather, strongest
from tasks.motion.mirror import with_image
from tasks.motion.posed import Posed
from tasks.motion.projection import project
from tasks.motion.query import check_poses
from tasks.motion.regression import bone_radii, from_numbers, joint_weights, to_numbers
from tasks.motion.search import nearest_windows
from tasks.values import Poses, Training


@dataclass(frozen=True)
class Way:
    """How to match, as :func:`tasks.methods.partmm.animate` explains it."""

    k: int
    patch: int
    levels: int
    lambda_: float
    temperature: float
    represent: Literal["root", "part", "residual"]
    align: bool
    dynamics: float
    shrink: bool
    mirror: bool
    sources: int
    every: int


@dataclass(frozen=True)
class Matched:
    """bones: (F, B, 3, 4) on canonical points; sources: (F, P, k) int32; distance: (F, P) mean angle in radians;
    variance: (F, P) of what each part's sources predict, 1 is to know nothing (zeros for a softmax)."""

    bones: np.ndarray
    sources: np.ndarray
    distance: np.ndarray
    variance: np.ndarray


@dataclass(frozen=True)
class PartStore:
    """What a part's blend takes from the database. follows: (M,) its bones; affinity: (M,) how much they follow;
    values: (F, B or M, 3, 4) in the part's frame, of which it takes ``which``: (M,); motion: its joints in the training
    frames, where sources are aligned; heavy: (J,) what its joints say of its bones; space: where poses are compared for
    their shares, or None for a softmax."""

    follows: np.ndarray
    affinity: np.ndarray
    values: np.ndarray
    which: np.ndarray
    motion: PartMotion | None
    heavy: np.ndarray
    space: Space | None


@dataclass(frozen=True)
class Prepared:
    """A database ready to be matched. known: the training poses, and after them their mirror image where wanted;
    parts: one store each; frames: those that are no images; keep: (B,) share of the matched residuals to believe, or
    None for all of it."""

    known: Posed
    way: Way
    parts: tuple[PartStore, ...]
    frames: int
    keep: np.ndarray | None = None


def prepare(training: Training, way: Way) -> Prepared:
    """The database as queries need it. Raises InputError where every training clip is shorter than a patch."""
    frames = len(training.database.bones)
    if way.mirror:
        training = with_image(training)
    known = Posed(training, training.database.poses)
    longest = int(np.diff(known.poses.clip_start).max())
    if longest < way.patch:
        expected = f"at most the {longest} frames of the longest training clip"
        raise InputError("animate.patch", expected=expected, found=str(way.patch))
    values = known.encode(training.database.bones, way.represent)
    align = way.align and way.represent != "residual"
    parts = []
    for part, affinity in enumerate(training.parts.affinity):
        follows = np.flatnonzero(affinity > 0)
        own = way.represent == "part"
        mine = known.to_part(values[:, follows], part, way.represent) if own else values
        which = np.arange(len(follows)) if own else follows
        heavy = joint_weights(known, part, known.key_joints(part))
        told = space(known.keys(part, way.dynamics), heavy, way.every) if way.sources else None
        moving = known.part_motion(part, way.represent) if align else None
        parts.append(PartStore(follows, affinity[follows], mine, which, moving, heavy, told))
    ready = Prepared(known, way, tuple(parts), frames)
    return replace(ready, keep=_reliability(ready, values)) if way.shrink else ready


def match(training: Training, query: Poses, way: Way) -> Matched:
    """Bones for the query poses, matched and blended part by part (GaussiAnimate 3.3, eq. 7-10, alg. 1).

    Raises InputError for poses of another skeleton, matrices that are no rotations and training clips too short.
    """
    check_poses(query, training.skeleton, "query")
    return match_prepared(prepare(training, way), query)


def match_prepared(ready: Prepared, query: Poses, *, left_out: bool = False) -> Matched:
    """The same with a database that is ready, for poses that were checked. left_out: the query are the training clips,
    each to be matched with the others."""
    done, way = [], ready.way
    for clip in range(len(query.clip_start) - 1):
        asked = Posed(ready.known.training, one_clip(query, clip, way.patch), ready.known)
        frames, *more = _match_clip(asked, ready, skip=of_clip(ready, clip) if left_out else ())
        length = int(query.clip_start[clip + 1] - query.clip_start[clip])
        done.append([x[:length] for x in (asked.decode(believed(ready, frames), way.represent), *more)])
    bones, sources, distance, variance = (np.concatenate(x) for x in zip(*done, strict=True))
    sources %= ready.frames  # an image counts as the frame that it is the image of
    return Matched(bones.astype(np.float32), sources, distance.astype(np.float32), variance)


def of_clip(ready: Prepared, clip: int) -> tuple[int, ...]:
    """A training clip and its image among the clips that are matched."""
    start = ready.known.poses.clip_start
    return tuple(range(clip, len(start) - 1, int(np.searchsorted(start, ready.frames))))


def _match_clip(asked: Posed, ready: Prepared, skip: tuple[int, ...] = ()) -> list[np.ndarray]:
    """One clip: frames of bones (F, B, 3, 4), sources (F, P, k), distance and variance (F, P). skip: clips left out."""
    frames, way, known = len(asked.world), ready.way, ready.known
    lengths = np.delete(np.diff(known.poses.clip_start), list(skip))
    strides = _strides(min(frames, int(lengths.max())), way.patch, way.levels)
    rows, distance = [], []
    for part in range(len(ready.parts)):
        keys = asked.keys(part, way.dynamics), known.keys(part, way.dynamics)
        found = nearest_windows(*keys, k=way.k, patch=way.patch, strides=strides, skip=skip)
        if way.sources:
            moments = ready.parts[part].space
            if skip:
                start = known.poses.clip_start
                moments = moments.without(np.concatenate([np.arange(start[c], start[c + 1]) for c in skip]))
            rows.append(nearest_moments(describe(keys[0], moments), moments, way.sources))
        else:
            rows.append(gather(found, strides, patch=way.patch, lambda_=way.lambda_, temperature=way.temperature))
        distance.append(_per_frame(found.distance[-1, :, 0], frames, way.patch))
    sources = np.stack([strongest(row, way.k) for row in rows], 1)
    variance = np.stack([np.zeros(frames) if row.variance is None else row.variance for row in rows], 1)
    return [merged(asked, ready, rows), sources, np.stack(distance, 1), variance]


def merged(asked: Posed, ready: Prepared, rows: list[Sources]) -> np.ndarray:
    """Every part's blend of its sources, (F, B, 3, 4): parts averaged by affinity, projected to rigid frames once."""
    represent = ready.way.represent
    bones = np.zeros((len(asked.world), len(asked.centres), 3, 4))
    for part, (row, store) in enumerate(zip(rows, ready.parts, strict=True)):
        moving = None if store.motion is None else asked.part_motion(part, represent)
        mixed = blend(row, store.values, store.which, moving, store.motion)
        placed = asked.from_part(mixed, part, represent)
        bones[:, store.follows] += store.affinity[:, None, None] * placed
    return rigid.make(project(bones[..., :3]), bones[..., 3])


def believed(ready: Prepared, frames: np.ndarray) -> np.ndarray:
    """Residual frames of bones shrunk to what proved right."""
    return frames if ready.keep is None else from_numbers(to_numbers(frames) * ready.keep[:, None])


def _reliability(ready: Prepared, values: np.ndarray) -> np.ndarray:
    """How much of a bone's matched residual to believe, (B,) in [0, 1].

    Every training clip is matched against the others; the share is what brings the matched residuals closest to the
    true ones in the least-squares sense. One clip alone, or clips too short to be matched, leave it at one.
    """
    training, patch = ready.known.training, ready.way.patch
    poses = training.database.poses
    lengths = np.diff(poses.clip_start)
    radius = bone_radii(training.skinning.rest, training.skinning.weights)
    unit = np.repeat([radius, np.ones_like(radius)], 3, axis=0).T
    agree, size = np.zeros(len(unit)), np.zeros(len(unit))
    real = int(np.searchsorted(poses.clip_start, ready.frames))  # clips; their images follow in the same order
    for clip, (a, b) in enumerate(pairwise(poses.clip_start[: real + 1])):
        out = of_clip(ready, clip)
        if real < 2 or np.delete(lengths, out).max() < patch:
            continue
        asked = Posed(training, one_clip(poses, clip, patch), ready.known)
        made = to_numbers(_match_clip(asked, ready, skip=out)[0])[: b - a] * unit
        agree += (made * to_numbers(values[a:b]) * unit).sum((0, 2))
        size += (made**2).sum((0, 2))
    return np.where(size > 0, np.clip(agree / np.maximum(size, 1e-30), 0.0, 1.0), 1.0)


def _per_frame(distance: np.ndarray, frames: int, patch: int) -> np.ndarray:
    """Distance of each frame's best window: (T windows) -> (T frames)."""
    best = np.full(frames, np.inf)
    for i in range(patch):
        np.minimum(best[i : i + len(distance)], distance, out=best[i : i + len(distance)])
    return best


def _strides(frames: int, patch: int, levels: int) -> list[int]:
    """Strides of the pyramid, coarsest first: as many levels as let every frame lie in some window."""
    count = min(levels, 1 + int(np.floor(np.log2(max(frames / patch, 1)))))
    return [2**level for level in range(count - 1, -1, -1)]


def one_clip(poses: Poses, clip: int, patch: int) -> Poses:
    """One clip; shorter ones than a patch hold their last pose."""
    a, b = int(poses.clip_start[clip]), int(poses.clip_start[clip + 1])
    index = np.minimum(np.arange(a, max(b, a + patch)), b - 1)
    return Poses(poses.rotations[index], poses.translations[index], np.array([0, len(index)], np.int64))
