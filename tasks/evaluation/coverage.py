"""What of the paper's printed numbers was measured here: cell by cell, on what data, or why not."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import pandas as pd

from tasks.evaluation.paper import Paper, PaperCell

Status = Literal["reproduced", "substitute data", "not run"]


@dataclass(frozen=True)
class Measured:
    """An experiment that stands beside a table of the paper. table: its number; rows: as in metrics.csv; data_status,
    stands_for: as in :func:`tasks.evaluation.tables.build`."""

    table: int
    rows: pd.DataFrame
    data_status: Mapping[str, str]
    stands_for: Mapping[str, str]


@dataclass(frozen=True)
class Covered:
    """A printed cell. method, column: labels; paper: None where the scan lost it; ours: mean over subjects and seeds,
    or None; status: "reproduced" on the paper's own data; why: the reason where it was not run."""

    method: str
    column: str
    metric: str
    unit: str
    paper: float | None
    ours: float | None
    status: Status
    why: str = ""


def cover(paper: Paper, measured: Sequence[Measured], absent: Mapping[str, str]) -> dict[int, list[Covered]]:
    """Every cell of every table of the paper, by the table's number, in the paper's order within a column.

    absent: why a column of the paper, "dataset/subject", is not there in this run. The paper's own data wins over a
    substitute.
    """
    tables: dict[int, list[Covered]] = {}
    for cell in paper.cells:
        found = [one for m in measured if m.table == cell.table for one in [_ours(cell, m)] if one]
        best = min(found, key=lambda pair: pair[1] != "reproduced", default=None)
        column = _column(cell)
        why = absent.get(column) or paper.absent["methods"].get(cell.method) or paper.absent["columns"].get(column)
        value, status = best or (None, "not run")
        tables.setdefault(cell.table, []).append(
            Covered(
                method=paper.methods.get(cell.method, cell.method),
                column=paper.columns.get(column, column),
                metric=cell.metric,
                unit=cell.unit,
                paper=cell.value,
                ours=value,
                status=status,
                why="" if best else why or "not measured in this run",
            )
        )
    return tables


def _ours(cell: PaperCell, measured: Measured) -> tuple[float, Status] | None:
    """Our number for a printed cell and the data behind it: the mean over all subjects that stand for its column."""
    rows = measured.rows
    rows = rows[(rows["metric"] == cell.metric) & (rows["method"] == cell.method) & (rows["variant"] == "")]
    place = rows["dataset"] + "/" + rows["subject"]
    target = [measured.stands_for.get(p, p) for p in place]
    chosen = rows[[t == _column(cell) for t in target]]
    if chosen.empty:
        return None
    own = [measured.data_status.get(dataset) == "paper" for dataset in chosen["dataset"]]
    if any(own):
        chosen = chosen[own]
    return float(chosen["value"].mean()), "reproduced" if any(own) else "substitute data"


def _column(cell: PaperCell) -> str:
    return f"{cell.dataset}/{cell.subject}" if cell.subject else cell.dataset
