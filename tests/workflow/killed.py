"""A worker that is killed fifty times; run as a program, for forking wants a process without other threads.

It forks a worker that brings every stage of a graph to the store, kills it at a random moment, and again, until at last
one is let run to its end. Prints how many workers had not finished when they were killed, how many different states
the store was left in, and the most leftovers that it ever held.
"""

from __future__ import annotations

import os
import random
import signal
import sys
import tempfile
import time
from pathlib import Path

from flows.engine import job_of
from flows.graph import Graph
from tests.workflow.toy import TOY

CHAINS, SIZE = 60, 100_000
KILLS = 50


def graph(chains: int) -> Graph:
    """Chains of three stages whose artefacts take a moment to write."""
    made = Graph()
    for value in range(chains):
        about = {"outputs": ("out",), "case": f"case {value}"}
        settings = {"value": float(value), "size": SIZE, "log": os.devnull}
        first = made.add("spread", f"{TOY}:spread", settings, **about)["out"]
        second = made.add("bend", f"{TOY}:bend", {"log": os.devnull}, **about, source=first)["out"]
        made.add("bend", f"{TOY}:bend", {"log": os.devnull}, **about, source=second)
    return made


def bring(made: Graph, store: str, tell: int | None = None) -> None:
    """Runs every stage of the graph, in order. tell: hears a byte after each that was computed."""
    from flows.stage import run

    refs: dict = {}
    config = {"store": {"path": store}, "memory": {"max_gb": None}}
    for node in made.nodes.values():
        refs[node.id] = run(job_of(node, refs, config, None))
        if tell is not None and not refs[node.id].cached:
            os.write(tell, b".")


def main(store: str, kills: int, seed: int) -> None:
    """Kills as many workers, then lets one finish."""
    with tempfile.TemporaryDirectory() as warm:
        bring(graph(1), warm)  # loads all that a worker needs, so that it starts at once
    made = graph(CHAINS)
    rng = random.Random(seed)
    hit, states, leftovers = 0, set(), 0
    for _ in range(kills):
        hear, tell = os.pipe()
        worker = os.fork()
        if not worker:
            bring(made, store, tell)
            os._exit(0)
        os.close(tell)
        for _ in range(rng.randint(0, 3)):  # some stages on, and then at any moment of the next
            os.read(hear, 1)
        time.sleep(rng.uniform(0, 0.03))
        os.kill(worker, signal.SIGKILL)
        os.close(hear)
        hit += os.WIFSIGNALED(os.waitpid(worker, 0)[1])
        states.add(len(list(Path(store).rglob("meta.json"))))
        leftovers = max(leftovers, len(list(Path(store).rglob("*.tmp"))))
    bring(made, store)
    print(hit, len(states), leftovers)


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), 0)
