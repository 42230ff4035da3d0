"""``plan=true``: which stages are cached, which are to compute, and what that will cost by what past runs have left in
the store. Nothing is run and nothing is written.
"""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from rich.table import Table

from flows.batch import Batch, Work, work
from flows.cache import Ref, Store
from flows.costs import Cost, Past, makespan
from flows.engine import job_of
from flows.graph import Graph, Node, short
from flows.stage import key_of


@dataclass(frozen=True)
class Forecast:
    """A stage before a run. cached: it is in the store; keyed: its inputs are, so that this is certain: behind a stage
    that is to compute it can still turn out to be cached; cost: what is expected, or None where no past tells;
    seconds: of computing it, a rough guess where no past tells, 0 where it is cached."""

    node: Node
    cached: bool
    keyed: bool
    cost: Cost | None
    seconds: float


def forecast(graph: Graph, config: dict) -> list[Forecast]:
    """The graph's stages in their order."""
    store = Store(config["store"]["path"], create=False)
    past = Past(store)
    refs: dict[str, Ref] = {}
    found = []
    for node in graph.nodes.values():
        keyed = all(u.id in refs for u in node.upstream())
        ref = store.find(node.stage, key_of(job_of(node, refs, config, None))) if keyed else None
        if ref:
            refs[node.id] = ref
            found.append(Forecast(node, True, True, None, 0.0))
        else:
            found.append(Forecast(node, False, keyed, past.cost(node), past.seconds(node)))
    return found


def seconds_with(graph: Graph, forecasts: list[Forecast], workers: int) -> float:
    """How long the run will take with so many workers, as it starts its stages."""
    return makespan(graph, {f.node.id: f.seconds for f in forecasts}, workers)


def show(batch: Batch, every: bool = False) -> None:
    """Prints the plan of a run: sums by experiment and by stage, and the whole. every: also each stage to compute."""
    graph, works = work(batch.experiments, batch.config["report"])
    forecasts = forecast(graph, batch.config)
    console = Console(highlight=False, soft_wrap=True)
    if every:
        for f in forecasts:
            if not f.cached:
                more = f" (+{len(f.node.cases) - 1} cases)" if len(f.node.cases) > 1 else ""
                line = f"to compute  {f.node.title:<10} {short(f.node.cases)}{more}  {_said(f.cost)}"
                console.print(line, markup=False)
    console.print(_table("stage", _by_stage(forecasts)))
    if len(works) > 1:
        console.print(_table("experiment", _by_experiment(forecasts, works)))
    for experiment in batch.experiments:
        for what, why in experiment.not_run:
            console.print(f"{experiment.name}: not run: {what}, {why}", markup=False)
    console.print(_whole(graph, forecasts, batch.config, len(works)), markup=False)
    if not every and not all(f.cached for f in forecasts):
        console.print("every stage to compute: plan=stages")


def _said(cost: Cost | None) -> str:
    if cost is None:
        return "unknown, never computed before"
    return f"{cost.seconds:.1f} s {cost.peak_mb:.0f} MB, {cost.size / 1e6:.1f} MB on disk"


def _by_stage(forecasts: list[Forecast]) -> dict[str, list[Forecast]]:
    """The dearest first."""
    stages: dict[str, list[Forecast]] = {}
    for f in forecasts:
        stages.setdefault(f.node.stage, []).append(f)
    return dict(sorted(stages.items(), key=lambda one: -sum(f.seconds for f in one[1])))


def _by_experiment(forecasts: list[Forecast], works: list[Work]) -> dict[str, list[Forecast]]:
    """The stages of each experiment that no earlier one has: what it adds to the run."""
    left = {f.node.id: f for f in forecasts}
    return {w.experiment.name: [left.pop(n) for n in w.graph.nodes if n in left] for w in works}


def _table(first: str, groups: dict[str, list[Forecast]]) -> Table:
    table = Table()
    table.add_column(first, no_wrap=True)
    for name in ("cached", "to do", "new", "seconds", "peak MB", "disk MB"):
        table.add_column(name, justify="right")
    for name, those in groups.items():
        todo = [f for f in those if not f.cached]
        costs = [f.cost for f in todo if f.cost]
        numbers = [len(those) - len(todo), len(todo), len(todo) - len(costs), sum(f.seconds for f in todo)]
        numbers += [max((c.peak_mb for c in costs), default=0), sum(c.size for c in costs) / 1e6]
        table.add_row(name, *(f"{n:.0f}" if n else "" for n in numbers))
    return table


def _whole(graph: Graph, forecasts: list[Forecast], config: dict, reports: int) -> str:
    todo = [f for f in forecasts if not f.cached]
    if not todo:
        return f"all {len(forecasts)} stages are cached; the {_count(reports, 'report')} would be written anew"
    costs = [f.cost for f in todo if f.cost]
    size = sum(c.size for c in costs)
    workers = config["runner"]["workers"]
    lines = [
        f"{_count(len(todo), 'stage')} to compute, {len(forecasts) - len(todo)} cached, {_count(reports, 'report')}",
        f"{_time(sum(f.seconds for f in todo))} of work, about {_time(seconds_with(graph, forecasts, workers))} with "
        f"{_count(workers, 'worker')} if nothing else runs; "
        f"up to {max((c.peak_mb for c in costs), default=0):.0f} MB in a process; {size / 1e6:.0f} MB on disk, "
        f"{_free(config['store']['path']) / 1e6:.0f} MB are free",
    ]
    if len(costs) < len(todo):
        new = _count(len(todo) - len(costs), "stage")
        lines.append(f"{new} never computed before: their seconds are a rough guess, memory and disk are not counted")
    if any(not f.keyed for f in todo):
        lines.append("what stands behind a stage to compute can turn out to be cached: these sums are upper bounds")
    return "\n".join(lines)


def _count(number: int, what: str) -> str:
    return f"{number} {what}" + ("" if number == 1 else "s")


def _time(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 120 else f"{seconds / 60:.0f} min"


def _free(path: str) -> int:
    """Bytes free where the store is or would be."""
    place = Path(path).expanduser().absolute()
    while not place.exists():
        place = place.parent
    return shutil.disk_usage(place).free
