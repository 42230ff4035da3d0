"""The one Prefect flow: cases become a graph, every node a cached task, finished cases rows of a report."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from flows.config import Case
from flows.graph import Graph, Node, short
from flows.pipeline import Output, Planned, plan, plan_files, plan_pictures
from flows.progress import Progress
from flows.server import server
from flows.stage import Job, run
from flows.store import CorruptArtefact, Ref, Store
from tasks.errors import InputError

if TYPE_CHECKING:
    from flows.reporting import Report

ATTEMPTS = 3  # how often damaged artefacts are dropped and computed again before giving up


class StageFailed(Exception):
    """A stage that failed by a defect: its name, the cases that need it, and the original error as the cause."""


@dataclass
class Outcome:
    """What a run of the graph left: artefacts of the nodes that finished, errors of those that failed themselves."""

    refs: dict[str, Ref] = field(default_factory=dict)
    errors: dict[str, BaseException] = field(default_factory=dict)
    computed: set[str] = field(default_factory=set)


def run_sweep(cases: list[Case], show: bool = True) -> Path:
    """Runs all cases in one flow and writes the report; returns its folder.

    Raises InputError for bad data and StageFailed for a defect, after every stage that could run has run: what was
    finished stays in the store.
    """
    absent = list(dict.fromkeys(case.config["dataset"]["path"] for case in cases if case.absent))
    cases = [case for case in cases if not case.absent]
    if not cases:
        do = "set data_root to the folder that holds it, or dataset.path"
        raise InputError("dataset.path", expected="the file of at least one dataset", found=f"no {absent[0]}", do=do)
    config = cases[0].config
    Store(config["store"]["path"])  # a store that cannot be used is said before anything starts
    with server() as ready:
        graph = Graph()
        planned = [plan(case, graph) for case in cases]
        pictures = plan_pictures(planned, graph) if config["report"]["figures"] else []
        files = plan_files(planned, graph)
        ready()
        left_out = [f"Not run: {Path(path).stem}, for its file is absent." for path in absent]
        return Path(
            _flow(config, graph, planned, pictures, files, left_out, show)(config["report"]["name"], len(cases))
        )


def _flow(
    config: dict,
    graph: Graph,
    planned: list[Planned],
    pictures: list[Node],
    files: list[Output],
    notes: list[str],
    show: bool,
):
    """The flow of a sweep; its parameters are what the run's page shows."""
    from prefect import flow

    @flow(name=config["report"]["name"], task_runner=task_runner(config["runner"]), validate_parameters=False)
    def sweep(experiment: str, cases: int) -> str:
        from flows.artifacts import ProgressArtifact, publish

        bar = ProgressArtifact(experiment, len(graph.nodes))
        with Progress(graph, show, bar.update) as progress:
            for note in notes:
                progress.note(note)
            report, computed = _computed_report(config, graph, planned, pictures, files, notes, progress)
        publish(report.folder, report.tables)
        progress.finish(report.shown, report.folder, computed)
        return str(report.folder)

    return sweep


def _computed_report(
    config: dict,
    graph: Graph,
    planned: list[Planned],
    pictures: list[Node],
    files: list[Output],
    notes: list[str],
    progress: Progress,
) -> tuple[Report, int]:
    """The report and how many stages were computed for it."""
    from flows.reporting import write

    store = Store(config["store"]["path"])
    computed: set[str] = set()
    for attempt in range(1, ATTEMPTS + 1):
        outcome = compute(graph, config, progress)
        computed |= outcome.computed
        raise_first(graph, outcome)
        try:
            return write(planned, pictures, files, graph, outcome.refs, computed, store, notes), len(computed)
        except CorruptArtefact as error:
            if attempt == ATTEMPTS:
                raise
            store.drop(error.stage, error.key)
            progress.note(f"{error}: it is computed again")
    raise AssertionError("not reached")


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
    """One walk over the graph: a node is submitted when its inputs are there, so no worker waits for another."""
    from prefect.futures import as_completed

    task = stage_task()
    waiting = [n for n in graph.nodes.values() if n.id not in outcome.refs and n.id not in outcome.errors]
    running: dict[object, Node] = {}
    futures: dict[str, object] = {}
    with tempfile.TemporaryDirectory(prefix="skelebones-") as folder:
        events = str(Path(folder) / "events.jsonl")
        progress.follow(events)
        while waiting or running:
            for node in [n for n in waiting if all(u.id in outcome.refs for u in n.upstream())]:
                waiting.remove(node)
                job = _job(node, outcome.refs, config, events)
                named = task.with_options(name=node.stage, task_run_name=f"{node.stage} · {short(node.cases)}")
                future = named.submit(job, wait_for=[futures[u.id] for u in node.upstream() if u.id in futures])
                running[future] = node
                futures[node.id] = future
            if not running:
                return  # what still waits stands behind a failure
            future = next(iter(as_completed(list(running))))
            node = running.pop(future)
            _collect(future, node, outcome, progress)


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
        ref = run(job)
        if ref.cached:
            return Completed(name="Cached", message="taken from the store", data=ref_to_dict(ref))
        return ref_to_dict(ref)

    return stage


def raise_first(graph: Graph, outcome: Outcome) -> None:
    """Raises the first error of a stage that failed itself, in the order of the graph."""
    failed = [n for n in graph.nodes.values() if n.id in outcome.errors]
    if not failed:
        return
    node, error = failed[0], outcome.errors[failed[0].id]
    if isinstance(error, InputError):
        raise error
    more = f" ({len(failed) - 1} more stages failed)" if len(failed) > 1 else ""
    raise StageFailed(f"stage {node.stage} failed for {short(node.cases)}{more}: {error!r}") from error


def task_runner(settings: dict):
    """Prefect's own task runner of the kind that the config names."""
    from prefect.task_runners import ProcessPoolTaskRunner, ThreadPoolTaskRunner

    workers = settings["workers"]
    if workers < 1:
        raise InputError("runner.workers", expected="at least 1", found=str(workers))
    kinds = {"threads": ThreadPoolTaskRunner, "processes": ProcessPoolTaskRunner}
    return kinds[settings["kind"]](max_workers=workers)


def _job(node: Node, refs: dict[str, Ref], config: dict, events: str) -> Job:
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
        store=config["store"]["path"],
        events=events,
        max_gb=config["memory"]["max_gb"],
    )


def _forget(graph: Graph, outcome: Outcome, damaged: set[tuple[str, str]]) -> None:
    for node in graph.nodes.values():
        ref = outcome.refs.get(node.id)
        if ref and (ref.stage, ref.key) in damaged:
            del outcome.refs[node.id]
