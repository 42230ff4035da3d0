"""How the cost of our bones grows with points and with frames.

A judge that stands above the stages: unlike a stage it may import several of them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Annotated

import igl
import numpy as np

from tasks.benchmarks.cost import Cost, measure, median, threads_held
from tasks.bones.clustering import cluster
from tasks.bones.ssdr import ssdr
from tasks.drawing import plot
from tasks.errors import InputError
from tasks.evaluation.metrics import declared
from tasks.values import Canonical, Metrics, Motion, Picture

Timed = list[tuple[int, int, Cost]]  # points, frames, cost


def scale_bones(
    motion: Motion,
    canonical: Canonical,
    *,
    clustering: dict,
    decomposition: dict,
    subdivisions: Annotated[int, "[1, 5]"],
    shares: Annotated[list[Annotated[float, "(0, 1]"]], "len(set(shares)) > 1: two or more"],
    repeats: Annotated[int, "[1, inf)"],
    threads: Annotated[int, "[0, inf)"],
) -> tuple[Metrics, Picture]:
    """Cost of clusters and decomposition on ever finer meshes of a motion, and on ever longer pieces of it.

    clustering, decomposition: the settings of :func:`cluster` and :func:`ssdr`; subdivisions: how often every triangle
    is cut in four; shares: of the frames, from the first on; repeats: runs whose median is taken; threads: 0 for all
    cores. An exponent is the slope of the logarithm of processor time: 1 is linear. Seconds and memory are those of the
    finest mesh. Raises InputError for bare points.
    """
    if motion.faces is None:
        raise InputError("Motion.faces", expected="triangles, which are made finer", found="bare points")

    def time(data: Motion, shape: Canonical) -> tuple[int, int, Cost]:
        def work() -> object:
            return ssdr(data, shape, cluster(data, shape, **clustering), **decomposition)

        return data.points.shape[1], data.frames, median([measure(work)[1] for _ in range(repeats)])

    with threads_held(threads):
        time(motion, canonical)  # compiles
        longer = [time(_first(motion, share), canonical) for share in sorted(shares)]
        finer = _finer(motion, canonical, subdivisions, time)
    points, frames, largest = finer[-1]
    found = {
        "points_exponent": _exponent(finer, lambda n, f: n),
        "frames_exponent": _exponent(longer, lambda n, f: f),
        "points_count": float(points),
        "frames_count": float(frames),
        "seconds": largest.seconds,
    } | ({} if largest.memory is None else {"memory": largest.memory})
    for n, f, cost in dict.fromkeys([*longer, *finer]):
        found[f"cpu_seconds@{n}x{f}"] = cost.cpu
    return declared(found, motion.unit), _picture(motion.name, finer, longer)


def subdivided(motion: Motion, canonical: Canonical) -> tuple[Motion, Canonical]:
    """Every triangle cut in four at the middles of its edges; middles move with their edges."""
    faces = igl.upsample(canonical.points.astype(np.float64), motion.faces.astype(np.int64))[1].astype(np.int32)

    def finer(points: np.ndarray) -> np.ndarray:
        return igl.upsample(points.astype(np.float64), motion.faces.astype(np.int64))[0].astype(np.float32)

    points = np.stack([finer(frame) for frame in motion.points])
    fine = replace(motion, points=points, faces=faces, rest=None, rig=None)
    return fine, replace(canonical, points=finer(canonical.points), faces=faces)


def _finer(motion: Motion, canonical: Canonical, subdivisions: int, time: Callable) -> Timed:
    found = [time(motion, canonical)]
    for _ in range(subdivisions):
        motion, canonical = subdivided(motion, canonical)
        found.append(time(motion, canonical))
    return found


def _first(motion: Motion, share: float) -> Motion:
    """The first frames of a motion as one clip."""
    return motion.take_frames([slice(0, max(round(share * motion.frames), 2))], ["first"])


def _exponent(timed: Timed, size: Callable[[int, int], int]) -> float:
    """Slope of log processor time against log size."""
    x = np.log([size(n, f) for n, f, _ in timed])
    return float(np.polyfit(x, np.log([cost.cpu for _, _, cost in timed]), 1)[0])


def _picture(name: str, finer: Timed, longer: Timed) -> Picture:
    series = []
    for label, timed in (("more points", finer), ("more frames", longer)):
        size = np.array([n * f / 1e6 for n, f, _ in timed])
        series.append(plot.Series(label, size, np.array([cost.cpu for _, _, cost in timed])))
    drawing = plot.lines(series, x="points × frames [millions]", y="processor time [s]", log_x=True, log_y=True)
    return Picture("scale", f"{name}: cost of the bones against points and frames", None, drawing)
