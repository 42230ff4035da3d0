"""Every runner gives the same numbers to the bit, on a sweep of twelve small cases."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
import threading
import time
from glob import glob
from pathlib import Path

import psutil
import pytest

from flows.batch import batch
from flows.server import free_port
from flows.source import ROOT
from flows.sweep import run_batch

pytestmark = pytest.mark.slow

PACKAGES = {"dask": "prefect_dask", "ray": "prefect_ray"}


def twelve(file: Path, folder: Path, *more: str) -> tuple[str, ...]:
    """Three methods by four ablations of one small motion."""
    data = ("+experiment=table3", "dataset=mesh_sequence", f"dataset.path={file}")
    grid = ("sweep.methods=[fullmm,partmm,partmm_plus]", "sweep.ablations=[none,k_1,k_3,k_15]")
    places = (f"store.path={folder}/store", f"report.path={folder}/reports", "report.figures=false")
    return (*data, *grid, "bones.max_bones=4", *places, *more)


def sweep(file: Path, folder: Path, *more: str) -> bytes:
    """Runs the twelve and returns their metrics.csv."""
    work = batch(list(twelve(file, folder, *more)))
    assert sum(len(e.cases) for e in work.experiments) == 12
    return (run_batch(work, show=False) / "metrics.csv").read_bytes()


def need(kind: str) -> None:
    package = PACKAGES.get(kind)
    if package and importlib.util.find_spec(package) is None:
        pytest.skip(f'{package} is not installed (pip install -e ".[{kind}]")')


@pytest.fixture(scope="module")
def threads(tmp_path_factory, prefect_server, small_file) -> bytes:
    return sweep(small_file, tmp_path_factory.mktemp("threads"), "runner=threads")


@pytest.mark.parametrize("kind", ["processes", "dask", "ray"])
def test_every_runner_gives_the_same_metrics(kind, tmp_path, prefect_server, small_file, threads, monkeypatch):
    need(kind)
    monkeypatch.setenv("PYTHONPATH", str(ROOT))  # for worker processes
    assert sweep(small_file, tmp_path, f"runner={kind}") == threads


@pytest.mark.skipif(os.name != "posix", reason="kill -9 is POSIX's")
def test_a_worker_killed_in_mid_sweep_changes_nothing(tmp_path, prefect_server, small_file, threads, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    killed = []

    def kill() -> None:
        """Kills a worker once some stages are in the store."""
        while len(glob(f"{tmp_path}/store/*/*/meta.json")) < 8:
            time.sleep(0.05)
        workers = [c for c in psutil.Process().children(recursive=True) if "spawn_main" in "".join(c.cmdline())]
        workers[0].kill()
        killed.append(workers[0].wait(60))

    killer = threading.Thread(target=kill, daemon=True)
    killer.start()
    assert sweep(small_file, tmp_path, "runner=processes") == threads
    assert len(killed) == 1


def test_workers_that_run_already_share_a_store(tmp_path, prefect_server, small_file, threads):
    """A scheduler and two workers, each a process of its own, as on several machines with one store between them."""
    need("dask")
    address = f"tcp://127.0.0.1:{free_port()}"
    environment = os.environ | {"PYTHONPATH": str(ROOT), "DASK_DISTRIBUTED__WORKER__DAEMON": "False"}
    started = []

    def start(*arguments: str) -> None:
        command = [sys.executable, "-m", *arguments]
        with open(tmp_path / f"log{len(started)}.txt", "w") as out:
            started.append(subprocess.Popen(command, env=environment, cwd=tmp_path, stdout=out, stderr=out))

    host, port = address.removeprefix("tcp://").split(":")
    try:
        start("distributed.cli.dask_scheduler", "--host", host, "--port", port, "--no-dashboard")
        for _ in range(2):
            start("distributed.cli.dask_worker", address, "--nthreads", "1", "--no-nanny", "--no-dashboard")
        metrics = sweep(small_file, tmp_path, "runner=dask", f"runner.address={address}")
    finally:
        for child in started:
            child.kill()
            child.wait()
    assert metrics == threads
    used = [log.read_text() for log in sorted(tmp_path.glob("log*.txt"))]
    assert sum("Registered to" in text for text in used) == 2


def test_a_missing_package_is_one_line(monkeypatch):
    from flows.runners import task_runner
    from tasks.errors import InputError

    monkeypatch.setitem(sys.modules, "prefect_dask", None)
    with pytest.raises(InputError, match=r"pip install .*\[dask\]"):
        task_runner({"kind": "dask", "workers": 1, "address": None})
