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

    def run(seen: Motion, unseen: Motion, shape: Canonical) -> dict[str, Cost]:
        costs: dict[str, Cost] = {}

        def timed(name: str, work: Callable[[], object]) -> object:
            before = in_use()
            result, cost = measure(work)
            top = None if before is None or cost.memory is None else before + cost.memory - start
            costs[name] = Cost(cost.seconds, cost.cpu, top)
            return result

        clusters = timed("clusters", lambda: cluster(seen, shape, **clustering))
        bones = timed("bones", lambda: ssdr(seen, shape, clusters, **decomposition))
        surface = timed("surface", lambda: closed_surface(shape, **closing))
        curve = timed("curve", lambda: curve_skeleton(surface, **tracing))
        skeleton = timed("skeleton", lambda: joints_by_motion(seen, shape, bones, surface, curve, **jointing))
        poses = timed("poses", lambda: fit_poses(seen, shape, skeleton, **posing))
        query = timed("poses, unseen", lambda: fit_poses(unseen, shape, skeleton, **posing))
        parts = timed("parts", lambda: find_parts(skeleton, bones, **parting))
        database = timed("database", lambda: build_database(seen, bones, poses))
        known = Training(seen, shape, bones, skeleton, database, parts)
        timed("PartMM", lambda: partmm.animate(known, query, **matching))
        return costs

    with threads_held(threads):
        start = in_use() or 0.0
        run(train, test, canonical)  # compiles
        start = in_use() or 0.0
        (fine, shape), (unseen, _) = finer(train, canonical, subdivisions), finer(test, canonical, subdivisions)
        runs = [run(fine, unseen, shape) for _ in range(repeats)]
    costs = {name: median([costs[name] for costs in runs]) for name in runs[0]}
    found = {
        "points_count": float(len(shape.points)),
        "frames_count": float(fine.frames),
        "bones_count": float(clustering["max_bones"]),
        "seconds": sum(c.seconds for c in costs.values()),
        "cpu_seconds": sum(c.cpu for c in costs.values()),
    }
    if all(c.memory is not None for c in costs.values()):
        found["memory"] = max(c.memory for c in costs.values())
    for name, cost in costs.items():
        found |= {f"seconds@{name}": cost.seconds, f"cpu_seconds@{name}": cost.cpu}
        found |= {} if cost.memory is None else {f"memory@{name}": cost.memory}
    return declared(found, train.unit)


def finer(motion: Motion, canonical: Canonical, subdivisions: int) -> tuple[Motion, Canonical]:
    """Motion and shape with every triangle cut in four, so many times."""
    for _ in range(subdivisions):
        motion, canonical = subdivided(motion, canonical)
    return motion, canonical


def _check(train: Motion) -> None:
    if train.faces is None:
        raise InputError("Motion.faces", expected="triangles, which are made finer", found="bare points")
