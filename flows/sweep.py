"""The one Prefect flow: cases become a graph, every node a cached task, finished cases rows of a report."""

from __future__ import annotations

import os
import shlex
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from flows.artifacts import Board
from flows.batch import Batch, Work, work
from flows.cache import CorruptArtefact, Store
from flows.config import Missing
from flows.engine import ATTEMPTS, Outcome, compute
from flows.graph import Graph, Node, short
from flows.progress import Progress
from flows.runners import WorkerLost, task_runner
from flows.server import lost, server
from flows.stopping import stoppable
from tasks.errors import InputError

if TYPE_CHECKING:
    from flows.reporting import Report


class StageFailed(Exception):
    """A stage that failed by a defect: its name, the cases that need it, and the original error as the cause."""


def run_batch(batch: Batch, show: bool = True) -> Path:
    """Runs all cases of all experiments in one flow and writes the reports; returns the report's folder, or the index.

    Raises InputError for bad data and StageFailed for a defect, after every stage that could run has run: what was
    finished stays in the store. Where there is an index, an experiment whose data is bad is left out and says why.
    What a killed worker left unfinished runs again; raises WorkerLost where workers are killed time and again.
    """
    config = batch.config
    Store(config["store"]["path"])  # a store or a place for reports that cannot be used is said before anything starts
    for name in (experiment.name for experiment in batch.experiments):
        check_place(Path(config["report"]["path"]).expanduser() / name)
    with stoppable(), server() as ready:
        graph, works = work(batch.experiments, config["report"])
        ready()
        for attempt in range(1, ATTEMPTS + 1):
            try:
                return _written_by_flow(batch, graph, works, show)
            except WorkerLost as error:  # its pool is of no use any more, a new flow has a new one
                if attempt == ATTEMPTS:
                    raise
                if show:
                    print(
                        f"a worker was killed while it ran {'; '.join(error.stages)}: what is not finished runs again"
                    )
    raise AssertionError("not reached")


def _written_by_flow(batch: Batch, graph: Graph, works: list[Work], show: bool) -> Path:
    """The place of what one run of the flow wrote."""
    flow, written = _flow(batch, graph, works, show)
    try:
        flow(batch.config["report"]["name"], sum(len(experiment.cases) for experiment in batch.experiments))
    except Exception:
        if not (written and lost.is_set()):  # else only the end of the run could not be told to the server
            raise
    return written[0]


def check_place(folder: Path) -> None:
    """Raises InputError where no report can be written; makes nothing, for a run that fails is to leave no trace."""
    try:
        there = next(p for p in (folder.absolute(), *folder.absolute().parents) if p.exists())
    except OSError as error:  # a name that no disk takes
        raise InputError(
            "report.name", expected="a folder that can be written", found=error.strerror or str(error)
        ) from None
    if not (there.is_dir() and os.access(there, os.W_OK | os.X_OK)):
        found = "no permission to write" if there.is_dir() else "a file"
        raise InputError("report.path", expected="a folder that can be written", found=f"{found}: {there}")


def _flow(batch: Batch, graph: Graph, works: list[Work], show: bool):
    """The flow of a sweep, its parameters are what the run's page shows; and where the report's place will be."""
    from prefect import flow

    config = batch.config
    written: list[Path] = []

    @flow(name=config["report"]["name"], task_runner=task_runner(config["runner"]), validate_parameters=False)
    def sweep(experiment: str, cases: int) -> None:
        from rich.text import Text

        from flows.shelf import index_batch

        progress = Progress(graph, show)  # made here, since Prefect pickles the flow's closure for worker processes
        board = Board(experiment, graph, progress.note)
        progress.tell = board.update
        board.start()
        with progress, stoppable():
            for what, why in (pair for experiment in batch.experiments for pair in experiment.not_run):
                progress.note(f"not run: {what}, {why}")
            outcome, reports = _computed_reports(batch, graph, works, progress, board)
        for report in [r for r in reports if r.folder]:
            board.publish(report.folder, report.markdown)
        if batch.index:
            if not any(report.folder for report in reports):
                raise_first(graph, outcome)
            place = index_batch(batch, reports)
            progress.finish([Text(report.line) for report in reports], place, len(outcome.computed))
            raise_first(graph, outcome, pardoned=InputError)
            written.append(place)
            return
        progress.finish(reports[0].shown, reports[0].folder, len(outcome.computed))
        written.append(reports[0].folder)

    return sweep, written


def _computed_reports(
    batch: Batch, graph: Graph, works: list[Work], progress: Progress, board: Board
) -> tuple[Outcome, list[Report]]:
    """The reports that could be written, and what became of the stages."""
    store = Store(batch.config["store"]["path"])
    computed: set[str] = set()
    for attempt in range(1, ATTEMPTS + 1):
        outcome = compute(graph, batch.config, progress)
        outcome.computed |= computed
        for node in failed(graph, outcome):
            command = _command(node, works)
            board.failure(node.title, node.cases, outcome.errors[node.id], command)
            progress.note(f"run it alone: {command}")
        if not batch.index:
            raise_first(graph, outcome)
        try:
            return outcome, _written(works, outcome, store)
        except CorruptArtefact as error:
            if attempt == ATTEMPTS:
                raise
            store.drop(error.stage, error.key)
            computed = outcome.computed
            progress.note(f"{error}: it is computed again")
    raise AssertionError("not reached")


def _written(works: list[Work], outcome: Outcome, store: Store) -> list[Report]:
    """The reports of the experiments that have finished cases; cases that have not are missing, with the reason."""
    from flows.reporting import Report, write

    reports = []
    for one in works:
        done, missing = [], list(one.experiment.missing)
        for planned in one.planned:
            heads = [*planned.metrics, *planned.beside.values(), planned.nodes["about"][0]]
            errors = [outcome.errors[n.id] for head in heads for n in head.walk() if n.id in outcome.errors]
            if errors:
                why = str(errors[0]) if isinstance(errors[0], InputError) else f"failed: {errors[0]!r}"
                missing.append(Missing(planned.name, why, planned.case.config["dataset"]["stands_for"]))
            else:
                done.append(planned)
        pictures = [node for node in one.pictures if node.id in outcome.refs]
        files = [output for output in one.files if output[0].id in outcome.refs]
        finished = replace(
            one, experiment=replace(one.experiment, missing=missing), planned=done, pictures=pictures, files=files
        )
        if done:
            reports.append(write(finished, outcome.refs, outcome.computed, store))
        else:
            reports.append(Report(finished.experiment))
    return reports


def _command(node: Node, works: list[Work]) -> str:
    """The command that runs one case of a node by itself."""
    planned = next(one.planned for one in works if node.id in one.graph.nodes)
    case = next((p.case for p in planned if {p.name, p.case.data} & set(node.cases)), planned[0].case)
    return shlex.join(["python", "-m", "flows.run", *case.alone])


def failed(graph: Graph, outcome: Outcome) -> list[Node]:
    """The stages that failed themselves, in the order of the graph."""
    return [n for n in graph.nodes.values() if n.id in outcome.errors]


def raise_first(graph: Graph, outcome: Outcome, pardoned: type[Exception] | tuple = ()) -> None:
    """Raises the first error of a stage that failed itself, but none of the pardoned."""
    nodes = [n for n in failed(graph, outcome) if not isinstance(outcome.errors[n.id], pardoned)]
    if not nodes:
        return
    node, error = nodes[0], outcome.errors[nodes[0].id]
    if isinstance(error, InputError):
        raise error
    more = f" ({len(nodes) - 1} more stages failed)" if len(nodes) > 1 else ""
    raise StageFailed(f"stage {node.title} failed for {short(node.cases)}{more}: {error!r}") from error
