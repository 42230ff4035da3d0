"""Two reports side by side, and the committed ones against their own numbers."""

from __future__ import annotations

import numpy as np
import pytest

from flows.report import compare, main
from flows.shelf import made_again
from flows.source import ROOT
from tasks.reporting.report import read_provenance, write_report
from tasks.reporting.rows import join, rows_of
from tasks.values import Metrics

COMMITTED = sorted(p.parent for p in (ROOT / "reports").glob("*/provenance.json"))


def written(folder, values: dict[str, float], **changes):
    """A report with one number for each metric, under origin that differs as said."""
    case = {
        "experiment": folder.name,
        "dataset": "d",
        "subject": "s",
        "method": "m",
        "variant": "",
        "seed": 0,
        "key": "k",
    }
    rows = join([rows_of(Metrics((n,), ("mm",), np.array([v])), **case) for n, v in values.items()])
    config = {"animate": {"k": 5}, "report": {"name": folder.name}}
    stages = [
        {
            "stage": name,
            "cases": ["d m"],
            "outputs": {"out": name},
            "source": "one",
            "how": "computed",
            "seconds": 0,
            "peak_mb": 0,
        }
        for name in ("split", "poses", "poses", "animate")
    ]
    origin = {
        "machine": {"cpu": "x"},
        "git": {"commit": "a"},
        "inputs": {"x.npz": "1"},
        "cases": [{"dataset": "d", "method": "m", "variant": "none", "config": config}],
        "stages": stages,
    }
    write_report(folder, rows, [], [], origin | changes)
    return folder


def test_equal_reports(tmp_path, capsys):
    a, b = (written(tmp_path / name, {"rmse": 1 / 3, "max_error": 2.0}) for name in "ab")
    found = compare(a, b)
    assert (found.moved, found.same, found.differences, found.first) == ([], 2, [], [])
    assert main([str(a), str(b)]) == 0
    assert "2 equal to the last bit" in capsys.readouterr().out


def test_what_moved_is_told_with_what_changed(tmp_path, capsys):
    a = written(tmp_path / "a", {"rmse": 100.0, "max_error": 1.0, "seconds": 5.0, "joint_f1": 0.5})
    stages = [dict(s) for s in read_provenance(a)["stages"]]
    stages[2] |= {"outputs": {"out": "other"}}
    stages[3] |= {"outputs": {"out": "other"}, "source": "two"}
    config = {"animate": {"k": 7}, "report": {"name": "b"}}
    changes = {
        "stages": stages,
        "inputs": {"x.npz": "2"},
        "cases": [{"dataset": "d", "method": "m", "variant": "none", "config": config}],
    }
    b = written(tmp_path / "b", {"rmse": 100.5, "max_error": 1.5, "seconds": 9.0, "rmse_pct": 3.0}, **changes)
    found = compare(a, b)
    assert [m.place[4] for m in found.moved] == ["max_error", "rmse"]
    assert found.moved[1].change == pytest.approx(0.5 / 100.5)
    assert found.timed == 1
    assert [p[4] for p in found.only_a] == ["joint_f1"]
    assert [p[4] for p in found.only_b] == ["rmse_pct"]
    assert found.first == ["poses (d m)"]
    assert ("config animate.k (d m none)", "5", "7") in found.differences
    assert ("inputs x.npz", "1", "2") in found.differences
    assert ("code of the stages", "animate", "changed") in found.differences
    assert main([str(a), str(b), "--tolerance", "0.01"]) == 0
    said = capsys.readouterr().out
    assert "0 equal to the last bit, 1 moved within a relative 0.01, 1 further" in said
    assert "+50 %" in said


def test_another_machine_has_a_tolerance_the_same_has_none(tmp_path, capsys):
    a = written(tmp_path / "a", {"rmse": 100.0})
    b = written(tmp_path / "b", {"rmse": 100.5})
    c = written(tmp_path / "c", {"rmse": 100.5}, machine={"cpu": "y"})
    for other, words in ((b, "within a relative 0, 1 further"), (c, "1 moved within a relative 0.01, 0 further")):
        assert main([str(a), str(other)]) == 0
        assert words in capsys.readouterr().out


def test_a_folder_without_a_report_is_one_line(tmp_path, capsys):
    a = written(tmp_path / "a", {"rmse": 1.0})
    assert main([str(a), str(tmp_path / "none")]) == 2
    assert capsys.readouterr().err.count("\n") == 1


@pytest.mark.parametrize("folder", COMMITTED, ids=lambda p: p.name)
def test_committed_tables_are_what_their_numbers_make(folder):
    """After a change of how tables look: python -m flows.report --render reports/*."""
    origin = read_provenance(folder)
    if "missing" not in origin:
        pytest.skip(f"an older version's report, to be run again: {' '.join(origin['command'])}")
    again = made_again(folder)
    assert {"metrics.csv", "table.md", "table.tex", "table.html"} <= set(again)
    for name, data in again.items():
        if name == "table.html" and not (folder / name).exists():
            continue  # not committed: it holds every figure again, as reports/index.html does
        assert (folder / name).read_bytes() == data, f"{folder.name}/{name} is not what metrics.csv makes"
