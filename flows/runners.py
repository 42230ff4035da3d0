"""Where stages run: Prefect's own task runners, by the name that the config gives them."""

from __future__ import annotations

import importlib
import os
import sys
from concurrent.futures import BrokenExecutor

from tasks.errors import InputError

CLUSTERS_SAY = {
    "distributed.KilledWorker",
    *(f"ray.{name}" for name in ("WorkerCrashedError", "LocalRayletDiedError", "NodeDiedError", "OutOfMemoryError")),
}


class WorkerLost(Exception):
    """A worker process was killed: which stages ran then, and how to go on."""

    def __init__(self, stages: list[str]) -> None:
        self.stages = stages
        super().__init__(
            f"a worker process was killed, from outside or for want of memory, while these stages ran: "
            f"{'; '.join(stages) or 'none'}; what is finished is kept: the same command goes on from there, with "
            "runner.workers=1 in less memory"
        )


def of_a_lost_worker(error: Exception) -> bool:
    """Whether an error says that a worker died: of a pool of processes, or what Dask and Ray raise when they have
    given a stage to new workers in vain. Their packages need not be there."""
    names = {f"{kind.__module__.split('.')[0]}.{kind.__name__}" for kind in type(error).__mro__}
    return isinstance(error, BrokenExecutor) or bool(names & CLUSTERS_SAY)


def task_runner(settings: dict):
    """The task runner of a config's ``runner`` group. Raises InputError if its package is absent."""
    return {"threads": _threads, "processes": _processes, "dask": _dask, "ray": _ray}[settings["kind"]](settings)


def in_flight(settings: dict) -> int:
    """How many stages to hand to a runner at once: enough that no worker waits for the next, and no more, so that what
    comes first can still be chosen. A cluster that runs already gets all: how many workers it has is its own matter."""
    return sys.maxsize if settings.get("address") else 2 * settings["workers"]


def _threads(settings: dict):
    from prefect.task_runners import ThreadPoolTaskRunner

    return ThreadPoolTaskRunner(max_workers=settings["workers"])


def _processes(settings: dict):
    from prefect.task_runners import ProcessPoolTaskRunner

    return ProcessPoolTaskRunner(max_workers=settings["workers"])


def _dask(settings: dict):
    """A running scheduler's workers, or new processes with one stage at a time each."""
    runner = _extra("prefect_dask", "dask").DaskTaskRunner
    if settings["address"]:
        return runner(address=settings["address"])
    own = {"n_workers": settings["workers"], "threads_per_worker": 1, "processes": True, "dashboard_address": None}
    return runner(cluster_kwargs=own)


def _ray(settings: dict):
    """A running cluster's workers, or new processes with one stage at a time each."""
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    runner = _extra("prefect_ray", "ray").RayTaskRunner
    if settings["address"]:
        return runner(address=settings["address"])
    return runner(init_kwargs={"num_cpus": settings["workers"], "include_dashboard": False, "log_to_driver": False})


def _extra(package: str, extra: str):
    try:
        return importlib.import_module(package)
    except ModuleNotFoundError as error:
        if error.name != package:
            raise
        found = f"no package {package.replace('_', '-')}"
        do = f'pip install -c constraints.txt -e ".[{extra}]"'
        raise InputError("runner.kind", expected=f"what {extra} needs", found=found, do=do) from None
