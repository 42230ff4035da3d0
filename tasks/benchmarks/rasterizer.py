"""Our rasteriser against one written in Warp, side by side in one process on the same Gaussians.

A judge that stands above the stages: unlike a stage it may import several of them.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from typing import Annotated

import numpy as np
from scipy.spatial import cKDTree

from tasks.benchmarks.cost import threads_held
from tasks.errors import InputError
from tasks.evaluation.metrics import declared
from tasks.values import Canonical, Metrics

DISTANCE = 3.0  # of the camera, in widths of the shape as it is seen
FILL = 0.8  # of the image that the shape is as wide or high as, at its middle
# cameras that see +y upwards: from +z, and from +x
FRONT = ((1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0))
SIDE = ((0.0, 0.0, -1.0), (0.0, -1.0, 0.0), (-1.0, 0.0, 0.0))
Scene = dict[str, np.ndarray]
Work = Callable[[], object]


def benchmark_rasterizer(
    canonical: Canonical,
    *,
    gaussians: Annotated[list[Annotated[int, "[4, inf)"]], "gaussians: at least one"],
    sizes: Annotated[list[Annotated[int, "[8, inf)"]], "sizes: at least one"],
    threads: Annotated[list[Annotated[int, "[1, inf)"]], "threads: at least one"],
    repeats: Annotated[int, "[1, inf)"],
    seed: int,
) -> Metrics:
    """Milliseconds to draw spheres that cover a shape, and for a step: drawing and the gradients of all they have.

    gaussians: their numbers; sizes: of the square image, in pixels; threads: for ours, while Warp has one on the
    processor; repeats: runs whose median is taken, ours and the peer's in turn, after one that only warms up. Every
    case is named by the three, as "step_ms@5000 at 128 px, 1 thread". Without a case's name: the largest ratio of all
    cases with the fewest threads. Raises InputError where the extra is missing or the shape has no faces.
    """
    if canonical.faces is None:
        raise InputError("Canonical.faces", expected="triangles to lay Gaussians on", found="bare points")
    peer = _library()
    found: dict[str, float] = {}
    for count in gaussians:
        for size in sizes:
            scene = covering(canonical, count, size, seed)
            slopes = np.random.default_rng(seed).normal(size=(size, size, 4)).astype(np.float32)
            theirs = _peer(peer, scene, slopes, size)
            for n in threads:
                with threads_held(n):
                    forward, step, peer_forward, peer_step = timed([*_ours(scene, slopes, size), *theirs], repeats)
                numbers = {"forward_ms": forward, "step_ms": step}
                numbers |= {"peer_forward_ms": peer_forward, "peer_step_ms": peer_step}
                numbers |= {"forward_ratio": forward / peer_forward, "time_ratio": step / peer_step}
                case = f"{count} at {size} px, {n} thread{'s' if n > 1 else ''}"
                found |= {f"{name}@{case}": value for name, value in numbers.items()}
    return declared(_worst(found, f", {min(threads)} thread") | found, "unit")


def covering(canonical: Canonical, count: int, size: int, seed: int) -> Scene:
    """Spheres spread over a shape, and a camera before its broader side.

    Each sphere's scale is the mean distance to its three nearest, as 3DGS begins with.
    """
    import trimesh

    mesh = trimesh.Trimesh(canonical.points, canonical.faces, process=False)
    points = trimesh.sample.sample_surface(mesh, count, seed=seed)[0]
    g = np.random.default_rng(seed)
    low, high = canonical.points.min(0), canonical.points.max(0)
    extent = (high - low).astype(np.float64)
    view = np.eye(4)
    view[:3, :3] = SIDE if extent[0] < extent[2] else FRONT
    width = max(extent[1], extent[2] if extent[0] < extent[2] else extent[0])
    view[:3, 3] = np.array([0.0, 0.0, DISTANCE * width]) - view[:3, :3] @ ((low + high) / 2)
    focal = FILL * DISTANCE * size
    scene = {
        "means": points,
        "scales": cKDTree(points).query(points, 4)[0][:, 1:].mean(1, keepdims=True),
        "opacities": g.uniform(0.5, 1.0, count),
        "sh": g.normal(0.0, 0.5, (count, 1, 3)),
        "view": view,
        "intrinsics": np.array([[focal, 0.0, size / 2], [0.0, focal, size / 2], [0.0, 0.0, 1.0]]),
    }
    return {name: np.ascontiguousarray(a, np.float32) for name, a in scene.items()}


def timed(works: list[Work], repeats: int) -> list[float]:
    """Median milliseconds of each, run in turn so that a busy spell of the machine meets all."""
    seconds: list[list[float]] = [[] for _ in works]
    for turn in range(repeats + 1):
        for work, own in zip(works, seconds, strict=True):
            start = time.perf_counter()
            work()
            if turn > 0:
                own.append(time.perf_counter() - start)
    return [1e3 * statistics.median(own) for own in seconds]


def _ours(scene: Scene, slopes: np.ndarray, size: int) -> tuple[Work, Work]:
    import torch

    from tasks.reconstruction.rasterize import rasterize

    given = {name: torch.from_numpy(a) for name, a in scene.items()}
    leaves = {name: given[name].clone().requires_grad_() for name in ("means", "scales", "opacities", "sh")}
    background, of_images = torch.zeros(3), [torch.from_numpy(slopes[..., :3].copy()), torch.from_numpy(slopes[..., 3])]

    def draw(tensors: dict) -> tuple:
        return rasterize(**tensors, size=(size, size), background=background, backend="numba")

    def forward() -> object:
        with torch.no_grad():
            return draw(given)

    def step() -> object:
        return torch.autograd.grad(draw(given | leaves)[:2], list(leaves.values()), of_images)

    return forward, step


def _peer(peer: type, scene: Scene, slopes: np.ndarray, size: int) -> tuple[Work, Work]:
    splats = peer(**scene, size=(size, size))

    def step() -> object:
        splats.forward()
        return splats.backward(slopes[..., :3], slopes[..., 3])

    return splats.forward, step


def _library() -> type:
    try:
        from tasks.benchmarks.warp_splat import WarpSplats
    except ImportError:
        do = 'pip install -e ".[bench]"'
        raise InputError("benchmark", expected="the package warp-lang", found="none", do=do) from None
    return WarpSplats


def _worst(found: dict[str, float], case: str) -> dict[str, float]:
    ratios = ("time_ratio", "forward_ratio")
    return {r: max(v for name, v in found.items() if name.startswith(f"{r}@") and case in name) for r in ratios}
