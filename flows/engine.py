"""Every node of a graph to the store: each stage a Prefect task, handed to a worker as soon as its inputs are there."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass, field
from pathlib import Path

from flows.cache import CorruptArtefact, Ref, Store
from flows.costs import Past, chains
from flows.graph import Graph, Node, short
from flows.progress import Progress
from flows.runners import WorkerLost, in_flight, of_a_lost_worker
from flows.server import watched
from flows.stage import Job, key_of, run
from flows.stopping import stoppable

ATTEMPTS = 3  # how often damaged artefacts, or what a killed worker left, are computed again before giving up


@dataclass
class Outcome:
    """What a run of the graph left: artefacts of the nodes that finished, errors of those that failed themselves."""

    refs: dict[str, Ref] = field(default_factory=dict)
    errors: dict[str, BaseException] = field(default_factory=dict)
    computed: set[str] = field(default_factory=set)


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
        except Exception as error:
            if of_a_lost_worker(error):
                raise WorkerLost(progress.running()) from error
            raise


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
