"""Our bones against Dem Bones, side by side in one process: time, error, error on held-out frames, memory.

A judge that stands above the stages: unlike a stage it may import several of them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated

from tasks.benchmarks import dem_bones
from tasks.benchmarks.cost import in_turn, measure, median, numbers, threads_held
from tasks.bones.clustering import cluster
from tasks.bones.refit import refit_bones
from tasks.bones.ssdr import ssdr
from tasks.evaluation.metrics import declared
from tasks.geometry.measure import diagonal, vertex_rmse
from tasks.geometry.skinning import skin
from tasks.values import Canonical, Metrics, Motion, Skinning

# From quick to thorough: changes to the settings of the decomposition that trade error for time. The first that
# reaches the peer's error is what ``time_to_peer_rmse_ratio`` times; the settings as shipped come last.
EFFORTS = (
    *(
        {"surplus": 0, "smoothness": 0.0, "points_per_bone": 50, "iterations": rounds, "polish": polish}
        for rounds, polish in ((2, 1), (3, 1), (4, 1), (6, 1), (8, 1), (8, 2), (12, 3))
    ),
    {"surplus": 20, "polish": 3, "points_per_bone": 60},
    {},
)


def benchmark_bones(
    motion: Motion,
    train: Motion,
    test: Motion,
    canonical: Canonical,
    *,
    clustering: dict,
    decomposition: dict,
    smooth: Annotated[float, "[0, inf)"] | None,
    affine: Annotated[float, "[0, inf)"] | None,
    repeats: Annotated[int, "[1, inf)"],
    peer_repeats: Annotated[int, "[1, inf)"],
    held_out: bool,
    threads: Annotated[int, "[0, inf)"],
) -> Metrics:
    """Our clusters and decomposition and the peer, in turn, on all frames of a motion; ratios are ours / the peer's.

    clustering, decomposition: the settings of :func:`cluster` and :func:`ssdr`; the peer gets as many bones and
    influences; smooth, affine: its weightsSmooth and transAffine, None as it comes; repeats, peer_repeats: runs whose
    median is taken, after one of ours that compiles; threads: 0 for all cores.
    held_out: measure unseen frames too, those of ``test``, for which both run once more: bones are made from ``train``
    alone, weights frozen, transforms of both fitted to the unseen frames by the same solver. Raises InputError where
    the extra is missing.
    """
    peer = {"influences": decomposition["influences"], "smooth": smooth, "affine": affine}
    dem_bones.prepare(motion, canonical, bones=1, **peer)  # says now what it would miss later

    def ours(data: Motion, effort: dict) -> Callable[[], Skinning]:
        settings = decomposition | effort
        return lambda: ssdr(data, canonical, cluster(data, canonical, **clustering), **settings)

    with threads_held(threads):
        peer["bones"] = ours(motion, {})().weights.shape[1]
        (mine, cost), (solved, peer_cost) = in_turn(
            lambda: ours(motion, {}), lambda: dem_bones.prepare(motion, canonical, **peer), (repeats, peer_repeats)
        )
        theirs = dem_bones.skinning(solved, canonical)
        quick = _time_to_rmse(lambda effort: ours(motion, effort), motion, _rmse(theirs, motion), repeats)
        unseen = []
        if held_out:
            unseen = [ours(train, {})(), dem_bones.skinning(dem_bones.prepare(train, canonical, **peer)(), canonical)]
    found = numbers(cost, peer_cost) | _errors(mine, theirs, motion, diagonal(canonical.points))
    if quick is not None:
        found["time_to_peer_rmse_ratio"] = quick / peer_cost.seconds
    if unseen:
        ours_unseen, peer_unseen = (_held_out(s, test) for s in unseen)
        found["held_out_rmse_ratio"] = ours_unseen / peer_unseen
    return declared(found, motion.unit)


def _time_to_rmse(
    ours: Callable[[dict], Callable[[], Skinning]], motion: Motion, target: float, repeats: int
) -> float | None:
    """Seconds of the first of ``EFFORTS`` with an error of at most `target`, or None where all miss it."""
    for effort in EFFORTS:
        skinning, cost = measure(ours(effort))
        if _rmse(skinning, motion) <= target:
            return median([cost, *(measure(ours(effort))[1] for _ in range(repeats - 1))]).seconds
    return None


def _errors(mine: Skinning, theirs: Skinning, motion: Motion, extent: float) -> dict[str, float]:
    rmse, peer_rmse = _rmse(mine, motion), _rmse(theirs, motion)
    return {
        "rmse_ratio": rmse / peer_rmse,
        "bones_rmse_pct": 100.0 * rmse / extent,
        "peer_rmse_pct": 100.0 * peer_rmse / extent,
        "bones_count": float(mine.weights.shape[1]),
        "peer_bones_count": float(theirs.weights.shape[1]),
    }


def _rmse(skinning: Skinning, motion: Motion) -> float:
    return vertex_rmse(skin(skinning.rest, skinning.weights, skinning.transforms), motion.points)


def _held_out(skinning: Skinning, test: Motion) -> float:
    return vertex_rmse(skin(skinning.rest, skinning.weights, refit_bones(test, skinning)), test.points)
