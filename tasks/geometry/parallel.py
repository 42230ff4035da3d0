"""Threads for kernels that release the GIL, with results that do not depend on how many there are.

numba's own ``prange`` is not used: its default layer on some systems aborts when two Python threads enter it at once,
which is what a threaded task runner does.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor


def for_chunks(work: Callable[[int, int], object], count: int, chunk: int) -> list:
    """Calls work(start, stop) on fixed chunks of range(count) and returns the results in order.

    Chunks have the same bounds whatever the number of threads, so sums over them come out the same to the last bit.
    ``SKELEBONES_THREADS`` caps the threads (default: the processor's cores).
    """
    bounds = [(a, min(a + chunk, count)) for a in range(0, count, chunk)]
    threads = min(int(os.environ.get("SKELEBONES_THREADS", 0)) or os.cpu_count() or 1, len(bounds))
    if threads <= 1:
        return [work(a, b) for a, b in bounds]
    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(lambda ab: work(*ab), bounds))
