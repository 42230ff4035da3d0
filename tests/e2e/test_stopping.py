"""A run that is stopped by hand or by the system: how soon it ends, what it says, and that it goes on from there."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time

import psutil
import pytest

from flows.source import ROOT
from flows.stopping import STOPPED

pytestmark = [pytest.mark.slow, pytest.mark.skipif(os.name != "posix", reason="signals are POSIX's")]

PROGRAM = """\
import sys
from pathlib import Path
from prefect import flow
from flows.server import server
from flows.progress import Progress
from flows.runners import task_runner
from flows.stopping import stoppable
from flows.engine import compute
from tests.workflow.test_sweep import World

world = World(Path(sys.argv[1]), sys.argv[2])
graph = world.graph(3.0, tail="slow")
next(n for n in graph.nodes.values() if n.stage == "slow").settings["seconds"] = float(sys.argv[3])

@flow(name="toy", task_runner=task_runner(world.config["runner"]))
def toy():
    compute(graph, world.config, Progress(graph, show=False))

if __name__ == "__main__":
    with stoppable(), server() as ready:
        ready()
        toy()
"""


def started(log) -> bool:
    return log.exists() and "slow began" in log.read_text()


@pytest.mark.parametrize(("kind", "number"), [("threads", signal.SIGTERM), ("processes", signal.SIGINT)])
def test_a_signal_ends_a_run_in_the_middle_of_a_stage(tmp_path, prefect_server, kind, number):
    program, log = tmp_path / "program.py", tmp_path / "log.txt"
    program.write_text(PROGRAM)
    environment = os.environ | {"PYTHONPATH": str(ROOT), "TMPDIR": str(tmp_path)}
    command = [sys.executable, str(program), str(tmp_path), kind]
    run = subprocess.Popen(
        [*command, "600"], env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    )
    while not started(log):
        assert run.poll() is None, run.stderr.read()
        time.sleep(0.05)
    children = psutil.Process(run.pid).children(recursive=True)
    run.send_signal(number)
    _, said = run.communicate(timeout=60)  # and not the stage's ten minutes
    assert run.returncode == 128 + number
    assert said.strip().splitlines()[-1] == STOPPED
    assert not psutil.wait_procs(children, timeout=10)[1]
    assert not list(tmp_path.glob("skelebones-*"))

    log.unlink()
    subprocess.run([*command, "0"], env=environment, check=True, capture_output=True, timeout=300)
    assert "make 3.0" not in log.read_text()  # what was finished is kept
    assert "slow ended" in log.read_text()
