"""From rows of numbers to one table object; tasks/reporting/typeset.py renders it.

A column holds one metric of one subject, in one of three kinds: what the paper prints, what was measured here, and the
difference. Ranks are taken on unrounded means over seeds; equal values share a rank.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from typing import Literal

import pandas as pd

from tasks.evaluation.metrics import metric_of, score
from tasks.reporting.paper import Paper, PaperCell

WIDEST = 9  # columns that stand side by side on a page
PRINTED = "printed in the paper, not run"
Row = tuple[str, str]  # method, variant
Place = tuple[str, str, str]  # dataset, subject, metric

_READ = {
    "clear": "",
    "garbled": "digits restored from a garbled scan of the paper",
    "derived": "not legible in the scan of the paper, derived",
    "lost": "not legible in the scan of the paper",
}


@dataclass(frozen=True)
class Cell:
    """value: unrounded mean over seeds, or None; spread: standard deviation over seeds, or None for one seed;
    rank: 1 best, 2 second best, 0 neither; gain: % against the column's baseline, or None; note: a footnote or ""."""

    value: float | None = None
    spread: float | None = None
    rank: int = 0
    gain: float | None = None
    note: str = ""


@dataclass(frozen=True)
class Column:
    """group: the subject's label; metric, unit; kind: whose number; status: the data behind it; digits: decimals;
    baseline: the row that gains are against, or ""; cells: one a row of the table."""

    group: str
    metric: str
    unit: str
    kind: Literal["paper", "ours", "difference"]
    status: Literal["printed", "paper's data", "substitute"]
    digits: int
    cells: tuple[Cell, ...]
    baseline: str = ""

    @property
    def label(self) -> str:
        """The metric's name with its unit and the arrow that says which way is good."""
        metric = metric_of(self.metric)
        unit = "" if self.unit in ("ratio", "count") else f" [{self.unit}]"
        arrow = {"lower": " ↓", "higher": " ↑", "one": " → 1", "none": ""}[metric.better]
        return f"{metric.label}{unit}{arrow}"


@dataclass(frozen=True)
class Grid:
    """Columns of a table that stand side by side. title: what they have in common, or ""; rows: the numbers of the
    table's rows that say something in them."""

    title: str
    columns: tuple[Column, ...]
    rows: tuple[int, ...]

    @property
    def groups(self) -> list[str]:
        """The subject over each column; none where the title names it."""
        return [] if {c.group for c in self.columns} == {self.title} else [c.group for c in self.columns]

    @property
    def labels(self) -> list[str]:
        """The metric over each column; none where the title names it."""
        return [] if {c.label for c in self.columns} == {self.title} else [c.label for c in self.columns]


@dataclass(frozen=True)
class Table:
    """rows: their labels; notes: remarks on the whole table; folded: a detail that a page opens when asked to."""

    title: str
    columns: tuple[Column, ...]
    rows: tuple[str, ...]
    notes: tuple[str, ...] = ()
    folded: bool = False

    @property
    def remarks(self) -> list[str]:
        """The notes, and how to read marks and spreads where there are any."""
        cells = [cell for column in self.columns for cell in column.cells]
        ranked = "Best in bold, second best underlined, ranked before rounding." if any(c.rank for c in cells) else ""
        seeds = "± is the standard deviation over seeds." if any(c.spread is not None for c in cells) else ""
        return [text for text in (*self.notes, ranked, seeds) if text]

    @property
    def footnotes(self) -> list[str]:
        """The cells' notes, each once, in reading order; a cell's mark is its note's place in here, from 1."""
        cells = (column.cells[r] for grid in self.grids() for r in grid.rows for column in grid.columns)
        return list(dict.fromkeys(cell.note for cell in cells if cell.note))

    def grids(self, widest: int = WIDEST) -> list[Grid]:
        """The table in pieces that a page can hold: one where all fits, else one a metric or one a subject, whichever
        are fewer; last what only the paper has."""
        measured = {column.group for column in self.columns if column.kind == "ours"}
        ours = [column for column in self.columns if column.group in measured]
        pieces = _pieces(ours, widest)
        pieces += [(PRINTED, part) for part in _packed([c for c in self.columns if c not in ours], widest)]
        found = []
        for title, columns in pieces:
            says = [
                any(c.cells[r].value is not None or c.cells[r].note for c in columns) for r in range(len(self.rows))
            ]
            found.append(Grid(title, tuple(columns), tuple(r for r, something in enumerate(says) if something)))
        return found


def build(
    rows: pd.DataFrame,
    *,
    title: str,
    metrics: Sequence[str],
    labels: Mapping[str, str],
    data_status: Mapping[str, str],
    stands_for: Mapping[str, str],
    baselines: Sequence[str],
    notes: Sequence[str],
    bounds: Sequence[str] = (),
    paper: Paper | None = None,
    paper_table: int = 0,
) -> Table:
    """The table of some metrics over all methods and subjects.

    rows: as in metrics.csv; metrics: the columns of each subject, the first it has also shown as a gain over the first
    of the methods ``baselines`` that the column holds; labels: what to call methods, "method/variant"s, datasets and
    "dataset/subject"s, methods in the order wanted; data_status: "paper" or "substitute" by dataset or
    "dataset/subject" (substitute where not named); stands_for: the paper's column that a subject takes the place of,
    "dataset/subject" to "dataset/subject"; notes: remarks under the table; bounds: methods without a
    rank. With ``paper``, the cells of its table
    ``paper_table`` stand beside ours, and its columns that were not run stand alone.
    """
    measured = _measured(rows, metrics)
    printed = _printed(paper, paper_table, metrics)
    names = _row_order(measured, printed, labels)
    columns: list[Column] = []
    for dataset, subject in dict.fromkeys(place[:2] for place in measured):
        group = _group(dataset, subject)
        status = data_status.get(group, data_status.get(dataset, "substitute"))
        target, _, target_subject = stands_for.get(group, group).partition("/")
        for metric in metrics:
            ours = measured.get((dataset, subject, metric))
            theirs = printed.pop((target, target_subject, metric), None)
            if ours is not None:
                columns += _columns(group, metric, status, _in_order(ours, names), _in_order(theirs, names))
    for (dataset, subject, metric), theirs in printed.items():
        columns.append(_column(_group(dataset, subject), metric, "paper", "printed", _in_order(theirs, names)))
    columns = [_ranked(c, names, bounds) for c in columns]
    first = {c.group: c.metric for c in reversed(columns)}  # of each subject's metrics
    columns = [_with_gains(c, names, baselines) if c.metric == first[c.group] else c for c in columns]
    called = {**(paper.methods if paper else {}), **(paper.columns if paper else {}), **labels}
    against = " or ".join(dict.fromkeys(called.get(c.baseline, c.baseline) for c in columns if c.baseline))
    return Table(
        title=title,
        columns=tuple(replace(c, group=called.get(c.group, c.group.rpartition("/")[2])) for c in columns),
        rows=tuple(_row_label(name, called) for name in names),
        notes=(*notes, *([f"In brackets: change against {against}."] if against else [])),
    )


def ranks(values: Sequence[float | None], better: str) -> list[int]:
    """1 for the best value, 2 for the second best, else 0; equal values share a rank. Nothing is marked where there is
    no direction or only one distinct value."""
    if better == "none":
        return [0] * len(values)
    scores = [None if v is None else score(v, better) for v in values]
    order = sorted({s for s in scores if s is not None})
    if len(order) < 2:
        return [0] * len(values)
    return [0 if s is None else {order[0]: 1, order[1]: 2}.get(s, 0) for s in scores]


def unranked(table: Table) -> Table:
    """The table without marks for the best: its rows are not rivals."""

    def plain(column: Column) -> Column:
        return replace(column, cells=tuple(replace(cell, rank=0) for cell in column.cells))

    return replace(table, columns=tuple(plain(column) for column in table.columns))


def digits_for(values: Sequence[float], metric: str) -> int:
    """Decimals for a column: the metric's own; else three significant digits of the largest value, two of the smallest.

    The smallest value asks for two more decimals at most: beside 105 mm, 3.5 is told from 4.1, and 0.001 is not.
    """
    own = metric_of(metric).digits
    sizes = [abs(v) for v in values if v != 0.0]
    if own is not None or not sizes:
        return own or 0
    largest, smallest = (math.floor(math.log10(v)) for v in (max(sizes), min(sizes)))
    least = min(max(2 - largest, 0), 8)
    return max(least, min(1 - smallest, least + 2, 8))


def _pieces(columns: list[Column], widest: int) -> list[tuple[str, list[Column]]]:
    if len(columns) <= widest:
        return [("", columns)] if columns else []
    by_metric, by_subject = {}, {}
    for column in columns:
        by_metric.setdefault(column.label, []).append(column)
        by_subject.setdefault(column.group, []).append(column)
    parts = by_metric if len(by_metric) <= len(by_subject) else by_subject
    return [(title, some) for title, part in parts.items() for some in _packed(part, widest)]


def _packed(columns: list[Column], widest: int) -> list[list[Column]]:
    """The columns in stretches of about equal width; those of one subject and metric stay together."""
    together = [list(part) for _, part in groupby(columns, key=lambda c: (c.group, c.metric))]
    width = math.ceil(len(columns) / max(1, math.ceil(len(columns) / widest)))
    found: list[list[Column]] = []
    for part in together:
        if not found or len(found[-1]) + len(part) > width:
            found.append([])
        found[-1] += part
    return found


def _measured(rows: pd.DataFrame, metrics: Sequence[str]) -> dict[Place, dict[Row, tuple[Cell, str]]]:
    """Means and spreads over seeds, in the order in which places and rows first appear."""
    out: dict[Place, dict[Row, tuple[Cell, str]]] = {}
    wanted = rows[rows["metric"].isin(list(metrics))]
    case = ["dataset", "subject", "metric", "method", "variant"]
    for (dataset, subject, metric, method, variant), group in wanted.groupby(case, sort=False):
        if group["seed"].duplicated().any():
            where = f"{dataset}/{subject} {method} {variant}".strip()
            raise ValueError(f"two values of {metric} for {where} and one seed")
        values = group["value"].to_numpy(float)
        spread = float(values.std(ddof=1)) if len(values) > 1 else None
        cell = (Cell(float(values.mean()), spread), str(group["unit"].iloc[0]))
        out.setdefault((dataset, subject, metric), {})[method, variant] = cell
    return out


def _printed(paper: Paper | None, number: int, metrics: Sequence[str]) -> dict[Place, dict[Row, tuple[Cell, str]]]:
    out: dict[Place, dict[Row, tuple[Cell, str]]] = {}
    for cell in paper.table(number) if paper else ():
        if cell.metric in metrics:
            place = out.setdefault((cell.dataset, cell.subject, cell.metric), {})
            place[cell.method, ""] = (Cell(cell.value, note=_note(cell)), cell.unit)
    return out


def _note(cell: PaperCell) -> str:
    return ": ".join(text for text in (_READ[cell.read], cell.note) if text)


def _row_order(measured: Mapping, printed: Mapping, labels: Mapping[str, str]) -> list[Row]:
    """Methods in the order of their labels, then the paper's, then as they come; variants as they come."""
    theirs = dict.fromkeys(row for cells in printed.values() for row in cells)
    ours = dict.fromkeys(row for cells in measured.values() for row in cells)
    methods = list(dict.fromkeys([*labels, *(m for m, _ in theirs), *(m for m, _ in ours)]))
    return sorted({**ours, **theirs}, key=lambda row: methods.index(row[0]))


def _in_order(cells: Mapping[Row, tuple[Cell, str]] | None, names: list[Row]) -> list[tuple[Cell, str]]:
    return [cells.get(name, (Cell(), "")) for name in names] if cells else []


def _columns(group: str, metric: str, status: str, ours: list, theirs: list) -> list[Column]:
    """One column, or paper | ours | difference where the paper has it too."""
    kind = "paper's data" if status == "paper" else "substitute"
    column = _column(group, metric, "ours", kind, ours)
    if not theirs:
        return [column]
    printed = _column(group, metric, "paper", "printed", theirs)
    pairs = [(a.value, b.value) for a, b in zip(column.cells, printed.cells, strict=True)]
    gaps = tuple(Cell(None if a is None or b is None else a - b) for a, b in pairs)
    return [printed, column, replace(column, kind="difference", cells=gaps)]


def _column(group: str, metric: str, kind: str, status: str, cells: list[tuple[Cell, str]]) -> Column:
    values = [cell.value for cell, _ in cells]
    units = {unit for cell, unit in cells if unit}
    if len(units) != 1:
        raise ValueError(f"{group} {metric}: one unit a column, got {sorted(units)}")
    known = [v for v in values if v is not None]
    digits = printed_digits(known) if kind == "paper" else digits_for(known, metric)
    return Column(group, metric, units.pop(), kind, status, digits, tuple(cell for cell, _ in cells))


def _ranked(column: Column, names: list[Row], bounds: Sequence[str]) -> Column:
    """The column with its best cells marked; differences and rows that are no methods have no rank."""
    if column.kind == "difference":
        return column
    values = [None if n[0] in bounds else c.value for n, c in zip(names, column.cells, strict=True)]
    marks = ranks(values, metric_of(column.metric).better)
    return replace(column, cells=tuple(replace(c, rank=r) for c, r in zip(column.cells, marks, strict=True)))


def printed_digits(values: Sequence[float]) -> int:
    """As many decimals as the paper prints in the column."""
    return max((len(repr(v).partition(".")[2].rstrip("0")) for v in values), default=0)


def _with_gains(column: Column, names: list[Row], baselines: Sequence[str]) -> Column:
    """Changes against the first baseline of the column, in %."""
    if column.kind == "difference":
        return column
    plain = {method: cell.value for (method, variant), cell in zip(names, column.cells, strict=True) if not variant}
    base = next((b for b in baselines if plain.get(b)), None)
    if base is None:
        return column
    reference = plain[base]

    def gain(name: Row, cell: Cell) -> Cell:
        if cell.value is None or name == (base, ""):
            return cell
        return replace(cell, gain=100.0 * (cell.value / reference - 1.0))

    cells = tuple(gain(name, cell) for name, cell in zip(names, column.cells, strict=True))
    return replace(column, cells=cells, baseline=base)


def _group(dataset: str, subject: str) -> str:
    return f"{dataset}/{subject}" if subject else dataset


def _row_label(name: Row, called: Mapping[str, str]) -> str:
    method, variant = name
    label = called.get(method, method)
    return called.get(f"{method}/{variant}", f"{label}, {variant}") if variant else label
