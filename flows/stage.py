"""One stage as a cached Prefect task: a pure function of ``tasks``, its settings and its upstream artefacts.

The cache key is the digest of all that can change the result: stage, function, its source and all of ``tasks`` it
imports, its own settings, the *content* of its inputs, the major versions of numpy and torch. Not: paths, runner, names
of cases. A changed stage whose output is the same re-runs nothing after it.
"""

from __future__ import annotations

import hashlib
import importlib
import json
import os
import shutil
import threading
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields
from functools import cache, partial
from importlib.metadata import version
from pathlib import Path

from flows.cache import Ref, Store, canonical_json, explained
from flows.source import FILES, WORKSPACE
from tasks.values import Training
from tasks.workspace import Workspace

FORMAT = 1  # raise it when the store's layout changes
SPENT = "seconds"  # file in a stage's folder: what it has taken so far, read by who goes on after a kill


@dataclass(frozen=True)
class Job:
    """All that a worker needs to run one stage, picklable and small.

    inputs: argument -> (Ref, output name), or for a composite argument a dict of those; source: digest of the
    function's code; files: digest of the input files that the settings name; case: what readers call it.
    """

    stage: str
    function: str
    outputs: tuple[str, ...]
    settings: dict
    inputs: dict
    source: str
    files: str
    case: str
    store: str
    events: str | None = None
    max_gb: float | None = None


def _silent(text: str, fraction: float) -> None:
    """Nobody listens."""


def key_of(job: Job) -> str:
    """The cache key of a job."""
    settings = {n: _canonical(v) for n, v in job.settings.items()}
    if job.files:  # the files' bytes stand for their place; the name is kept, it becomes the subject's
        settings |= {n: Path(str(settings[n])).name for n in FILES if settings.get(n)}
    content = {
        "format": FORMAT,
        "stage": job.stage,
        "function": job.function,
        "source": job.source,
        "outputs": job.outputs,
        "settings": settings,
        "inputs": _digests(job.inputs),
        "files": job.files,
        "versions": _versions(),
    }
    return hashlib.sha256(canonical_json(content).encode()).hexdigest()[:32]


@cache
def _versions() -> dict[str, str]:
    return {name: version(name).split(".")[0] for name in ("numpy", "torch")}


def run(job: Job, say: Callable[[str, float], None] = _silent) -> Ref:
    """The job's artefact, from the store or computed now. Any process may call it; equal jobs wait for one another.
    Its seconds are those of all parts of a stage that was killed and went on.

    say: hears how far a long stage is, a text and a share of the whole.
    """
    store, key = Store(job.store), key_of(job)
    found = store.find(job.stage, key)
    if found:
        return found
    with store.lock(job.stage, key):
        found = store.find(job.stage, key)
        if found:
            return found
        tell(job, "computing")
        folder = store.scratch(job.stage, key)
        with Watch(_spent(folder)) as watch:
            values = _compute(job, folder, partial(_progress, job, say, folder, watch))
        meta = {
            "function": job.function,
            "settings": job.settings,
            "case": job.case,
            "seconds": round(watch.seconds, 3),
            "peak_mb": round(watch.peak_mb, 1),
        }
        ref = store.put(job.stage, key, values, meta)
        shutil.rmtree(folder, ignore_errors=True)
        return ref


def tell(job: Job, event: str, **more: object) -> None:
    """One line for whoever watches the run; a line of this size is appended whole."""
    if job.events:
        line = json.dumps({"event": event, "stage": job.stage, "case": job.case, "time": time.time(), **more})
        with explained(Path(job.events)), open(job.events, "a", encoding="utf-8") as file:
            file.write(line + "\n")


class Watch:
    """Seconds and the process's peak memory while a stage runs (other threads' share is in it).

    earlier: seconds that it took before, in processes that were killed.
    """

    def __init__(self, earlier: float = 0.0) -> None:
        self._earlier = earlier

    def __enter__(self) -> Watch:
        import psutil

        self._process = psutil.Process()
        self._stop = threading.Event()
        self.peak_mb = self._resident()
        self._thread = threading.Thread(target=self._sample, daemon=True)
        self._start = time.perf_counter()
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.seconds = self.so_far()
        self._stop.set()
        self._thread.join()

    def so_far(self) -> float:
        """Seconds, with the earlier ones."""
        return self._earlier + time.perf_counter() - self._start

    def _resident(self) -> float:
        return self._process.memory_info().rss / 2**20

    def _sample(self) -> None:
        while not self._stop.wait(0.05):
            self.peak_mb = max(self.peak_mb, self._resident())


@cache
def one_blas_thread() -> None:
    """Holds this process's BLAS to one thread: products of several threads differ in their last bits.

    Stages run side by side instead, and their own kernels split work in ways that leave the bits alone.
    """
    import numpy  # noqa: F401
    import scipy.linalg  # noqa: F401, both bring a BLAS of their own, which must be loaded to be held
    from threadpoolctl import threadpool_limits

    threadpool_limits(1, user_api="blas")


def _compute(job: Job, folder: Path, say: Callable[[str, float], None]) -> dict[str, object]:
    one_blas_thread()
    module, name = job.function.split(":")
    function = getattr(importlib.import_module(module), name)
    store = Store(job.store)
    inputs = {n: _load(store, value) for n, value in job.inputs.items()}
    if WORKSPACE in function.__annotations__:
        with explained(folder):
            folder.mkdir(parents=True, exist_ok=True)
        inputs[WORKSPACE] = Workspace(folder, say, job.max_gb)
    result = function(**inputs, **job.settings)
    values = result if isinstance(result, tuple) else (result,)
    return dict(zip(job.outputs, values, strict=True))


def _progress(
    job: Job, say: Callable[[str, float], None], folder: Path, watch: Watch, text: str, fraction: float
) -> None:
    tell(job, "progress", text=text, fraction=fraction)
    say(text, fraction)
    draft = folder / f"{SPENT}.partial"
    with explained(folder):
        draft.write_text(repr(watch.so_far()), "utf-8")
        os.replace(draft, folder / SPENT)


def _spent(folder: Path) -> float:
    """Seconds that a stage took up to the last word of those parts of it that were killed."""
    try:
        return float((folder / SPENT).read_text("utf-8"))
    except (FileNotFoundError, ValueError):  # a machine that lost its power may leave an empty file
        return 0.0


def _load(store: Store, value: object) -> object:
    if isinstance(value, dict):
        parts = {n: _load(store, v) for n, v in value.items()}
        return Training(**parts) if parts.keys() == {f.name for f in fields(Training)} else parts
    ref, output = value
    return store.load(ref, output)


def _digests(inputs: object) -> object:
    if isinstance(inputs, dict):
        return {n: _digests(v) for n, v in inputs.items()}
    ref, output = inputs
    return ref.outputs[output]


def _canonical(value: object) -> object:
    """1 and 1.0 are one setting."""
    if isinstance(value, float) and value.is_integer():
        return int(value)
    return [_canonical(v) for v in value] if isinstance(value, list) else value


def ref_to_dict(ref: Ref) -> dict:
    """A Ref as plain JSON, for Prefect."""
    return asdict(ref)
