"""The one Prefect flow: cases become a graph, every node a cached task, finished cases rows of a report."""

from __future__ import annotations

import os
import shlex
import tempfile
from concurrent.futures import BrokenExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

from flows.artifacts import Board
from flows.batch import Batch, Work, work
from flows.config import Missing
from flows.costs import Past, chains
from flows.graph import Graph, Node, short
from flows.progress import Progress
from flows.runners import WorkerLost, in_flight, task_runner
from flows.server import lost, server, watched
from flows.stage import Job, key_of, run
from flows.stopping import stoppable
from flows.store import CorruptArtefact, Ref, Store
from tasks.errors import InputError

if TYPE_CHECKING:
    from flows.reporting import Report

ATTEMPTS = 3  # how often damaged artefacts, or what a killed worker left, are computed again before giving up


class StageFailed(Exception):
    """A stage that failed by a defect: its name, the cases that need it, and the original error as the cause."""


@dataclass
class Outcome:
    """What a run of the graph left: artefacts of the nodes that finished, errors of those that failed themselves."""

    refs: dict[str, Ref] = field(default_factory=dict)
    errors: dict[str, BaseException] = field(default_factory=dict)
    computed: set[str] = field(default_factory=set)


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


def compute(graph: Graph, config: dict, progress: Progress) -> Outcome:
    """Brings every node of the graph to the store; damaged artefacts that come to light are computed again."""
    outcome = Outcome()
    for _ in range(ATTEMPTS):
        _pass(graph, config, progress, outcome)
        damaged = {n: e for n, e in outcome.errors.items() if isinstance(e, CorruptArtefact)}
        if not damaged:
            break
        store = Store(config["store"]["path"])
        for node, error in damaged.items():
            store.drop(error.stage, error.key)
            del outcome.errors[node]
            progress.note(f"{error}: it is computed again")
        _forget(graph, outcome, {(e.stage, e.key) for e in damaged.values()})
    return outcome


def _pass(graph: Graph, config: dict, progress: Progress, outcome: Outcome) -> None:
    """Hands every stage to a worker as soon as its inputs are there, so no worker waits for another, and first
    the one that begins the longest chain, so that no long stage is left to the end. Raises WorkerLost."""
    past = Past(Store(config["store"]["path"]))
    first = chains(graph, {n.id: past.seconds(n) for n in graph.nodes.values()})
    waiting = [n for n in graph.nodes.values() if n.id not in outcome.refs and n.id not in outcome.errors]
    waiting.sort(key=lambda n: -first[n.id])
    with tempfile.TemporaryDirectory(prefix="skelebones-") as folder, stoppable(folder):
        events = str(Path(folder) / "events.jsonl")
        progress.follow(events)
        try:
            _hand_out(waiting, config, events, progress, outcome)
        except BrokenExecutor as error:
            raise WorkerLost(progress.running()) from error


def _hand_out(waiting: list[Node], config: dict, events: str, progress: Progress, outcome: Outcome) -> None:
    """Runs the stages in the order given, each once what it needs is there. Where nobody can look at Prefect's pages,
    what is cached is taken at once, without a task run of its own."""
    from prefect.futures import as_completed

    task, store, shown = stage_task(), Store(config["store"]["path"]), watched()
    most = in_flight(config["runner"])
    running: dict[object, Node] = {}
    futures: dict[str, object] = {}
    while waiting or running:
        found = False
        for node in [n for n in waiting if all(u.id in outcome.refs for u in n.upstream())]:
            if len(running) >= most:
                break
            waiting.remove(node)
            job = job_of(node, outcome.refs, config, events)
            cached = None if shown else store.find(job.stage, key_of(job))
            if cached:
                found = True
                outcome.refs[node.id] = cached
                progress.done(node, cached)
                continue
            title = f"{node.title}: {short(node.cases)}".replace("{", "{{").replace("}", "}}")  # Prefect formats it
            named = task.with_options(name=node.stage, task_run_name=title)
            future = named.submit(job, wait_for=[futures[u.id] for u in node.upstream() if u.id in futures])
            running[future] = node
            futures[node.id] = future
        if found:
            continue  # what stands behind them may be ready now
        if not running:
            return  # what still waits stands behind a failure
        future = next(iter(as_completed(list(running))))
        _collect(future, running.pop(future), outcome, progress)


def _collect(future, node: Node, outcome: Outcome, progress: Progress) -> None:
    result = future.result(raise_on_failure=False)
    if isinstance(result, dict):
        ref = Ref(**result)
        outcome.refs[node.id] = ref
        if not ref.cached:
            outcome.computed.add(node.id)
        progress.done(node, ref)
    else:
        outcome.errors[node.id] = result
        progress.failed(node, result)


def stage_task():
    """The Prefect task that every stage runs in; its final state is named Cached when the store had the result."""
    from prefect import task
    from prefect.states import Completed

    from flows.stage import ref_to_dict

    @task(persist_result=False, retries=0)
    def stage(job: Job):
        from flows.artifacts import StageBar

        ref = run(job, StageBar(job.stage, job.case).say)
        if ref.cached:
            return Completed(name="Cached", message="taken from the store", data=ref_to_dict(ref))
        return ref_to_dict(ref)

    return stage


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


def job_of(node: Node, refs: dict[str, Ref], config: dict, events: str | None) -> Job:
    """The node's work, once the artefacts of its inputs are known."""
    store = Store(config["store"]["path"], create=False).path.absolute()  # a worker may stand in another folder

    def resolve(value):
        if isinstance(value, dict):
            return {n: resolve(v) for n, v in value.items()}
        upstream, output = value
        return refs[upstream.id], output

    inputs = {n: resolve(v) for n, v in node.inputs.items()}
    return Job(
        stage=node.stage,
        function=node.function,
        outputs=node.outputs,
        settings=node.settings,
        inputs=inputs,
        source=node.source,
        files=node.files,
        case=short(node.cases),
        store=str(store),
        events=events,
        max_gb=config["memory"]["max_gb"],
    )


def _forget(graph: Graph, outcome: Outcome, damaged: set[tuple[str, str]]) -> None:
    for node in graph.nodes.values():
        ref = outcome.refs.get(node.id)
        if ref and (ref.stage, ref.key) in damaged:
            del outcome.refs[node.id]
