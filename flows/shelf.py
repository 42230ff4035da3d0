"""Reports on the disk: read back, made again from their own numbers, collected on one page."""

from __future__ import annotations

from pathlib import Path

from flows import config
from flows.batch import Batch, Experiment
from flows.config import Case, Missing
from flows.contents import paper_numbers, places, tables_of
from flows.provenance import command
from flows.reporting import Report
from tasks.errors import InputError

PLACES = ("data_root", "store.path", "report.path", "runner", "runner.workers", "runner.address")  # change no number
COLLECTION = "paper"  # the experiment whose order and title the page of a folder of reports has


def read(folder: Path) -> Report:
    """A report as it was written, its tables made anew from metrics.csv. Raises InputError where one of its files
    cannot be read."""
    from tasks.reporting import report
    from tasks.reporting.rows import from_csv

    origin = report.read_provenance(folder)
    if "missing" not in origin:
        do = f"run it again: {' '.join(origin.get('command', []))}"
        raise InputError(str(folder), expected="a report of this version", found="an older one", do=do)
    try:
        rows = from_csv((folder / "metrics.csv").read_text("utf-8"), str(folder / "metrics.csv"))
        figures = report.read_figures(folder, origin)
    except OSError as error:
        raise InputError(str(error.filename), expected="a file of the report", found=str(error.strerror)) from error
    cases = [Case(**case) for case in origin["cases"]]
    missing = [Missing(**one) for one in origin["missing"]]
    arguments = tuple(origin["command"][3:])
    experiment = Experiment(folder.name, cases[0].config["report"]["title"], arguments, cases, missing)
    tables = tables_of(cases, rows, origin["remarks"], origin["said"])
    return Report(experiment, folder, rows, tables, list(figures.items()), cases, origin)


def made_again(folder: Path) -> dict[str, bytes]:
    """The files of a report but its provenance, made anew from its metrics.csv, provenance.json and figures."""
    from tasks.reporting import report

    found = read(folder)
    return report.contents(folder.name, found.rows, found.tables, dict(found.figures), found.provenance)


def render_again(folder: Path) -> int:
    """Writes the files of :func:`made_again` over a report's own; returns how many changed."""
    from tasks.reporting import report

    return report.replace_files(folder, made_again(folder))


def index_batch(batch: Batch, reports: list[Report]) -> Path:
    """Writes the page of a run, which also names the experiments that have no report. Returns its path."""
    by_name = {r.experiment.name: r for r in reports}
    every = [by_name.get(e.name, Report(e)) for e in batch.experiments]
    settings = batch.config["report"]
    return _write_index(Path(settings["path"]).expanduser(), settings["title"], every)


def index_folder(folder: Path) -> Path:
    """Writes the page of all reports that lie in a folder, whichever runs they are from, and names the collection's
    experiments that have none there. Returns its path."""
    collection = config.whole([f"+experiment={COLLECTION}"])
    order = collection["sweep"]["experiments"]
    found = [read(file.parent) for file in sorted(folder.glob("*/provenance.json"))]
    if not found:
        raise InputError(str(folder), expected="a folder of reports", found="none in it")
    there = {r.experiment.name for r in found}
    found += [_absent(name, folder) for name in order if name not in there]
    found.sort(key=lambda r: order.index(r.experiment.name) if r.experiment.name in order else len(order))
    return _write_index(folder, collection["report"]["title"], found)


def _absent(name: str, folder: Path) -> Report:
    """An experiment that has no report in a folder."""
    arguments = (f"+experiment={name}",)
    title = config.whole(list(arguments))["report"]["title"]
    return Report(
        Experiment(name, title, arguments, [], [Missing("the experiment", f"no report in {folder.name}/{name}")])
    )


def _write_index(folder: Path, title: str, reports: list[Report]) -> Path:
    from tasks.reporting import coverage, index, report

    made = [r for r in reports if r.folder]
    measured = [
        coverage.Measured(r.cases[0].config["report"]["paper_table"], r.rows, *places(r.cases, r.rows))
        for r in made
        if r.cases[0].config["report"]["paper_table"]
    ]
    absent = {m.stands_for: m.why for r in reports for m in r.experiment.missing if m.stands_for}
    origin = made[0].provenance if made else {}
    sections = [
        index.Section(
            name=r.experiment.name,
            title=r.experiment.title,
            command=command(r.experiment.arguments),
            tables=r.tables,
            figures=[picture for _, picture in r.figures],
            missing=r.experiment.not_run,
            paper_table=r.cases[0].config["report"]["paper_table"] if r.folder else None,
            remarks=_remarks(r, origin),
        )
        for r in reports
    ]
    covered = coverage.cover(paper_numbers(), measured, absent)
    page = index.html(title, sections, covered, origin, coverage.claims(paper_numbers(), covered))
    report.write_page(folder / "index.html", page)
    return folder / "index.html"


def _remarks(report: Report, first: dict) -> list[str]:
    """What sets a report apart from the first one on the page, and from its experiment as it stands in conf/."""
    if not report.folder:
        return []
    said = []
    git, other = report.provenance.get("git", {}), first.get("git", {})
    if git.get("commit") != other.get("commit"):
        said.append(f"Made at another commit than the reports above: {git.get('commit', 'unknown')[:12]}.")
    if report.provenance.get("machine") != first.get("machine"):
        said.append("Made on another machine than the reports above.")
    own = [a for a in report.experiment.arguments[1:] if a.partition("=")[0] not in PLACES]
    if own:
        said.append(f"Not the whole experiment, or another one: it was run with {' '.join(own)}.")
    return said
