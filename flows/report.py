"""``python -m flows.report A B``: what two reports differ in: numbers, configs, code, data, machine.

``python -m flows.report --render A`` writes a report's tables anew from its metrics.csv, after a change of how tables
look; ``--index reports`` writes index.html for all reports that lie in a folder. Exit status: 0 done, 2 a folder that
holds no report.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path

from rich.console import Console
from rich.table import Table

from tasks.errors import InputError

PLACE = ("dataset", "subject", "method", "variant", "metric", "seed")
TIMED = ("seconds", "hours", "memory")  # kinds of metrics that no two runs agree in
TIMED_RATIOS = ("time_ratio", "cpu_ratio", "time_to_peer_rmse_ratio", "points_exponent", "frames_exponent")
TOLERANCE = 0.01  # relative, between machines; on one machine numbers are to be the same to the last bit
SHOWN = 40


@dataclass(frozen=True)
class Moved:
    """A number that two reports disagree in. place: the values of PLACE; a, b: the numbers; unit: theirs."""

    place: tuple[str, ...]
    a: float
    b: float
    unit: str

    @property
    def change(self) -> float:
        """How far, relative to the larger of the two."""
        return abs(self.b - self.a) / max(abs(self.a), abs(self.b))


@dataclass(frozen=True)
class Comparison:
    """moved: numbers that differ at all, the furthest first; same: how many are equal to the last bit; timed: how many
    are timings, which are not compared; only_a, only_b: places of numbers that the other report has not; differences:
    (what, in A, in B) of configs, code, data, machine; first: the stages whose results differ although their inputs do
    not."""

    moved: list[Moved]
    same: int
    timed: int
    only_a: list[tuple[str, ...]]
    only_b: list[tuple[str, ...]]
    differences: list[tuple[str, str, str]]
    first: list[str]


def main(arguments: list[str] | None = None) -> int:
    """The command line. Returns the exit status."""
    parser = argparse.ArgumentParser(prog="python -m flows.report", description="Compares two reports.")
    parser.add_argument("reports", nargs="+", type=Path, metavar="FOLDER", help="reports/A reports/B")
    parser.add_argument("--render", action="store_true", help="write the tables of each report anew instead")
    parser.add_argument("--index", action="store_true", help="write index.html for a folder of reports instead")
    parser.add_argument("--tolerance", type=float, help=f"relative (default: 0 on one machine, else {TOLERANCE:g})")
    known = parser.parse_args(arguments)
    try:
        if known.render:
            from flows.shelf import render_again

            for folder in known.reports:
                print(f"{folder}: {render_again(folder)} files changed")
            return 0
        if known.index:
            from flows.shelf import index_folder

            for folder in known.reports:
                print(index_folder(folder))
            return 0
        if len(known.reports) != 2:
            parser.error("two reports are compared")
        show(compare(*known.reports), _tolerance(known), Console(highlight=False, soft_wrap=True))
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


def compare(a: Path, b: Path) -> Comparison:
    """Two reports' folders side by side. Raises InputError where one holds no report."""
    from tasks.evaluation.metrics import metric_of

    (one, origin_a), (two, origin_b) = _read(a), _read(b)
    moved, same, timed = [], 0, 0
    for place in one.keys() & two.keys():
        metric = place[PLACE.index("metric")]
        if metric_of(metric).kind in TIMED or metric in TIMED_RATIOS:
            timed += 1
        elif one[place] == two[place]:
            same += 1
        else:
            moved.append(Moved(place, one[place][0], two[place][0], one[place][1]))
    return Comparison(
        moved=sorted(moved, key=lambda m: (-m.change, m.place)),
        same=same,
        timed=timed,
        only_a=[place for place in one if place not in two],
        only_b=[place for place in two if place not in one],
        differences=_differences(origin_a, origin_b),
        first=_first(origin_a, origin_b),
    )


def show(found: Comparison, tolerance: float, console: Console) -> None:
    """Prints a comparison: first whether numbers moved, then why they might have."""
    beyond = [m for m in found.moved if m.change > tolerance]
    every = found.same + len(found.moved)
    said = (
        f"{every} numbers in both: {found.same} equal to the last bit, {len(found.moved) - len(beyond)} moved within "
    )
    said += f"a relative {tolerance:g}, {len(beyond)} further"
    console.print(said + (f"; {found.timed} timings are not compared" if found.timed else ""), markup=False)
    if beyond:
        console.print(_moved_table(beyond[:SHOWN]))
    if len(beyond) > SHOWN:
        console.print(f"and {len(beyond) - SHOWN} more that moved less")
    for name, places in (("A", found.only_a), ("B", found.only_b)):
        if places:
            cases = dict.fromkeys(" ".join(filter(None, place[:4])) for place in places)
            console.print(f"only in {name}: {len(places)} numbers of {'; '.join(cases)}", markup=False)
    if found.first:
        console.print(f"results differ first in: {'; '.join(found.first)}", markup=False)
    if not found.differences:
        console.print("configs, code, data and machine are the same")
    for what, in_a, in_b in found.differences:
        console.print(f"{what}: {in_a} -> {in_b}", markup=False)


def _tolerance(known: argparse.Namespace) -> float:
    if known.tolerance is not None:
        return known.tolerance
    from tasks.reporting.report import read_provenance

    one, two = (read_provenance(folder) for folder in known.reports)
    return 0.0 if one.get("machine") == two.get("machine") else TOLERANCE


def _read(folder: Path) -> tuple[dict[tuple[str, ...], tuple[float, str]], dict]:
    """The numbers of a report by their place, and its provenance."""
    from tasks.reporting.report import read_provenance
    from tasks.reporting.rows import from_csv

    file = folder / "metrics.csv"
    try:
        rows = from_csv(file.read_text("utf-8"), str(file))
    except OSError as error:
        raise InputError(str(file), expected="the numbers of a report", found=error.strerror or str(error)) from None
    places = rows[list(PLACE)].astype(str).itertuples(index=False, name=None)
    return dict(zip(places, zip(rows["value"], rows["unit"], strict=True), strict=True)), read_provenance(folder)


def _moved_table(moved: list[Moved]) -> Table:
    table = Table()
    for name in ("data", "method", "metric"):
        table.add_column(name, overflow="fold")  # a metric whose clip is cut off could be any
    for name in ("A", "B", "change"):
        table.add_column(name, justify="right")
    for m in moved:
        dataset, subject, method, variant, metric, seed = m.place
        data = subject if subject in dataset else f"{dataset} {subject}"
        who = " ".join([method, variant, *([f"seed {seed}"] if seed != "0" else [])])
        change = f"{100 * (m.b / m.a - 1):+.3g} %" if m.a else ""
        table.add_row(data, " ".join(who.split()), metric, f"{m.a:.6g} {m.unit}", f"{m.b:.6g} {m.unit}", change)
    return table


def _differences(a: dict, b: dict) -> list[tuple[str, str, str]]:
    """What the provenances disagree in, in the order in which it matters."""
    found = list(_configs(a.get("cases", []), b.get("cases", [])))
    for name in ("inputs", "git", "versions", "machine"):
        one, two = a.get(name) or {}, b.get(name) or {}
        for key in sorted(one.keys() | two.keys()):
            if one.get(key) != two.get(key):
                found.append((f"{name} {key}", _short(one.get(key)), _short(two.get(key))))
    one, two = _sources(a), _sources(b)
    changed = [stage for stage in one if stage in two and one[stage] != two[stage]]
    if changed:
        found.append(("code of the stages", ", ".join(changed), "changed"))
    return found


def _configs(a: list[dict], b: list[dict]) -> Iterator[tuple[str, str, str]]:
    """Settings that differ in cases that both have, with the cases; one line for equal differences."""

    def by_case(cases: list[dict]) -> dict[str, dict[str, object]]:
        return {f"{c['dataset']} {c['method']} {c['variant']}": dict(_flat(c["config"])) for c in cases}

    one, two = by_case(a), by_case(b)
    found = []
    for case in one.keys() & two.keys():
        for key in one[case].keys() | two[case].keys():
            values = one[case].get(key, "absent"), two[case].get(key, "absent")
            if values[0] != values[1] and not key.startswith(("report.name", "report.title", "sweep.")):
                found.append((key, _short(values[0]), _short(values[1]), case))
    for (key, in_a, in_b), members in groupby(sorted(found), key=lambda f: f[:3]):
        cases = [f[3] for f in members]
        yield f"config {key} ({cases[0] if len(cases) == 1 else f'{len(cases)} cases'})", in_a, in_b


def _flat(config: object, prefix: str = "") -> Iterator[tuple[str, object]]:
    if isinstance(config, dict):
        for key, value in config.items():
            yield from _flat(value, f"{prefix}.{key}" if prefix else key)
    else:
        yield prefix, config


def _sources(provenance: dict) -> dict[str, set[str]]:
    """Digests of the code behind every stage."""
    found: dict[str, set[str]] = {}
    for stage in provenance.get("stages", []):
        if "source" in stage:
            found.setdefault(stage["stage"], set()).add(stage["source"])
    return found


def _first(a: dict, b: dict) -> list[str]:
    """The earliest stages of each case whose results differ: stages are listed in an order of the graph."""
    theirs = dict(_outputs(b))
    found: dict[str, str] = {}
    for (stage, case, nth), outputs in _outputs(a):
        if theirs.get((stage, case, nth), outputs) != outputs:
            found.setdefault(case, stage)
    stages = dict.fromkeys(found.values())
    return [f"{stage} ({', '.join(case for case, s in found.items() if s == stage)})" for stage in stages]


def _outputs(provenance: dict) -> Iterator[tuple[tuple[str, str, int], dict]]:
    """(stage, case, how often before in this case) and the digests of what it made."""
    seen: Counter = Counter()
    for stage in provenance.get("stages", []):
        for case in stage["cases"]:
            place = stage["stage"], case
            yield (*place, seen[place]), stage["outputs"]
            seen[place] += 1


def _short(value: object) -> str:
    text = str(value)
    return text if len(text) <= 60 else f"{text[:12]}…"


if __name__ == "__main__":
    sys.exit(main())
