"""What a computation costs: wall time, processor time of all its threads, memory."""

from __future__ import annotations

import ctypes
import gc
import os
import statistics
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

Prepare = Callable[[], Callable[[], object]]  # gets a computation ready, which is not timed, and returns it


@dataclass(frozen=True)
class Cost:
    """seconds: on the wall; cpu: processor seconds of all threads of the process; memory: MB in use at the peak on
    top of what was in use before, or None where the system does not say."""

    seconds: float
    cpu: float
    memory: float | None


def measure(work: Callable[[], object]) -> tuple[object, Cost]:
    """The result of work() and its cost. Nothing else may run in this process meanwhile."""
    before = _reset_peak()
    cpu, wall = time.process_time(), time.perf_counter()
    result = work()
    seconds, used = time.perf_counter() - wall, time.process_time() - cpu
    after = _status("VmHWM")
    return result, Cost(seconds, used, None if before is None or after is None else max(after - before, 0.0))


def in_turn(ours: Prepare, peer: Prepare, repeats: tuple[int, int]) -> list[tuple[object, Cost]]:
    """Last result and median cost of both, run one after the other so that a busy spell of the machine meets both."""
    costs: tuple[list[Cost], list[Cost]] = ([], [])
    results: list[object] = [None, None]
    for i in range(max(repeats)):
        for which, prepare in enumerate((ours, peer)):
            if i < repeats[which]:
                results[which], cost = measure(prepare())
                costs[which].append(cost)
    return [(result, median(each)) for result, each in zip(results, costs, strict=True)]


def numbers(ours: Cost, peer: Cost) -> dict[str, float]:
    """Both costs and their ratios by the names of their metrics; memory where the system says."""
    found = {"time_ratio": ours.seconds / peer.seconds, "cpu_ratio": ours.cpu / peer.cpu}
    for who, cost in {"": ours, "peer_": peer}.items():
        found |= {f"{who}seconds": cost.seconds, f"{who}cpu_seconds": cost.cpu}
        found |= {} if cost.memory is None else {f"{who}memory": cost.memory}
    return found


def median(costs: list[Cost]) -> Cost:
    """Medians of the times, the most memory."""
    seconds, cpu = (statistics.median(getattr(c, name) for c in costs) for name in ("seconds", "cpu"))
    return Cost(seconds, cpu, max((c.memory for c in costs if c.memory is not None), default=None))


@contextmanager
def threads_held(count: int) -> Iterator[None]:
    """Holds our kernels and every OpenMP library that is loaded to `count` threads; 0 leaves them as they are."""
    from threadpoolctl import threadpool_limits

    if count == 0:
        yield
        return
    earlier = os.environ.get("SKELEBONES_THREADS")
    os.environ["SKELEBONES_THREADS"] = str(count)
    try:
        with threadpool_limits(count):
            yield
    finally:
        if earlier is None:
            del os.environ["SKELEBONES_THREADS"]
        else:
            os.environ["SKELEBONES_THREADS"] = earlier


def _reset_peak() -> float | None:
    """Sets the process's peak memory back to what it uses now, and returns that in MB. Linux with glibc, else None.

    Memory that was freed earlier goes back to the system first, or what comes would seem to need none. Sampling from a
    thread would not do: the peers hold Python's lock while they compute.
    """
    gc.collect()
    try:
        ctypes.CDLL(None).malloc_trim(0)
    except (AttributeError, OSError, TypeError):
        return None  # not glibc
    try:
        with open("/proc/self/clear_refs", "w", encoding="ascii") as file:
            file.write("5")
    except OSError:
        return None
    return in_use()


def in_use() -> float | None:
    """MB that the process uses now, or None where the system does not say."""
    return _status("VmRSS")


def _status(key: str) -> float | None:
    try:
        with open("/proc/self/status", encoding="ascii") as file:
            kilobytes = next((line.split()[1] for line in file if line.startswith(f"{key}:")), None)
    except OSError:
        return None
    return None if kilobytes is None else int(kilobytes) / 1024.0
