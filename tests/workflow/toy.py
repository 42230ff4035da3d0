"""Small stages for the tests of the workflow; they look like those of ``tasks`` to the rest of the system."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

import numpy as np

from tasks.errors import InputError
from tasks.values import Animation, Metrics
from tasks.workspace import Workspace

TOY = "tests.workflow.toy"


def _log(log: str, line: str) -> None:
    with open(log, "a", encoding="utf-8") as file:
        file.write(line + "\n")


def make(*, value: float, log: str) -> Metrics:
    """A number."""
    _log(log, f"make {value}")
    return Metrics(("x",), ("unit",), np.array([value]))


def double(source: Metrics, *, log: str) -> Metrics:
    """Twice a number."""
    _log(log, "double")
    return Metrics(("x",), ("unit",), source.values * 2)


def sign(source: Metrics, *, log: str) -> Metrics:
    """A stage whose output stays the same for many inputs."""
    _log(log, "sign")
    return Metrics(("x",), ("unit",), np.sign(source.values))


def slow(source: Metrics, *, seconds: float, log: str) -> Metrics:
    """Takes a while, and says when it began."""
    _log(log, f"slow began {os.getpid()}")
    time.sleep(seconds)
    _log(log, "slow ended")
    return source


def spread(*, value: float, size: int, log: str) -> Animation:
    """Many numbers."""
    _log(log, "spread")
    return Animation(np.random.default_rng(int(value)).normal(size=(1, size, 3)).astype(np.float32))


def bend(source: Animation, *, log: str) -> Animation:
    """As many others."""
    _log(log, "bend")
    return Animation(np.sin(source.points))


def defect(source: Metrics, *, log: str) -> Metrics:
    """A stage with a defect of ours."""
    _log(log, "defect")
    raise ZeroDivisionError("a defect in the stage")


def refuse(source: Metrics, *, path: str, log: str) -> Metrics:
    """A stage that finds its input bad."""
    _log(log, "refuse")
    raise InputError(str(Path(path).name), expected="something good", found="something bad", do="mend it")


def fatal(source: Metrics, *, log: str) -> Metrics:
    """A stage whose worker is killed, the first time it runs."""
    _log(log, "fatal")
    with open(log, encoding="utf-8") as file:
        if file.read().split().count("fatal") == 1:
            os.kill(os.getpid(), signal.SIGKILL)
    return source


def long(source: Metrics, *, log: str, die_at: int, workspace: Workspace) -> Metrics:
    """Four steps, each kept in the workspace; the first time it dies at one of them."""
    done = workspace.folder / "done.txt"
    steps = int(done.read_text()) if done.exists() else 0
    for step in range(steps, 4):
        if step == die_at and steps == 0:
            raise ZeroDivisionError("died on the way")
        _log(log, f"step {step}")
        workspace.say(f"step {step}", step / 4)
        done.write_text(str(step + 1))
    return source
