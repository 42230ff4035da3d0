"""``plan=true``: which stages are cached, which are to compute, and what that will cost by what past runs have left in
the store. Nothing is run and nothing is written.
"""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path
from statistics import median

from rich.console import Console
from rich.table import Table

from flows.batch import Batch, work
from flows.graph import Graph, Node, short
from flows.stage import key_of
from flows.store import Artefact, Ref, Store
from flows.sweep import job_of


@dataclass(frozen=True)
class Cost:
    """seconds: of computing; peak_mb: of the process meanwhile; size: bytes in the store."""

    seconds: float
    peak_mb: float
    size: float


@dataclass(frozen=True)
class Forecast:
    """A stage before a run. cached: it is in the store; keyed: its inputs are, so that this is certain: behind a stage
    that is to compute it can still turn out to be cached; cost: what is expected, or None where no past tells."""

    node: Node
    cached: bool
    keyed: bool
    cost: Cost | None


def forecast(graph: Graph, config: dict) -> list[Forecast]:
    """The graph's stages in their order."""
    store = Store(config["store"]["path"], create=False)
    past = store.artefacts()
    refs: dict[str, Ref] = {}
    found = []
    for node in graph.nodes.values():
        keyed = all(u.id in refs for u in node.upstream())
        ref = store.find(node.stage, key_of(job_of(node, refs, config, None))) if keyed else None
        if ref:
            refs[node.id] = ref
        found.append(Forecast(node, ref is not None, keyed, None if ref else expected(node, past)))
    return found


def expected(node: Node, past: list[Artefact]) -> Cost | None:
    """The median cost of the same function in the past: on the same data with the same settings, else on the same data,
    else on any."""
    same = [a for a in past if a.function == node.function]
    data = {case.split()[0] for case in node.cases}
    near = [a for a in same if a.case.split()[:1] and a.case.split()[0] in data]
    nearest = [a for a in near if a.settings == node.settings]
    chosen = nearest or near or same
    if not chosen:
        return None
    return Cost(
        seconds=median(a.seconds for a in chosen),
        peak_mb=median(a.peak_mb for a in chosen),
        size=median(a.size for a in chosen),
    )


def critical_path(forecasts: list[Forecast]) -> float:
    """Seconds of the longest chain of stages to compute: no number of workers makes it shorter."""
    until: dict[str, float] = {}
    for f in forecasts:
        own = f.cost.seconds if f.cost else 0.0
        until[f.node.id] = own + max((until[u.id] for u in f.node.upstream()), default=0.0)
    return max(until.values(), default=0.0)


def show(batch: Batch) -> None:
    """Prints the plan of a run: every stage to compute, sums by stage, and the whole."""
    graph, works = work(batch.experiments, batch.config["report"])
    forecasts = forecast(graph, batch.config)
    console = Console(highlight=False, soft_wrap=True)
    for f in forecasts:
        if not f.cached:
            node = f.node
            more = f" (+{len(node.cases) - 1} cases)" if len(node.cases) > 1 else ""
            console.print(f"to compute  {node.stage:<10} {short(node.cases)}{more}  {_said(f.cost)}", markup=False)
    console.print(_by_stage(forecasts))
    for experiment in batch.experiments:
        for what, why in experiment.not_run:
            console.print(f"{experiment.name}: not run: {what}, {why}", markup=False)
    console.print(_whole(forecasts, batch.config, len(works)), markup=False)


def _said(cost: Cost | None) -> str:
    if cost is None:
        return "unknown, never computed before"
    return f"{cost.seconds:.1f} s {cost.peak_mb:.0f} MB, {cost.size / 1e6:.1f} MB on disk"


def _by_stage(forecasts: list[Forecast]) -> Table:
    table = Table()
    table.add_column("stage")
    for name in ("cached", "to compute", "seconds", "peak MB", "MB on disk"):
        table.add_column(name, justify="right")
    for stage in dict.fromkeys(f.node.stage for f in forecasts):
        those = [f for f in forecasts if f.node.stage == stage]
        costs = [f.cost for f in those if f.cost]
        unknown = sum(not f.cached and f.cost is None for f in those)
        mark = f" + {unknown} unknown" if unknown else ""
        sums = (sum(c.seconds for c in costs), max((c.peak_mb for c in costs), default=0), sum(c.size for c in costs))
        numbers = [f"{sums[0]:.1f}{mark}", f"{sums[1]:.0f}", f"{sums[2] / 1e6:.1f}"] if costs else [mark[3:], "", ""]
        cached = sum(f.cached for f in those)
        table.add_row(stage, str(cached or ""), str(len(those) - cached or ""), *numbers)
    return table


def _whole(forecasts: list[Forecast], config: dict, reports: int) -> str:
    todo = [f for f in forecasts if not f.cached]
    if not todo:
        return f"all {len(forecasts)} stages are cached; the {_count(reports, 'report')} would be written anew"
    costs = [f.cost for f in todo if f.cost]
    seconds, size = sum(c.seconds for c in costs), sum(c.size for c in costs)
    workers = config["runner"]["workers"]
    least = max(seconds / workers, critical_path(forecasts))
    lines = [
        f"{_count(len(todo), 'stage')} to compute, {len(forecasts) - len(todo)} cached, {_count(reports, 'report')}",
        f"{_time(seconds)} of work, at least {_time(least)} with {_count(workers, 'worker')}; "
        f"up to {max((c.peak_mb for c in costs), default=0):.0f} MB in a process; {size / 1e6:.0f} MB on disk, "
        f"{_free(config['store']['path']) / 1e6:.0f} MB are free",
    ]
    if len(costs) < len(todo):
        lines.append(f"not in these sums: {_count(len(todo) - len(costs), 'stage')} never computed before")
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
