"""How fast matching answers: pose by pose, a whole clip, in ever larger databases; and whether it finds the nearest.

A judge that stands above the stages: unlike a stage it may import several of them.
"""

from __future__ import annotations

import statistics
import time
from dataclasses import replace
from typing import Annotated

import numpy as np

from tasks.benchmarks.cost import Cost, measure, threads_held
from tasks.errors import InputError
from tasks.evaluation.metrics import declared
from tasks.geometry.rotations import from_quaternion, from_rotation_vector, geodesic
from tasks.geometry.skinning import skin
from tasks.motion.database import build_database
from tasks.motion.matching import Way, match_prepared, prepare
from tasks.motion.online import Online, WindowSearch
from tasks.motion.posed import Posed
from tasks.motion.search import Keys
from tasks.values import Metrics, Poses, Training

BUILD_FRAMES = 10_000
SPREAD = 0.15  # radians by which copies of the training clips differ, joint by joint
RECALL = 7


def benchmark_matching(
    training: Training,
    query: Poses,
    *,
    matching: dict,
    vertices: Annotated[int, "[1, inf)"],
    frames: Annotated[int, "[1, inf)"],
    patches: Annotated[list[Annotated[int, "[7, inf)"]], "patches: at least one size"],
    recall_queries: Annotated[int, "[1, inf)"],
    repeats: Annotated[int, "[1, inf)"],
    threads: Annotated[int, "[0, inf)"],
    seed: int,
) -> Metrics:
    """Matching of the unseen poses against the first ``frames`` training frames, timed.

    matching: the settings of the method; vertices: to be posed, those of the data repeated; patches: sizes of larger
    databases, made of turned copies of the training clips; recall_queries: windows that are also searched for by brute
    force in float64; repeats: runs whose median is taken; threads: 0 for all cores.
    fps and p99_ms: one pose after another, no look-ahead, to posed points; clip_fps: all unseen clips at once;
    query_ms: one new pose, all parts, distances of the poses before it kept (by patches: "query_ms@100000");
    recall_at_7: share of the 7 truly nearest windows that are found, over all sizes; build_seconds and memory: of a
    database of 10,000 frames.
    Raises InputError for fewer frames than two patches.
    """
    way = Way(**matching)
    if frames < 2 * way.patch:
        raise InputError("benchmark.frames", expected="at least two patches", found=str(frames))
    training = _of_size(training, vertices, frames)
    with threads_held(threads):
        found = _pose_by_pose(training, query, way, repeats) | _whole_clips(training, query, way, repeats)
        found |= _growth(training, query, way, patches, recall_queries, seed)
        cost = _build(training, way, seed)
    found |= {"build_seconds": cost.seconds, "points_count": float(vertices), "frames_count": float(frames)}
    found |= {} if cost.memory is None else {"memory": cost.memory}
    return declared(found, training.motion.unit)


def _of_size(training: Training, vertices: int, frames: int) -> Training:
    """The first frames, and as many points as wanted."""
    motion, skinning, skeleton = training.motion, training.skinning, training.skeleton
    index = np.arange(vertices) % len(skinning.rest)
    frames = min(frames, motion.frames)
    runs = [slice(c.start, min(c.stop, frames)) for c in motion.clips() if c.start < frames]
    first = motion.take_frames(runs, list(motion.clip_names[: len(runs)]))
    first = replace(first, points=first.points[:, index], faces=None, rest=None, rig=None)
    rest, weights = skinning.rest[index], skinning.weights[index]
    known = training.database.poses
    poses = Poses(known.rotations[:frames], known.translations[:frames], first.clip_start)
    bones = replace(skinning, rest=rest, weights=weights, transforms=training.database.bones[:frames])
    return replace(
        training,
        motion=first,
        canonical=replace(training.canonical, points=rest, faces=None),
        skinning=bones,
        skeleton=replace(skeleton, weights=skeleton.weights[index]),
        database=build_database(first, bones, poses),
    )


def _pose_by_pose(training: Training, query: Poses, way: Way, repeats: int) -> dict[str, float]:
    online = Online(prepare(training, way))
    seconds: list[float] = []
    for repeat in range(repeats + 1):  # the first run compiles
        for a, b in zip(query.clip_start[:-1], query.clip_start[1:], strict=True):
            online.restart()
            for f in range(a, b):
                start = time.perf_counter()
                online.pose(query.rotations[f], query.translations[f])
                if repeat:
                    seconds.append(time.perf_counter() - start)
    return {"fps": len(seconds) / sum(seconds), "p99_ms": 1e3 * float(np.percentile(seconds, 99))}


def _whole_clips(training: Training, query: Poses, way: Way, repeats: int) -> dict[str, float]:
    ready = prepare(training, way)

    def work() -> np.ndarray:
        return skin(training.skinning.rest, training.skinning.weights, match_prepared(ready, query).bones)

    work()
    return {"clip_fps": len(query.rotations) / statistics.median(measure(work)[1].seconds for _ in range(repeats))}


def _growth(
    training: Training, query: Poses, way: Way, patches: list[int], recall_queries: int, seed: int
) -> dict[str, float]:
    """Time of a query by the size of the database, and what share of the truly nearest windows it finds."""
    asked = Posed(training, query)
    found: dict[str, float] = {}
    shares = []
    checked = np.linspace(way.patch - 1, len(query.rotations) - 1, recall_queries).round().astype(int)
    for size in sorted(patches):
        poses = _copies(training.database.poses, size, way.patch, seed)
        database = Posed(training, poses)
        parts = range(len(training.parts.names))
        keys = [asked.keys(part, way.dynamics) for part in parts]
        stores = [database.keys(part, way.dynamics) for part in parts]
        searches = [WindowSearch(store, k=RECALL, patch=way.patch) for store in stores]
        seconds = []
        for f in range(len(query.rotations)):
            start = time.perf_counter()
            nearest = [s.push(k.rotations[f], k.extra[f])[1] for s, k in zip(searches, keys, strict=True)]
            seconds.append(time.perf_counter() - start)
            if f in checked:
                last = [max(f - i, 0) for i in range(way.patch - 1, -1, -1)]
                shares += [
                    _share(nearest[p], _true_distances(keys[p], last, stores[p]) / way.patch, way.patch) for p in parts
                ]
        found[f"query_ms@{size}"] = 1e3 * statistics.median(seconds)
    return {"query_ms": found[f"query_ms@{max(patches)}"], **found, "recall_at_7": float(np.mean(shares))}


def _share(found: np.ndarray, distance: np.ndarray, patch: int) -> float:
    """Share of the windows found that are among the nearest by the true distances; windows that are as near to within
    rounding count as equals."""
    bound = np.partition(distance, RECALL - 1)[RECALL - 1]
    return float(np.mean(distance[found - (patch - 1)] <= bound * (1 + 1e-5) + 1e-7))


def _true_distances(query: Keys, last: list[int], database: Keys) -> np.ndarray:
    """Distances of all windows to the one of the frames ``last``, by rotation matrices in float64; windows that cross a
    clip's end are infinitely far."""
    frames, patch = len(database.rotations), len(last)
    turns = from_quaternion(database.rotations.astype(np.float64))
    total = np.zeros(frames - patch + 1)
    for i, f in enumerate(last):
        angle = geodesic(turns, from_quaternion(query.rotations[f].astype(np.float64))).sum(1)
        far = np.linalg.norm(database.extra.astype(np.float64) - query.extra[f], axis=2).sum(1) * query.scale
        total += (angle + far)[i : i + len(total)]
    clip = np.searchsorted(database.clip_start, np.arange(frames), side="right")
    total[clip[: len(total)] != clip[patch - 1 :]] = np.inf
    return total / query.scale


def _copies(poses: Poses, patches: int, patch: int, seed: int) -> Poses:
    """Training clips over and over until they hold so many windows, each copy turned a little, joint by joint."""
    rng = np.random.default_rng(seed)
    turned, moved, lengths, count = [], [], [], 0
    clips = list(zip(poses.clip_start[:-1], poses.clip_start[1:], strict=True))
    while count < patches:
        a, b = clips[len(lengths) % len(clips)]
        b = min(int(b), int(a) + patches - count + patch - 1)
        turn = from_rotation_vector(rng.normal(0, SPREAD, (poses.rotations.shape[1], 3)))
        first = len(lengths) < len(clips)
        turned.append(poses.rotations[a:b] @ (np.eye(3) if first else turn).astype(np.float32))
        moved.append(poses.translations[a:b])
        lengths.append(b - int(a))
        count += max(b - int(a) - patch + 1, 0)
    return Poses(np.concatenate(turned), np.concatenate(moved), np.concatenate([[0], np.cumsum(lengths)]))


def _build(training: Training, way: Way, seed: int) -> Cost:
    """Cost of making a database of many frames ready to be matched; its first frames are the training's own."""
    poses = _copies(training.database.poses, BUILD_FRAMES, 1, seed)
    index = np.arange(len(poses.rotations)) % training.motion.frames
    names = tuple(f"clip {c}" for c in range(len(poses.clip_start) - 1))
    points = np.zeros((len(index), 1, 3), np.float32)  # the database does not look at them
    motion = replace(training.motion, points=points, clip_start=poses.clip_start, clip_names=names)
    bones = replace(training.skinning, transforms=training.database.bones[index])

    def work() -> object:
        larger = replace(training, motion=motion, skinning=bones, database=build_database(motion, bones, poses))
        ready = prepare(larger, replace(way, shrink=False))
        for part in range(len(training.parts.names)):
            _ = ready.known.keys(part, way.dynamics).columns
        return ready

    work()
    return measure(work)[1]
