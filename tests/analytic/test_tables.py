"""Tables: ranks worked out by hand, the paper's cells beside ours, four renderings of one object."""

from __future__ import annotations

import io
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml
from rich.console import Console

from tasks.errors import InputError
from tasks.evaluation.metrics import METRICS
from tasks.reporting import typeset
from tasks.reporting.paper import paper_of
from tasks.reporting.rows import join, rows_of, to_csv, with_means
from tasks.reporting.tables import Cell, Table, build, digits_for, ranks
from tasks.values import Metrics

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def config() -> dict:
    return yaml.safe_load((ROOT / "conf" / "paper" / "gaussianimate.yaml").read_text())


def row(method: str, value: float, *, dataset="mesh", subject="horse", metric="rmse", unit="mm", seed=0, variant=""):
    metrics = Metrics((metric,), (unit,), np.array([value]))
    case = {"experiment": "e", "dataset": dataset, "subject": subject, "variant": variant, "seed": seed, "key": "k"}
    return rows_of(metrics, method=method, **case)


def table(rows: list, **changes) -> Table:
    settings = {"title": "T", "metrics": ["rmse"], "labels": {}, "data_status": {}, "stands_for": {}}
    settings |= {"baselines": [], "notes": []}
    return build(join(rows), **(settings | changes))


def column(made: Table, group: str, kind: str, metric: str = "rmse"):
    (found,) = [c for c in made.columns if (c.group, c.kind, c.metric) == (group, kind, metric)]
    return found


@pytest.mark.parametrize(
    ("values", "better", "expected"),
    [
        ([3.0, 1.0, 2.0], "lower", [0, 1, 2]),
        ([3.0, 1.0, 2.0], "higher", [1, 0, 2]),
        ([1.0, 1.0, 2.0, 2.0, 3.0], "lower", [1, 1, 2, 2, 0]),  # equal values share a rank
        ([17.4, 17.4 + 1e-12], "lower", [1, 2]),  # told apart although they print alike
        ([None, 2.0, 1.0], "lower", [0, 2, 1]),
        ([5.0, 5.0], "lower", [0, 0]),  # nothing to choose between
        ([5.0], "lower", [0]),
        ([0.8, 1.1, 1.3], "one", [2, 1, 0]),  # 1.1 is nearest to one; 1 / 0.8 = 1.25 comes before 1.3
        ([1.0, 2.0], "none", [0, 0]),
    ],
)
def test_ranks(values, better, expected):
    assert ranks(values, better) == expected


def test_a_bound_is_shown_and_not_ranked():
    (only,) = table([row("floor", 1.0), row("a", 2.0), row("b", 3.0)], bounds=["floor"]).columns
    assert [c.rank for c in only.cells] == [0, 1, 2]


def test_seeds_become_mean_and_spread_and_rank_by_the_mean():
    made = table([row("a", 1.0), row("a", 4.0, seed=1), row("b", 2.0), row("b", 2.5, seed=1)])
    (only,) = made.columns
    assert [cell.value for cell in only.cells] == [2.5, 2.25]
    assert only.cells[0].spread == pytest.approx(np.std([1, 4], ddof=1))
    assert [cell.rank for cell in only.cells] == [2, 1]


def test_two_values_for_one_cell_are_a_defect():
    with pytest.raises(ValueError, match="two values of rmse for mesh/horse a"):
        table([row("a", 1.0), row("a", 2.0)])
    with pytest.raises(ValueError, match="one unit"):
        table([row("a", 1.0), row("b", 2.0, unit="unit")])


def test_paper_ours_difference(config):
    paper = paper_of(config)
    rows = [row("partmm", 20.0, dataset="vto", subject="tshirt"), row("lbs", 40.0, dataset="vto", subject="tshirt")]
    made = table(
        rows,
        paper=paper,
        paper_table=3,
        data_status={"vto": "paper"},
        labels={"lbs": "LBS"},
        baselines=["robust_lbs", "lbs"],
    )
    at = {label: i for i, label in enumerate(made.rows)}
    printed, ours, gap = (column(made, "VTO T-shirt", kind) for kind in ("paper", "ours", "difference"))
    assert (printed.status, ours.status, gap.status) == ("printed", "paper's data", "paper's data")
    assert printed.cells[at["PartMM"]].value == 17.4
    assert gap.cells[at["PartMM"]].value == pytest.approx(2.6)
    assert gap.cells[at["LBS"]].value is None  # the paper has no such row
    assert printed.cells[at["PartMM"]].gain == pytest.approx(-48.4, abs=0.05)  # as the paper's text has it
    assert ours.cells[at["PartMM"]].gain == pytest.approx(-50.0)
    assert ours.cells[at["LBS"]].gain is None
    assert [c.kind for c in made.columns if c.group == "VTO dress"] == ["paper"]  # not run: alone
    assert "change against Robust LBS or LBS" in made.notes[-1]


def test_a_substitute_says_so_wherever_it_is_compared(config):
    made = table(
        [row("partmm", 20.0, subject="tunic")],
        paper=paper_of(config),
        paper_table=3,
        stands_for={"mesh/tunic": "vto/tshirt"},
    )
    assert [(c.kind, c.status) for c in made.columns if c.group == "tunic"] == [
        ("paper", "printed"),
        ("ours", "substitute"),
        ("difference", "substitute"),
    ]
    assert not [c for c in made.columns if c.group == "VTO T-shirt"]
    assert typeset.markdown(made).count("substitute") == 2


def test_rows_come_in_the_order_of_labels_then_of_the_paper(config):
    rows = [
        row("partmm", 1.0),
        row("fullmm", 2.0),
        row("lbs", 3.0),
        row("mine", 0.5),
        row("partmm", 1.5, variant="k=3"),
    ]
    made = table(
        rows, paper=paper_of(config), paper_table=3, labels={"lbs": "LBS", "partmm/k=3": "PartMM, 3 neighbours"}
    )
    assert made.rows == ("LBS", "Robust LBS", "MLP", "GRU", "FullMM", "PartMM", "PartMM, 3 neighbours", "mine")


def test_gains_are_shown_on_the_first_metric_that_a_subject_has():
    rows = [row("lbs", 2.0, metric="rmse_pct", unit="%"), row("partmm", 1.0, metric="rmse_pct", unit="%")]
    rows += [row("lbs", 4.0), row("partmm", 2.0), row("lbs", 4.0, subject="cat"), row("partmm", 1.0, subject="cat")]
    made = table(rows, metrics=["rmse_pct", "rmse"], baselines=["lbs"])
    assert column(made, "horse", "ours", "rmse_pct").cells[1].gain == -50
    assert column(made, "horse", "ours", "rmse").cells[1].gain is None
    assert column(made, "cat", "ours", "rmse").cells[1].gain == -75


def test_remarks_explain_only_what_there_is():
    assert table([row("a", 1.0)]).remarks == []
    assert len(table([row("a", 1.0), row("b", 2.0)]).remarks) == 1
    assert len(table([row("a", 1.0), row("b", 2.0), row("b", 2.5, seed=1)]).remarks) == 2


def test_decimals():
    assert digits_for([17.41, 3.2], "rmse") == 1
    assert digits_for([0.03412], "rmse") == 4
    assert digits_for([1234.5], "rmse") == 0
    assert digits_for([0.0], "rmse") == 0
    assert digits_for([1234.5], "psnr") == METRICS["psnr"].digits == 2
    assert typeset.number(-0.001, 2, signed=True) == "0.00"
    assert typeset.number(-1.25, 1) == "−1.2"
    assert typeset.number(2.6, 1, signed=True) == "+2.6"


def test_the_papers_own_claims_hold_for_its_cells(config):
    """Percentages that the paper's text states, from the cells as they were read."""
    cells = {(c.table, c.method, c.dataset, c.subject, c.metric): c.value for c in paper_of(config).cells}
    shirt = {m: cells[3, m, "vto", "tshirt", "rmse"] for m in ("robust_lbs", "mlp", "gru", "partmm")}
    assert 100 * (1 - shirt["partmm"] / shirt["robust_lbs"]) == pytest.approx(48.4, abs=0.05)
    assert 100 * (1 - shirt["partmm"] / shirt["gru"]) == pytest.approx(24.1, abs=0.15)
    assert 100 * (1 - shirt["partmm"] / shirt["mlp"]) == pytest.approx(27.2, abs=0.05)
    dna = {m: cells[4, m, "dna_rendering", "", "psnr"] for m in ("smpl_lbs", "smpl_partmm")}
    assert 100 * (dna["smpl_partmm"] / dna["smpl_lbs"] - 1) == pytest.approx(17.3, abs=0.05)
    hq = {m: cells[4, m, "actorshq", "", "psnr"] for m in ("smpl_bob", "smpl_partmm")}
    assert 100 * (hq["smpl_partmm"] / hq["smpl_bob"] - 1) == pytest.approx(45.6, abs=0.05)
    assert cells[3, "fullmm", "d4d", "animals", "rmse"] < cells[3, "partmm", "d4d", "animals", "rmse"]
    assert {c.table for c in paper_of(config).cells} == {2, 3, 4}


def test_every_cell_of_the_paper_is_labelled(config):
    paper = paper_of(config)
    assert {cell.method for cell in paper.cells} == set(paper.methods)
    assert {f"{c.dataset}/{c.subject}".rstrip("/") for c in paper.cells} == set(paper.columns)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"metric": "rsme"}, r"cells\[0\]\.metric: expected one of rmse"),
        ({"colour": "red"}, "unknown colour"),
        ({"value": None}, r"cells\[0\]\.value"),
    ],
)
def test_a_wrong_cell_of_the_paper_is_named(config, change, message):
    with pytest.raises(InputError, match=message):
        paper_of({**config, "cells": [config["cells"][0] | change]})
    with pytest.raises(InputError, match=r"cells\[1\].*one value"):
        paper_of({**config, "cells": [config["cells"][0]] * 2})


@pytest.fixture(scope="module")
def full(config) -> Table:
    rows = [row("partmm", 17.0, subject="a|b_c & <d>"), row("lbs", 30.0, subject="a|b_c & <d>")]
    return table(rows, paper=paper_of(config), paper_table=3, notes=["100 % of it & <more>."], baselines=["lbs"])


def test_wide_tables_come_in_pieces_that_hold_every_column_once():
    def made(subjects: int, metrics: tuple[str, ...]) -> Table:
        rows = [row("lbs", 1.0 + s, metric=m, unit="ratio", subject=f"s{s}") for s in range(subjects) for m in metrics]
        return table(rows, metrics=metrics)

    three = ("psnr", "ssim", "flip")
    assert [g.title for g in made(3, three).grids()] == [""]
    wide = made(8, three).grids()
    assert [g.title for g in wide] == ["PSNR ↑", "SSIM ↑", "FLIP ↓"]
    assert [len(g.columns) for g in wide] == [8, 8, 8]
    assert [(g.labels, g.groups[0]) for g in wide] == [([], "s0")] * 3
    assert [len(g.columns) for g in made(12, three).grids()] == [6] * 6
    narrow = made(2, three).grids(4)
    assert [(g.title, len(g.columns), g.groups) for g in narrow] == [("s0", 3, []), ("s1", 3, [])]
    for subjects in range(1, 14):
        whole = made(subjects, three)
        shown = [c for g in whole.grids() for c in g.columns]
        assert sorted(map(repr, shown)) == sorted(map(repr, whole.columns))


def test_what_only_the_paper_has_stands_alone_with_the_rows_that_it_has(full):
    ours, printed = full.grids()
    assert [c.kind for c in ours.columns] == ["ours"]
    assert printed.title == "printed in the paper, not run"
    assert [full.rows[r] for r in printed.rows] == [name for name in full.rows if name != "lbs"]


def test_markdown_has_one_width_a_grid(full):
    text = typeset.markdown(full)
    lines = [line for line in text.splitlines() if line.startswith("|")]
    for grid in full.grids():
        mine, lines = lines[: 3 + len(grid.rows)], lines[3 + len(grid.rows) :]
        assert {line.replace("\\|", "").count("|") for line in mine} == {len(grid.columns) + 2}
    assert lines == []
    assert "**17.0**" in text
    assert "<ins>30.0</ins>" in text
    assert "*ours, substitute*" in text


def test_latex_is_balanced_and_escaped(full):
    text = typeset.latex(full)
    body = [line for line in text.splitlines() if line.endswith(r"\\") and "&" in line]
    widths = {line.replace(r"\&", "").count("&") for line in body if "multicolumn" not in line}
    assert widths == {len(grid.columns) for grid in full.grids()}
    assert text.count("{") - text.count(r"\{") == text.count("}") - text.count(r"\}")
    assert r"a|b\_c \& <d>" in text
    assert r"\textbf{17.0}" in text
    assert r"\underline{30.0}" in text
    assert text.count(r"\begin{") == text.count(r"\end{") == 1 + len(full.grids())
    assert text.isascii()


class _Cells(HTMLParser):
    """Checks that tags close in order, and gathers rows of cells."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.rows: list[list[str]] = []

    def handle_starttag(self, tag, attrs):
        if tag in ("meta", "img", "br"):
            return
        self.open.append(tag)
        if tag == "tr":
            self.rows.append([])
        if tag in ("td", "th"):
            self.rows[-1] += [""] * int(dict(attrs).get("colspan", 1))

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if {"td", "th"} & set(self.open):
            self.rows[-1][-1] += data


def test_html_parses_and_is_escaped(full):
    text = typeset.html(full)
    parser = _Cells()
    parser.feed(text)
    assert parser.open == []
    assert {len(cells) for cells in parser.rows} == {len(grid.columns) + 1 for grid in full.grids()}
    assert "<b>17.0</b>" in text
    assert "<u>30.0</u>" in text
    assert "<d>" not in text
    assert "<more>" not in text


def test_terminal_shows_every_number_once_a_subject(full):
    out = io.StringIO()
    Console(file=out, width=100).print(typeset.terminal(full))
    text = " ".join(out.getvalue().split())  # titles wrap in narrow grids
    for word in ("17.0", "30.0", "printed in the paper, not run", "33.7", "ours, substitute"):
        assert word in text


def test_a_detail_is_folded_on_a_page(full):
    folded = replace(full, folded=True)
    parser = _Cells()
    parser.feed(typeset.html(folded))
    assert parser.open == []
    assert "<summary>T</summary>" in typeset.html(folded)
    text = typeset.markdown(folded)
    assert text.startswith("<details>\n\n<summary>T</summary>\n\n")
    assert text.endswith("\n\n</details>\n")


def test_footnotes_are_numbered_in_reading_order(full):
    assert full.footnotes[0].endswith("over the MLP")  # the first row that has one
    assert len(full.footnotes) == len(set(full.footnotes)) == 4
    assert typeset.cell_text(full.columns[0], Cell()) == ("–", "")
    assert typeset.cell_text(full.columns[0], Cell(note="lost")) == ("?", "")


def test_means_are_of_what_every_subject_has():
    def case(subject: str, method: str, value: float) -> pd.DataFrame:
        metrics = Metrics(("psnr",), ("dB",), np.array([value]))
        labels = {"experiment": "e", "dataset": "d", "variant": "", "seed": 0, "key": "k"}
        return rows_of(metrics, subject=subject, method=method, **labels)

    rows = join([case("a", "ours", 30.0), case("b", "ours", 20.0), case("a", "other", 10.0)])
    found = with_means(rows)
    means = found[found["dataset"] == "mean"]
    assert means[["method", "value"]].values.tolist() == [["ours", 25.0]]
    assert with_means(rows[rows["subject"] == "a"])["dataset"].eq("d").all()


def test_a_case_without_numbers_leaves_the_others_as_they_are():
    nothing = row("lbs", 1.0).iloc[:0].astype({"seed": float})
    made = to_csv(join([row("lbs", 1.5), nothing]))
    assert made == to_csv(row("lbs", 1.5))
