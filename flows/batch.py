"""What one command runs: an experiment, or several in one run that share stages, each with a report of its own."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from flows import compose, config, schema
from flows.config import Case, Missing
from flows.exhibits import plan_files, plan_pictures, plan_videos
from flows.graph import Graph, Node, union
from flows.pipeline import Output, Planned, plan
from tasks.errors import InputError

OF_THE_WHOLE = ("sweep.experiments", "report.name", "report.title")  # overrides that single experiments do not get


@dataclass(frozen=True)
class Experiment:
    """A report to be: its cases, what it goes without, and the arguments of ``flows.run`` that run it alone."""

    name: str
    title: str
    arguments: tuple[str, ...]
    cases: list[Case]
    missing: list[Missing] = field(default_factory=list)

    @property
    def not_run(self) -> list[tuple[str, str]]:
        """What is missing, those with one reason together, and why."""
        whys: dict[str, list[str]] = {}
        for one in self.missing:
            whys.setdefault(one.why, []).append(one.what)
        return [
            (f"{names[0]} and {len(names) - 1} more" if len(names) > 8 else ", ".join(names), why)
            for why, names in whys.items()
        ]


@dataclass(frozen=True)
class Batch:
    """The experiments of a run. config: of the run itself (store, runner, report); index: whether one page is to hold
    them all, and experiments without data are left out instead of being an error."""

    config: dict
    experiments: list[Experiment]
    index: bool


@dataclass(frozen=True)
class Work:
    """An experiment in the graph: its own nodes, and those its report reads."""

    experiment: Experiment
    graph: Graph
    planned: list[Planned]
    pictures: list[Node]
    files: list[Output]


def batch(overrides: list[str], multirun: bool = False) -> Batch:
    """The experiments of a command line. Raises InputError for a wrong key, type or choice."""
    whole = config.whole(overrides)
    flags = ("-m",) if multirun else ()
    names = schema.check(whole["sweep"], config.SWEEP, "sweep.")["experiments"]
    if not names:
        every = config.expand(overrides, multirun)
        cases, missing = _present(every)
        if not cases:
            do = "set data_root to the folder that holds it, or dataset.path"
            found = f"no {every[0].config['dataset']['path']}"
            raise InputError("dataset.path", expected="the file of at least one dataset", found=found, do=do)
        report = cases[0].config["report"]
        alone = Experiment(report["name"], report["title"], (*flags, *overrides), cases, missing)
        return Batch(cases[0].config, [alone], False)
    whole = schema.check_run(schema.check(whole, schema.schema(whole, config.SWEEP)))
    kept = [text for text in overrides if compose.parse(text).key_or_group not in (*OF_THE_WHOLE, "experiment")]
    used = set(overrides) - set(kept)
    experiments = []
    for name in names:
        own = [f"+experiment={name}", *kept]
        missing: list[Missing] = []
        cases, absent = _present(config.expand_some(own, multirun, used, missing))
        title = cases[0].config["report"]["title"] if cases else config.whole(own[:1])["report"]["title"]
        experiments.append(Experiment(name, title, (*flags, *own), cases, list(dict.fromkeys([*missing, *absent]))))
    if not any(experiment.cases for experiment in experiments):
        name, why = names[0], experiments[0].missing[0].why
        raise InputError("sweep.experiments", expected="data for one of them at least", found=f"none; {name}: {why}")
    config.check_used(kept, used, [case for experiment in experiments for case in experiment.cases])
    return Batch(whole, experiments, True)


def work(experiments: list[Experiment], report: dict) -> tuple[Graph, list[Work]]:
    """The stages of every experiment that has cases, and the graph of all of them in which equal stages are one.

    report: whether there are figures and videos."""
    files: dict[str, str] = {}
    works = []
    for experiment in experiments:
        if not experiment.cases:
            continue
        graph = Graph(files)
        planned = [plan(case, graph) for case in experiment.cases]
        pictures = plan_videos(planned, graph) if report["figures"] and report["videos"] else []
        pictures += plan_pictures(planned, graph) if report["figures"] else []
        works.append(Work(experiment, graph, planned, pictures, plan_files(planned, graph)))
    return union([w.graph for w in works]), works


def _present(cases: list[Case]) -> tuple[list[Case], list[Missing]]:
    """The cases whose file is there, and the datasets that the experiment does without."""
    absent = [case.config["dataset"] for case in cases if case.absent]
    missing = [Missing(Path(d["path"]).stem, "its file is absent", d["stands_for"]) for d in absent]
    return [case for case in cases if not case.absent], list(dict.fromkeys(missing))
