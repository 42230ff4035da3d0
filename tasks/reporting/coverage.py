"""What of the paper's printed numbers was measured here: cell by cell, on what data, or why not."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import pandas as pd

from tasks.reporting.paper import Paper, PaperCell

Status = Literal["reproduced", "substitute data", "not run"]


@dataclass(frozen=True)
class Measured:
    """An experiment that stands beside a table of the paper. table: its number; rows: as in metrics.csv; data_status,
    stands_for: as in :func:`tasks.reporting.tables.build`."""

    table: int
    rows: pd.DataFrame
    data_status: Mapping[str, str]
    stands_for: Mapping[str, str]


@dataclass(frozen=True)
class Covered:
    """A printed cell. method, column: labels; paper: None where the scan lost it; ours: mean over subjects and seeds,
    or None; status: "reproduced" on the paper's own data; of: the subjects that ours is the mean of, where they are
    several; why: the reason where it was not run; remark: on its column."""

    method: str
    column: str
    metric: str
    unit: str
    paper: float | None
    ours: float | None
    status: Status
    of: tuple[str, ...] = ()
    why: str = ""
    remark: str = ""


@dataclass(frozen=True)
class Claim:
    """How the row that a table is about compares with another one. printed, ours: change in % against the other's
    number, printed where both are legible; holds: whether both changes are for the better, or both for the worse."""

    lead: str
    other: str
    column: str
    metric: str
    printed: float
    ours: float

    @property
    def holds(self) -> bool:
        return (self.printed < 0) == (self.ours < 0)


def cover(paper: Paper, measured: Sequence[Measured], absent: Mapping[str, str]) -> dict[int, list[Covered]]:
    """Every cell of every table of the paper, by the table's number, in the paper's order within a column.

    absent: why a column of the paper, "dataset/subject", is not there in this run. The paper's own data wins over a
    substitute, and a substitute of its own over the mean of several.
    """
    tables: dict[int, list[Covered]] = {}
    for cell in paper.cells:
        tables.setdefault(cell.table, []).append(_covered(cell, paper, measured, absent))
    return tables


def claims(paper: Paper, tables: Mapping[int, Sequence[Covered]]) -> dict[int, list[Claim]]:
    """By the table's number, its leading row against every other that was measured here and is legible there."""
    found: dict[int, list[Claim]] = {}
    for number, cells in tables.items():
        name = paper.leads.get(number, "")
        lead = paper.methods.get(name, name)
        known = [c for c in cells if c.paper and c.ours]
        own = {(c.column, c.metric): c for c in known if c.method == lead}
        for cell in known:
            one = own.get((cell.column, cell.metric))
            if one and cell.method != lead:
                change = [100.0 * (a / b - 1.0) for a, b in ((one.paper, cell.paper), (one.ours, cell.ours))]
                found.setdefault(number, []).append(Claim(lead, cell.method, cell.column, cell.metric, *change))
    return found


def _covered(cell: PaperCell, paper: Paper, measured: Sequence[Measured], absent: Mapping[str, str]) -> Covered:
    column, method = _column(cell), paper.ours.get(cell.method, cell.method)
    found = [one for m in measured if m.table == cell.table for one in [_ours(cell, method, m)] if one]
    best = min(found, key=lambda one: one[1] != "reproduced", default=None)
    if best is None:
        several = paper.means.get(column, ())
        best = next(
            (one for m in measured if m.table == cell.table for one in [_mean(cell, method, several, m)] if one), None
        )
    why = absent.get(column) or next(
        (paper.absent[kind][name] for kind, name in _reasons(cell, column) if name in paper.absent.get(kind, {})), None
    )
    value, status, of = best or (None, "not run", ())
    return Covered(
        method=paper.methods.get(cell.method, cell.method),
        column=paper.columns.get(column, column),
        metric=cell.metric,
        unit=cell.unit,
        paper=cell.value,
        ours=value,
        status=status,
        of=of,
        why="" if best else why or "not measured in this run",
        remark=paper.remarks.get(column, "") if best else "",
    )


def _reasons(cell: PaperCell, column: str) -> list[tuple[str, str]]:
    """Where a reason may stand, the one that says most first."""
    return [("methods", cell.method), ("metrics", cell.metric), ("columns", column)]


Found = tuple[float, Status, tuple[str, ...]]


def _rows(cell: PaperCell, method: str, measured: Measured) -> pd.DataFrame:
    rows = measured.rows
    return rows[(rows["metric"] == cell.metric) & (rows["method"] == method) & (rows["variant"] == "")]


def _ours(cell: PaperCell, method: str, measured: Measured) -> Found | None:
    """Our number for a printed cell and the data behind it: the mean over all subjects that stand for its column."""
    rows = _rows(cell, method, measured)
    place = rows["dataset"] + "/" + rows["subject"]
    target = [measured.stands_for.get(p, p) for p in place]
    chosen = rows[[t == _column(cell) for t in target]]
    if chosen.empty:
        return None
    own = [measured.data_status.get(dataset) == "paper" for dataset in chosen["dataset"]]
    if any(own):
        chosen = chosen[own]
    return _value(chosen, "reproduced" if any(own) else "substitute data")


def _mean(cell: PaperCell, method: str, several: Sequence[str], measured: Measured) -> Found | None:
    """The mean over the subjects of several datasets that together stand beside a printed mean."""
    rows = _rows(cell, method, measured)
    chosen = rows[rows["dataset"].isin(list(several))]
    return None if chosen.empty else _value(chosen, "substitute data")


def _value(chosen: pd.DataFrame, status: Status) -> Found:
    each = chosen.groupby(["dataset", "subject"], sort=False)["value"].mean()  # over seeds, then over subjects
    subjects = tuple(subject for _, subject in each.index)
    return float(each.mean()), status, subjects if len(subjects) > 1 else ()


def _column(cell: PaperCell) -> str:
    return f"{cell.dataset}/{cell.subject}" if cell.subject else cell.dataset
