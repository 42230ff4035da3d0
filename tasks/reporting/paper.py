"""The published numbers, as values. They are written down once, in conf/paper/gaussianimate.yaml."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any

from tasks.errors import InputError
from tasks.evaluation.metrics import METRICS

_MORE = ("ours", "means", "leads", "remarks")


@dataclass(frozen=True)
class PaperCell:
    """One printed number. table: its number in the paper; method: the row; dataset, subject: the column ("" where the
    paper averages over a dataset); metric: a name in METRICS; value: None where the scan lost it; read: clear, garbled,
    derived or lost; note: how it was restored."""

    table: int
    method: str
    dataset: str
    subject: str
    metric: str
    value: float | None
    unit: str
    read: str
    note: str = ""


@dataclass(frozen=True)
class Paper:
    """A paper's printed cells. methods, columns: labels by method and by "dataset/subject"; absent: why "methods",
    "columns" or "metrics" are not run here; ours: our name of a row, where it differs; means: datasets whose mean
    stands beside a column; leads: by a table's number the row that it is about; remarks: by column."""

    source: str
    methods: Mapping[str, str]
    columns: Mapping[str, str]
    absent: Mapping[str, Mapping[str, str]]
    cells: tuple[PaperCell, ...]
    ours: Mapping[str, str] = field(default_factory=dict)
    means: Mapping[str, Sequence[str]] = field(default_factory=dict)
    leads: Mapping[int, str] = field(default_factory=dict)
    remarks: Mapping[str, str] = field(default_factory=dict)

    def table(self, number: int) -> tuple[PaperCell, ...]:
        """The cells of one table of the paper, in its order."""
        return tuple(cell for cell in self.cells if cell.table == number)


def paper_of(config: Mapping[str, Any]) -> Paper:
    """The paper from the content of its yaml file (keys source, methods, columns, absent, cells, and
    where there is something to say ours, means, leads, remarks).

    Raises InputError, naming the cell, for an unknown key or metric, or two values for one cell.
    """
    cells = tuple(_cell(i, entry) for i, entry in enumerate(config["cells"]))
    seen: set[tuple] = set()
    for i, cell in enumerate(cells):
        key = (cell.table, cell.method, cell.dataset, cell.subject, cell.metric)
        if key in seen:
            raise InputError(f"paper.cells[{i}]", expected="one value a cell", found=f"a second one for {key}")
        seen.add(key)
    labels = (dict(config[name]) for name in ("methods", "columns", "absent"))
    return Paper(config["source"], *labels, cells, *(dict(config.get(name, {})) for name in _MORE))


def _cell(index: int, entry: Mapping[str, Any]) -> PaperCell:
    where = f"paper.cells[{index}]"
    known = [f.name for f in fields(PaperCell)]
    unknown = sorted(set(entry) - set(known))
    missing = sorted(set(known) - set(entry) - {"note"})
    if unknown or missing:
        wrong = f"unknown {', '.join(unknown)}" if unknown else f"no {', '.join(missing)}"
        raise InputError(where, expected=f"the keys {', '.join(known)}", found=wrong)
    if entry["metric"] not in METRICS:
        raise InputError(f"{where}.metric", expected=f"one of {', '.join(METRICS)}", found=str(entry["metric"]))
    value = entry["value"]
    if (value is None) != (entry["read"] == "lost"):
        raise InputError(f"{where}.value", expected="a number, or null with read: lost", found=str(value))
    return PaperCell(**{**entry, "value": None if value is None else float(value)})
