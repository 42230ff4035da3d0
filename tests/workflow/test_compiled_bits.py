"""What numba compiled and keeps: the same bits when compiled and when loaded, and never those of older sources.

Numba keeps a compiled copy of a function for itself and one in each function that calls it; which of them a process
runs depends on whether it compiled or loaded. Under fast maths the copies may add in another order.
"""

from __future__ import annotations

import importlib
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from numba.core.dispatcher import Dispatcher

import tasks

WORK = """
import hashlib
import numpy as np
import torch
from tasks.bones.clustering import cluster
from tasks.bones.ssdr import ssdr
from tasks.datasets import creature
from tasks.motion.search import Keys, frame_distances
from tasks.reconstruction.ssim import ssim
from tasks.values import Canonical
from tests.analytic.test_rasterizer import drawn, scene

def say(name, *arrays):
    print(name, hashlib.sha1(b"".join(np.ascontiguousarray(a).tobytes() for a in arrays)).hexdigest())

motion = creature.load(subject="animal", frames_per_clip=16, vertices=3000, softness=1.0, seed=0)
canonical = Canonical(motion.points[0], motion.faces, 0, "first")
clusters = cluster(motion, canonical, max_bones=20, count="auto", slack=0.02, exact=1e-4, rounds=4, seed=0)
say("clusters", clusters.labels, clusters.curve_error)
skinning = ssdr(motion, canonical, clusters, influences=4, surplus=12, iterations=4, polish=3, points_per_bone=120,
                smoothness=1e-5, locality=8.0, firmness=1.0, compression=0.06, prune=0.0, seed=0)
say("bones", skinning.weights, skinning.transforms)
images = drawn("numba", *scene(torch.float32))
say("images", *(t.numpy() for t in images.values()))
a, b = (torch.rand((40, 50, 3), generator=torch.Generator().manual_seed(i), requires_grad=i == 0) for i in range(2))
value = ssim(a, b)
value.backward()
say("ssim", value.detach().numpy(), a.grad.numpy())
g = np.random.default_rng(0)
keys = Keys(*(g.normal(size=(200, 5, k)).astype(np.float32) for k in (4, 3)), np.array([0, 200]))
say("distances", frame_distances(keys.rotations[:20], keys.extra[:20], keys, 0, 200))
"""


@pytest.mark.slow
def test_compiled_and_loaded_kernels_give_the_same_bits(tmp_path: Path) -> None:
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    compiled, loaded = (
        subprocess.run([sys.executable, "-c", WORK], env=environment, capture_output=True, text=True, check=True).stdout
        for _ in range(2)
    )
    assert len(compiled.splitlines()) == 5
    assert compiled == loaded


def test_fast_maths_only_where_no_other_kernel_calls() -> None:
    kernels = {}
    root = Path(tasks.__file__).parent
    for file in sorted(f for f in root.rglob("*.py") if "njit" in f.read_text(encoding="utf-8")):
        module = ".".join(("tasks", *file.relative_to(root).with_suffix("").parts))
        for kernel in vars(importlib.import_module(module)).values():
            if isinstance(kernel, Dispatcher):
                kernels[kernel.py_func.__module__, kernel.py_func.__name__] = kernel
    assert len(kernels) > 50
    called = {
        vars(sys.modules[module])[name]
        for (module, _), kernel in kernels.items()
        for name in kernel.py_func.__code__.co_names
        if isinstance(vars(sys.modules[module]).get(name), Dispatcher)
    }
    fast = {kernel for kernel in kernels.values() if kernel.targetoptions.get("fastmath")}
    assert fast, "no kernel uses fast maths any more: this test can go"
    assert not {k.py_func.__name__ for k in fast & called}


def test_a_changed_kernel_changes_those_that_call_it(tmp_path: Path) -> None:
    shutil.copytree(Path(tasks.__file__).parent, tmp_path / "tasks", ignore=shutil.ignore_patterns("__pycache__"))
    work = """
import numpy as np
from tasks.bones.transforms import extrapolate
still = np.zeros((1, 4, 3, 2))
print(np.abs(extrapolate(still, still, 0.5)).max())
"""
    environment = {k: v for k, v in os.environ.items() if k != "NUMBA_CACHE_DIR"} | {"PYTHONPATH": str(tmp_path)}
    quiet = {"env": environment, "cwd": tmp_path, "capture_output": True, "text": True, "check": True}

    def run() -> float:
        return float(subprocess.run([sys.executable, "-c", work], **quiet).stdout)

    assert run() < 1e-9
    callee = tmp_path / "tasks" / "bones" / "rotation.py"
    callee.write_text(callee.read_text(encoding="utf-8").replace("1.0 - s * (y * y", "3.0 - s * (y * y"), "utf-8")
    assert abs(run() - 2.0) < 1e-9
    assert len(list((tmp_path / "tasks" / "__pycache__").glob("kernels-*"))) == 1
