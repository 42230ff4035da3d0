"""Graph, cache and faults, on toy stages and a real Prefect flow."""

from __future__ import annotations

import json
import os
from concurrent.futures.process import BrokenProcessPool
from dataclasses import fields
from pathlib import Path
from types import SimpleNamespace

import pytest

from flows import source, stage
from flows.cache import CorruptArtefact, Store
from flows.engine import compute
from flows.graph import Graph, digest_of_files, short
from flows.progress import Progress
from flows.runners import WorkerLost, of_a_lost_worker, task_runner
from flows.stage import Job, key_of, run
from flows.sweep import StageFailed, check_place, raise_first
from tasks.errors import InputError
from tasks.values import Training
from tasks.workspace import Workspace

TOY = "tests.workflow.toy"


class World:
    """A store, a log of the stage bodies that ran, and graphs to run."""

    def __init__(self, folder: Path, kind: str = "threads") -> None:
        self.folder = folder
        self.log = str(folder / "log.txt")
        self.config = {
            "store": {"path": str(folder / "store")},
            "runner": {"kind": kind, "workers": 2},
            "memory": {"max_gb": None},
        }
        self.store = Store(folder / "store")

    def graph(self, *values: float, tail: str | None = None) -> Graph:
        """make -> double and make -> sign -> double for every value; tail: one more stage at the end."""
        graph = Graph()
        for value in values:
            self.chain(graph, value, tail)
        return graph

    def chain(self, graph: Graph, value: float, tail: str | None) -> None:
        def add(stage, name, settings, **inputs):
            function = f"{TOY}:{name}"
            settings = settings | {"log": self.log}
            return graph.add(stage, function, settings, outputs=("out",), case=f"case {value}", **inputs)["out"]

        made = add("make", "make", {"value": value})
        add("double", "double", {}, source=made)
        signed = add("sign", "sign", {}, source=made)
        last = add("after", "double", {}, source=signed)
        if tail:
            settings = {"refuse": {"path": "/somewhere/file.npz"}, "slow": {"seconds": 0.1}}.get(tail, {})
            add(tail, tail, settings, source=last)

    def run(self, graph: Graph):
        """Runs a graph inside a flow."""
        from prefect import flow

        @flow(name="toy", task_runner=task_runner(self.config["runner"]))
        def toy():
            self.outcome = compute(graph, self.config, Progress(graph, show=False))

        toy()
        return self.outcome

    def bodies(self) -> list[str]:
        """The stage bodies that ran since the last call."""
        path = Path(self.log)
        lines = path.read_text().splitlines() if path.exists() else []
        path.unlink(missing_ok=True)
        return lines


@pytest.fixture
def world(tmp_path, prefect_server) -> World:
    return World(tmp_path)


def test_equal_stages_of_two_cases_are_one_node(tmp_path):
    graph = Graph()
    one = graph.add("make", f"{TOY}:make", {"value": 1}, outputs=("out",), case="a")
    two = graph.add("make", f"{TOY}:make", {"value": 1}, outputs=("out",), case="b")
    other = graph.add("make", f"{TOY}:make", {"value": 2}, outputs=("out",), case="b")
    assert one is two
    assert one.cases == ["a", "b"]
    assert other is not one


def test_second_run_computes_nothing(world):
    first = world.run(world.graph(3.0))
    assert len(first.computed) == 4
    assert sorted(world.bodies()) == ["double", "double", "make 3.0", "sign"]
    second = world.run(world.graph(3.0))
    assert second.computed == set()
    assert world.bodies() == []
    assert {n: r.outputs for n, r in first.refs.items()} == {n: r.outputs for n, r in second.refs.items()}


def test_equal_content_upstream_re_runs_nothing_after_it(world):
    world.run(world.graph(3.0))
    world.bodies()
    world.run(world.graph(4.0))  # its sign is the same as that of 3
    assert sorted(world.bodies()) == ["double", "make 4.0", "sign"]


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="kill -9 is POSIX's")
def test_a_killed_worker_is_named_and_the_next_run_goes_on(tmp_path, prefect_server, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(source.ROOT))  # for worker processes
    world = World(tmp_path, "processes")
    with pytest.raises(WorkerLost, match=r"fatal \(case 3.0\).*the same command goes on") as caught:
        world.run(world.graph(3.0, tail="fatal"))
    assert caught.value.stages == ["fatal (case 3.0)"]
    assert sorted(world.bodies()) == ["double", "double", "fatal", "make 3.0", "sign"]
    (tmp_path / "log.txt").write_text("fatal\n")
    assert world.run(world.graph(3.0, tail="fatal")).computed
    assert world.bodies() == ["fatal", "fatal"]


def test_what_dask_and_ray_say_of_a_lost_worker_is_understood():
    killed = type("KilledWorker", (Exception,), {"__module__": "distributed.scheduler"})
    raylet = type("LocalRayletDiedError", (Exception,), {"__module__": "ray.exceptions"})
    assert of_a_lost_worker(killed("x"))
    assert of_a_lost_worker(type("More", (raylet,), {})())
    assert of_a_lost_worker(BrokenProcessPool())
    assert not of_a_lost_worker(type("KilledWorker", (Exception,), {})())
    assert not of_a_lost_worker(ValueError("a defect of ours"))


def test_changed_setting_re_runs_only_what_follows(world):
    world.run(world.graph(3.0, tail="slow"))
    world.bodies()
    graph = world.graph(3.0, tail="slow")
    node = next(n for n in graph.nodes.values() if n.stage == "slow")
    node.settings["seconds"] = 0.2
    outcome = world.run(graph)
    assert [graph.nodes[i].stage for i in outcome.computed] == ["slow"]


def test_damaged_artefact_is_computed_again(world):
    outcome = world.run(world.graph(3.0))
    before = {n: r.outputs for n, r in outcome.refs.items()}
    world.bodies()
    make = next(r for r in outcome.refs.values() if r.stage == "make")
    sign = next(r for r in outcome.refs.values() if r.stage == "sign")
    file = world.store.folder("make", make.key) / "out.safetensors"
    data = bytearray(file.read_bytes())
    data[-1] ^= 1
    file.write_bytes(bytes(data))
    world.store.drop("sign", sign.key)  # so that somebody reads the damaged one
    outcome = world.run(world.graph(3.0))
    assert sorted(world.bodies()) == ["make 3.0", "sign"]
    assert {n: r.outputs for n, r in outcome.refs.items()} == before


def test_first_real_failure_is_named(world):
    graph = world.graph(3.0, tail="defect")
    outcome = world.run(graph)
    assert len(outcome.refs) == 4  # what does not depend on the failure has run
    with pytest.raises(StageFailed, match=r"stage defect failed for case 3\.0.*a defect in the stage") as caught:
        raise_first(graph, outcome)
    assert isinstance(caught.value.__cause__, ZeroDivisionError)


def test_bad_input_keeps_its_one_line(world):
    graph = world.graph(3.0, tail="refuse")
    outcome = world.run(graph)
    with pytest.raises(InputError, match=r"file.npz: expected something good, found something bad; mend it"):
        raise_first(graph, outcome)


@pytest.mark.slow
def test_processes_give_the_same(tmp_path, prefect_server):
    threads, processes = World(tmp_path / "t"), World(tmp_path / "p", "processes")
    one = threads.run(threads.graph(1.0, 2.0))
    two = processes.run(processes.graph(1.0, 2.0))
    assert len(two.computed) == len(one.computed)
    assert sorted(map(str, (r.outputs for r in one.refs.values()))) == sorted(
        map(str, (r.outputs for r in two.refs.values()))
    )


def job(folder: Path, **changes) -> Job:
    base = {
        "stage": "make",
        "function": f"{TOY}:make",
        "outputs": ("out",),
        "settings": {"value": 1.0, "log": str(folder / "log.txt")},
        "inputs": {},
        "source": "s",
        "files": "",
        "case": "case",
        "store": str(folder / "store"),
    }
    return Job(**(base | changes))


def test_key_ignores_names_and_places_and_heeds_content(tmp_path):
    key = key_of(job(tmp_path))
    assert key == key_of(job(tmp_path, case="another", store="elsewhere"))
    assert key == key_of(job(tmp_path, settings={"value": 1, "log": str(tmp_path / "log.txt")}))
    assert key != key_of(job(tmp_path, settings={"value": 2.0, "log": str(tmp_path / "log.txt")}))
    assert key != key_of(job(tmp_path, function=f"{TOY}:double"))
    assert key != key_of(job(tmp_path, source="another"))
    place = {"value": 1.0, "log": "", "path": "/a/x.npz"}
    moved = {"value": 1.0, "log": "", "path": "/b/x.npz"}
    assert key_of(job(tmp_path, settings=place, files="d")) == key_of(job(tmp_path, settings=moved, files="d"))
    assert key_of(job(tmp_path, settings=place, files="d")) != key_of(job(tmp_path, settings=place, files="e"))


def _forget_sources() -> None:
    for cached in (source.digest, source._code, source._tree, source._source):
        cached.cache_clear()


def test_source_digest_heeds_code_not_comments(tmp_path, monkeypatch):
    package = tmp_path / "tasks"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "one.py").write_text("from tasks.two import b\n\ndef a():\n    '''Says a.'''\n    return b()\n")
    two = package / "two.py"
    monkeypatch.setattr(source, "ROOT", tmp_path)

    def digest(text: str) -> str:
        two.write_text(text)
        _forget_sources()
        return source.digest("tasks.one")

    first = digest("def b():\n    return 1\n")
    assert digest("# why\ndef b():\n    '''One.'''\n    return 1  # one\n") != digest("def b():\n    return 2\n")
    assert digest("def b():  # a comment\n    return 1\n") == first
    _forget_sources()


def test_lock_waits_for_an_equal_job(tmp_path):
    assert run(job(tmp_path)).cached is False
    assert run(job(tmp_path)).cached is True


def test_missing_input_of_a_stage_is_a_damaged_artefact(tmp_path):
    ref = run(job(tmp_path))
    (tmp_path / "store" / "make" / ref.key / "out.safetensors").unlink()
    settings = {"log": str(tmp_path / "log.txt")}
    with pytest.raises(CorruptArtefact):
        run(job(tmp_path, stage="double", function=f"{TOY}:double", settings=settings, inputs={"source": (ref, "out")}))


def test_long_stage_goes_on_from_its_workspace(tmp_path):
    ref = run(job(tmp_path))
    inputs = {"source": (ref, "out")}
    settings = {"log": str(tmp_path / "log.txt"), "die_at": 2}
    events = str(tmp_path / "events.jsonl")
    long = job(tmp_path, stage="long", function=f"{TOY}:long", settings=settings, inputs=inputs, events=events)
    with pytest.raises(ZeroDivisionError):
        run(long)
    assert not run(long).cached
    steps = [line for line in (tmp_path / "log.txt").read_text().splitlines() if line.startswith("step")]
    assert steps == ["step 0", "step 1", "step 2", "step 3"]
    told = [json.loads(line) for line in (tmp_path / "events.jsonl").read_text().splitlines()]
    assert [e["fraction"] for e in told if e["event"] == "progress"] == [0.0, 0.25, 0.5, 0.75]
    assert not list((tmp_path / "store").rglob("*.part"))


def test_data_that_may_not_be_read_is_one_line(tmp_path, monkeypatch):
    (tmp_path / "own.npz").write_bytes(b"1")

    def refuse(file, *_):
        raise PermissionError(13, "Permission denied", str(file))

    monkeypatch.setattr("builtins.open", refuse)
    for path in (tmp_path, tmp_path / "own.npz"):
        with pytest.raises(InputError, match=r"Permission denied \(own\.npz\)"):
            digest_of_files(str(path))


def test_a_method_may_name_its_types_in_any_way():
    """Types are text or, without the future import, objects: what a method learns from is known by its parts."""
    parts = {f.name: (None, f.name) for f in fields(Training)}
    store = SimpleNamespace(load=lambda ref, output: output)
    assert stage._load(store, parts) == Training(**{name: name for name in parts})
    assert stage._load(store, {"run_0": (None, "metrics")}) == {"run_0": "metrics"}


def test_memory_cap_is_one_clear_line(tmp_path):
    with pytest.raises(InputError, match=r"memory.max_gb.*at most 0.001 GB"):
        Workspace(tmp_path, max_gb=0.001).say("anything", 0.0)
    Workspace(tmp_path).say("anything", 0.0)


def test_a_place_where_no_report_can_lie_is_said_before_anything_runs(tmp_path):
    check_place(tmp_path / "new" / "reports")
    assert not list(tmp_path.iterdir())
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match=r"report.path.*a file"):
        check_place(tmp_path / "file" / "reports")
    with pytest.raises(InputError, match=r"report\.name"):
        check_place(tmp_path / ("x" * 300))


def test_short_names():
    assert short(["horse lbs"]) == "horse lbs"
    assert short(["horse lbs", "horse partmm k_1"]) == "horse"
    assert short(["horse lbs", "cat lbs"]) == "horse lbs and 1 more"
