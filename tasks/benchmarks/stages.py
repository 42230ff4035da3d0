"""What every stage that needs no training costs on a dense mesh, one after the other in one process.

A judge that stands above the stages: unlike a stage it may import all of them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated

from tasks.benchmarks.cost import Cost, in_use, measure, median, threads_held
from tasks.benchmarks.scale import subdivided
from tasks.bones.clustering import cluster
from tasks.bones.ssdr import ssdr
from tasks.errors import InputError
from tasks.evaluation.metrics import declared
from tasks.methods import partmm
from tasks.motion.database import build_database
from tasks.motion.parts import find_parts
from tasks.skeleton.curve import curve_skeleton
from tasks.skeleton.joints_motion import joints_by_motion
from tasks.skeleton.poses import fit_poses
from tasks.skeleton.surface import closed_surface
from tasks.values import Canonical, Metrics, Motion, Training


def benchmark_stages(
    train: Motion,
    test: Motion,
    canonical: Canonical,
    *,
    clustering: dict,
    decomposition: dict,
    closing: dict,
    tracing: dict,
    jointing: dict,
    posing: dict,
    parting: dict,
    matching: dict,
    subdivisions: Annotated[int, "[0, 5]"],
    repeats: Annotated[int, "[1, inf)"],
    threads: Annotated[int, "[0, inf)"],
) -> Metrics:
    """Seconds and memory of all stages from clusters to PartMM on the unseen clips, and of each.

    clustering, decomposition, closing, tracing, jointing, posing, parting, matching: the settings of the stages in
    their order; subdivisions: how often every triangle is cut in four first; repeats: runs whose median is taken, after
    one on the mesh as it comes, which compiles; threads: 0 for all cores. ``memory`` is the most that was in use on top
    of what the process used before it had the fine mesh. Raises InputError for bare points.
    """
    _check(train)
    settings = {
        "clusters": clustering,
        "bones": decomposition,
        "surface": closing,
        "curve": tracing,
        "skeleton": jointing,
        "poses": posing,
        "parts": parting,
        "PartMM": matching,
    }
    with threads_held(threads):
        _run(train, test, canonical, settings, in_use())  # compiles
        start = in_use()
        (fine, shape), (unseen, _) = finer(train, canonical, subdivisions), finer(test, canonical, subdivisions)
        runs = [_run(fine, unseen, shape, settings, start) for _ in range(repeats)]
    costs = {name: median([costs[name] for costs in runs]) for name in runs[0]}
    counts = {
        "points_count": float(len(shape.points)),
        "frames_count": float(fine.frames),
        "bones_count": float(clustering["max_bones"]),
    }
    return declared(counts | _numbers(costs), train.unit)


def _run(
    seen: Motion, unseen: Motion, shape: Canonical, settings: dict[str, dict], start: float | None
) -> dict[str, Cost]:
    """Stage -> its cost, all run once, in their order; memory is what is in use at the peak on top of `start` (MB)."""
    costs: dict[str, Cost] = {}

    def timed(name: str, work: Callable[..., object], *inputs: object, of: str | None = None) -> object:
        before = in_use()
        result, cost = measure(lambda: work(*inputs, **settings.get(of or name, {})))
        top = None if before is None or cost.memory is None else before + cost.memory - start
        costs[name] = Cost(cost.seconds, cost.cpu, top)
        return result

    clusters = timed("clusters", cluster, seen, shape)
    bones = timed("bones", ssdr, seen, shape, clusters)
    surface = timed("surface", closed_surface, shape)
    curve = timed("curve", curve_skeleton, surface)
    skeleton = timed("skeleton", joints_by_motion, seen, shape, bones, surface, curve)
    poses = timed("poses", fit_poses, seen, shape, skeleton)
    query = timed("poses, unseen", fit_poses, unseen, shape, skeleton, of="poses")
    parts = timed("parts", find_parts, skeleton, bones)
    database = timed("database", build_database, seen, bones, poses)
    timed("PartMM", partmm.animate, Training(seen, shape, bones, skeleton, database, parts), query)
    return costs


def _numbers(costs: dict[str, Cost]) -> dict[str, float]:
    """Costs of all stages together and of each, by the names of their metrics; memory where the system says."""
    found = {"seconds": sum(c.seconds for c in costs.values()), "cpu_seconds": sum(c.cpu for c in costs.values())}
    if all(c.memory is not None for c in costs.values()):
        found["memory"] = max(c.memory for c in costs.values())
    for name, cost in costs.items():
        found |= {f"seconds@{name}": cost.seconds, f"cpu_seconds@{name}": cost.cpu}
        found |= {} if cost.memory is None else {f"memory@{name}": cost.memory}
    return found


def finer(motion: Motion, canonical: Canonical, subdivisions: int) -> tuple[Motion, Canonical]:
    """Motion and shape with every triangle cut in four, so many times."""
    for _ in range(subdivisions):
        motion, canonical = subdivided(motion, canonical)
    return motion, canonical


def _check(train: Motion) -> None:
    if train.faces is None:
        raise InputError("Motion.faces", expected="triangles, which are made finer", found="bare points")
