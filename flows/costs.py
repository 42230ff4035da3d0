"""What stages cost: by what past runs have left in the store, and what follows for a run: which to start first, and how
long it will take."""

from __future__ import annotations

import heapq
from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from statistics import median

from flows.cache import Artefact, Store
from flows.graph import Graph, Node

# seconds of stages that take long, where no past tells; so rough that only their order counts
ROUGH = {
    "tasks.reconstruction.fit:fit": 200.0,
    "tasks.garments.simulate:simulate_frames": 200.0,
    "tasks.methods.gru:animate": 20.0,
    "tasks.methods.mlp:animate": 10.0,
    "tasks.skeleton.joints_motion:joints_by_motion": 10.0,
    "tasks.methods.bbw:animate": 5.0,
    "tasks.captures.scenes:render_scene": 5.0,
    "tasks.bones.ssdr:ssdr": 3.0,
    "tasks.bones.clustering:cluster": 2.0,
}
SHORT = 0.1


@dataclass(frozen=True)
class Cost:
    """seconds: of computing; peak_mb: of the process meanwhile; size: bytes in the store."""

    seconds: float
    peak_mb: float
    size: float


class Past:
    """The artefacts of a store by the function that made them."""

    def __init__(self, store: Store) -> None:
        self._by_function: dict[str, list[Artefact]] = defaultdict(list)
        for artefact in store.artefacts():
            self._by_function[artefact.function].append(artefact)

    def cost(self, node: Node) -> Cost | None:
        """The median cost of the same function: on the same data with the same settings, else on the same data, else on
        any; None where it was never computed."""
        same = self._by_function.get(node.function, [])
        data = {case.split()[0] for case in node.cases}
        near = [a for a in same if a.case.partition(" ")[0] in data]
        chosen = [a for a in near if a.settings == node.settings] or near or same
        if not chosen:
            return None
        return Cost(
            seconds=median(a.seconds for a in chosen),
            peak_mb=median(a.peak_mb for a in chosen),
            size=median(a.size for a in chosen),
        )

    def seconds(self, node: Node) -> float:
        """The seconds of :meth:`cost`, else a rough guess."""
        cost = self.cost(node)
        return cost.seconds if cost else ROUGH.get(node.function, SHORT)


def chains(graph: Graph, seconds: Mapping[str, float]) -> dict[str, float]:
    """For every node the seconds of the longest chain of stages that begins with it: what is to start first."""
    behind: dict[str, float] = dict.fromkeys(graph.nodes, 0.0)
    for node in reversed(list(graph.nodes.values())):  # which stand after what they need
        behind[node.id] += seconds[node.id]
        for needed in node.upstream():
            behind[needed.id] = max(behind[needed.id], behind[node.id])
    return behind


def makespan(graph: Graph, seconds: Mapping[str, float], workers: int) -> float:
    """Seconds until the last stage ends when free workers always take the ready stage with the longest chain."""
    first = chains(graph, seconds)
    missing = {node.id: {needed.id for needed in node.upstream()} for node in graph.nodes.values()}
    after = _after(graph.nodes.values())
    ready = [(-first[n], n) for n in graph.nodes if not missing[n]]
    heapq.heapify(ready)
    running: list[tuple[float, str]] = []
    now = 0.0
    while ready or running:
        while ready and len(running) < workers:
            _, node = heapq.heappop(ready)
            heapq.heappush(running, (now + seconds[node], node))
        now, done = heapq.heappop(running)
        for node in after[done]:
            missing[node].discard(done)
            if not missing[node]:
                heapq.heappush(ready, (-first[node], node))
    return now


def _after(nodes: Iterable[Node]) -> dict[str, list[str]]:
    """For every node those that wait for it."""
    after: dict[str, list[str]] = defaultdict(list)
    for node in nodes:
        for needed in dict.fromkeys(n.id for n in node.upstream()):
            after[needed].append(node.id)
    return after
