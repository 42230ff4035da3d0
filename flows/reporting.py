"""From artefacts to a report: rows, tables, figures and provenance of the finished cases."""

from __future__ import annotations

import re
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from flows.cache import Ref, Store
from flows.config import Case
from flows.contents import charts_of, tables_of, variant_of
from flows.pipeline import Planned
from flows.provenance import provenance

if TYPE_CHECKING:
    import pandas as pd

    from flows.batch import Experiment, Work
    from tasks.reporting.tables import Table
    from tasks.values import Picture


@dataclass(frozen=True)
class Report:
    """A written report; without a folder, of an experiment that had nothing to write. figures: (subject, picture)."""

    experiment: Experiment
    folder: Path | None = None
    rows: pd.DataFrame | None = None
    tables: list[Table] = field(default_factory=list)
    figures: list[tuple[str, Picture]] = field(default_factory=list)
    cases: list[Case] = field(default_factory=list)
    provenance: dict = field(default_factory=dict)

    @property
    def markdown(self) -> str:
        """The tables for Prefect's page."""
        from tasks.reporting import typeset

        return "\n".join(typeset.markdown(t) for t in self.tables)

    @property
    def shown(self) -> list:
        """The tables for the terminal, without details."""
        from tasks.reporting import typeset

        return [typeset.terminal(t) for t in self.tables if not t.folded]

    @property
    def line(self) -> str:
        """The report in a line, for the terminal."""
        said = [f"report in {self.folder}"] if self.folder else []
        said += [f"not run: {what}: {why}" for what, why in self.experiment.not_run]
        return f"{self.experiment.name}: {'; '.join(said)}"


def write(work: Work, refs: dict[str, Ref], computed: set[str], store: Store) -> Report:
    """Writes a report's folder."""
    from tasks.reporting import report
    from tasks.reporting.rows import join

    planned, cases = work.planned, [p.case for p in work.planned]
    settings = cases[0].config["report"]
    rows = join([_rows(p, refs, store) for p in planned])
    about = [_about(p, refs, store) for p in planned]
    about += [
        store.load(refs[n.id], o) for n, o in (p.nodes["driven_about"] for p in planned if "driven_about" in p.nodes)
    ]
    remarks = list(dict.fromkeys(f"{a.name}: {note}." for a in about for note in a.notes))
    said = [f"Not run: {what}, {why}." for what, why in work.experiment.not_run] + _fit_notes(planned, refs)
    tables = tables_of(cases, rows, remarks, said)
    figures = [(node.cases[0], store.load(refs[node.id], "picture")) for node in work.pictures]
    figures += charts_of(cases, rows)
    folder = Path(settings["path"]).expanduser() / settings["name"]
    origin = provenance(work.experiment.arguments, cases, work.graph, refs, computed)
    origin |= {"remarks": remarks, "said": said, "missing": [asdict(one) for one in work.experiment.missing]}
    brought = [store.load(refs[node.id], output) for node, output in work.files]
    report.write_report(folder, rows, tables, figures, origin, brought)
    return Report(work.experiment, folder, rows, tables, figures, cases, origin)


def _rows(case: Planned, refs: dict[str, Ref], store: Store):
    from tasks.reporting.rows import join, rows_of

    config = case.case.config
    labels = {
        "experiment": config["report"]["name"],
        "dataset": case.case.dataset,
        "subject": _subject(case, refs, store),
        "method": case.case.method,
        "variant": variant_of(case.case),
        "seed": case.case.seed,
    }

    def rows(node, **other) -> pd.DataFrame:
        ref = refs[node.id]
        return rows_of(store.load(ref, "metrics"), key=ref.key, **(labels | other))

    beside = [
        rows(node, variant=", ".join(filter(None, [labels["variant"], name]))) for name, node in case.beside.items()
    ]
    return join([*(rows(node) for node in case.metrics), *(found for found in beside if len(found))])


def _fit_notes(planned: list[Planned], refs: dict[str, Ref]) -> list[str]:
    """How long the Gaussians took, which is no metric: it would differ from run to run."""
    took = {}
    for case in planned:
        if "reconstruction" in case.nodes:
            ref = refs[case.nodes["reconstruction"][0].id]
            took[f"{case.case.data} {variant_of(case.case)}".strip(), ref.key] = ref.seconds / 60
    each = ", ".join(f"{name} {minutes:.1f}" for (name, _), minutes in took.items())
    return [f"Minutes to fit the Gaussians, timed when they were computed: {each}."] if took else []


def _about(case: Planned, refs: dict[str, Ref], store: Store):
    node, output = case.nodes["about"]
    return store.load(refs[node.id], output)


def _subject(case: Planned, refs: dict[str, Ref], store: Store) -> str:
    return re.sub(r"\s+", "_", _about(case, refs, store).name)
