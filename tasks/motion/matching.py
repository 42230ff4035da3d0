"""Partwise motion matching: poses of the inner skeleton in, transforms of the free-form bones out."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import numpy as np

from tasks.errors import InputError
from tasks.geometry import rigid
from tasks.motion.blending import Sources, blend, gather, strongest
from tasks.motion.posed import Posed, relative
from tasks.motion.projection import project
from tasks.motion.query import check_poses
from tasks.motion.search import nearest_windows
from tasks.values import Poses, Training


@dataclass(frozen=True)
class Matched:
    """bones: (F, B, 3, 4) on canonical points; sources: (F, P, k) int32; distance: (F, P) mean angle in radians."""

    bones: np.ndarray
    sources: np.ndarray
    distance: np.ndarray


def match(
    training: Training,
    query: Poses,
    *,
    k: int,
    patch: int,
    levels: int,
    lambda_: float,
    temperature: float,
    represent: Literal["root", "part", "residual"],
    align: bool,
    dynamics: float,
) -> Matched:
    """Bones for the query poses, matched and blended part by part (GaussiAnimate 3.3, eq. 7-10, alg. 1).

    For the settings see :func:`tasks.methods.partmm.animate`. Raises InputError as that does.
    """
    _check(k, patch, levels, lambda_, temperature, represent, align, dynamics)
    check_poses(query, training.skeleton, "query")
    known = Posed(training, training.database.poses)
    longest = int(np.diff(known.poses.clip_start).max())
    if longest < patch:
        expected = f"at most the {longest} frames of the longest training clip"
        raise InputError("animate.patch", expected=expected, found=str(patch))
    values = known.encode(training.database.bones, represent)
    done = []
    for a, b in pairwise(query.clip_start):
        clip = Posed(training, _padded(query, int(a), int(b), patch))
        frames = len(clip.world)
        strides = _strides(min(frames, longest), patch, levels)
        bones = np.zeros((frames, *values.shape[1:]))
        sources, distance = [], []
        for p in range(len(training.parts.names)):
            found = nearest_windows(clip.keys(p, dynamics), known.keys(p, dynamics), k=k, patch=patch, strides=strides)
            row = gather(found, strides, patch=patch, lambda_=lambda_, temperature=temperature)
            _add_part(bones, p, row, values, clip, known, (represent, align))
            sources.append(strongest(row, k))
            distance.append(_per_frame(found.distance[-1, :, 0], frames, patch))
        bones = clip.decode(rigid.make(project(bones[..., :3]), bones[..., 3]), represent)
        done.append([x[: int(b - a)] for x in (bones, np.stack(sources, 1), np.stack(distance, 1))])
    bones, sources, distance = (np.concatenate(x) for x in zip(*done, strict=True))
    return Matched(bones.astype(np.float32), sources, distance.astype(np.float32))


def _add_part(
    bones: np.ndarray, part: int, row: Sources, values: np.ndarray, query: Posed, known: Posed, way: tuple[str, bool]
) -> None:
    """Adds one part's blend to the bones that follow it, (F, B, 3, 4) in place, weighted by affinity."""
    represent, align = way
    affinity = query.training.parts.affinity[part]
    follows = np.flatnonzero(affinity > 0)
    mine = relative(values[:, follows], known.part_frame(part, represent))
    mixed = blend(row, mine, query.part_motion(part, represent), known.part_motion(part, represent), align=align)
    mixed = rigid.compose(query.part_frame(part, represent)[:, None], mixed)
    bones[:, follows] += affinity[follows, None, None] * mixed


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


def _padded(query: Poses, a: int, b: int, patch: int) -> Poses:
    """One clip; shorter ones than a patch hold their last pose."""
    index = np.minimum(np.arange(a, max(b, a + patch)), b - 1)
    return Poses(query.rotations[index], query.translations[index], np.array([0, len(index)], np.int64))


def _check(k, patch, levels, lambda_, temperature, represent, align, dynamics) -> None:
    for name, value, good, expected in (
        ("k", k, k >= 1, "1 or more"),
        ("patch", patch, patch >= 1, "1 or more frames"),
        ("levels", levels, levels >= 1, "1 or more"),
        ("lambda", lambda_, 0 < lambda_ <= 1, "a number in (0, 1]"),
        ("temperature", temperature, temperature > 0, "a positive number"),
        ("dynamics", dynamics, dynamics >= 0, "0 (off) or a positive weight"),
        ("represent", represent, represent in ("root", "part", "residual"), "root, part or residual"),
    ):
        if not good:
            raise InputError(f"animate.{name}", expected=expected, found=str(value))
    if align and represent == "residual":
        raise InputError(
            "animate.align",
            expected="false with represent=residual (a residual is already seen from the posed skeleton)",
            found="true",
        )
