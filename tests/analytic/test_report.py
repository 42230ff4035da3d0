"""A report is whole or not there, and a failed one leaves the earlier one as it was."""

from __future__ import annotations

import hashlib
import json
import os
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from tasks.drawing import render
from tasks.errors import InputError
from tasks.reporting import page, report
from tasks.reporting.report import write_report
from tasks.reporting.rows import from_csv, rows_of
from tasks.reporting.tables import build
from tasks.values import Metrics, Picture

PIXELS = Picture("errors", "errors <of> all", np.frombuffer(render.png(np.full((4, 6, 3), 200, np.uint8)), np.uint8))
DRAWING = Picture("count", "count", None, '<svg xmlns="http://www.w3.org/2000/svg"></svg>')
PROVENANCE = {
    "command": ["python", "-m", "flows.run"],
    "git": {"commit": "0123456789abcdef", "changed": True},
    "inputs": {"horse.npz": "f" * 64},
    "stages": [
        {"stage": "bones", "cases": ["a", "b"], "seconds": 1.25, "peak_mb": 310.0, "how": "computed"},
        {"stage": "split", "cases": ["a"], "seconds": 0.1, "peak_mb": 200.0, "how": "cached"},
    ],
}


def parts(value: float = 1.0):
    metrics = Metrics(("rmse",), ("mm",), np.array([value]))
    case = {"experiment": "e", "dataset": "d", "subject": "s", "method": "m", "variant": "", "seed": 0, "key": "k"}
    rows = rows_of(metrics, **case)
    settings = {"labels": {}, "data_status": {}, "stands_for": {}, "baselines": [], "notes": []}
    return rows, [build(rows, title="T", metrics=["rmse"], **settings)]


def files(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def test_everything_is_there_and_checked(tmp_path):
    folder = tmp_path / "reports" / "quick"
    rows, tables = parts()
    write_report(folder, rows, tables, [("horse", PIXELS), ("horse", DRAWING), ("a b", DRAWING)], PROVENANCE)
    found = files(folder)
    pictures = {"figures/horse_errors.png", "figures/horse_count.svg", "figures/a_b_count.svg"}
    assert set(found) == {"metrics.csv", "table.md", "table.tex", "table.html", "provenance.json"} | pictures
    written = json.loads(found.pop("provenance.json"))
    assert written.pop("files") == {name: hashlib.sha256(data).hexdigest() for name, data in found.items()}
    assert written.pop("figures").keys() == pictures
    assert written == PROVENANCE
    assert from_csv(found["metrics.csv"].decode(), "metrics.csv").equals(rows)
    assert all(f"]({name})" in found["table.md"].decode() for name in pictures)


def test_equal_inputs_give_equal_bytes(tmp_path):
    for name in ("a/same", "b/same"):
        write_report(tmp_path / name, *parts(1 / 3), [("s", PIXELS)], PROVENANCE)
    assert files(tmp_path / "a") == files(tmp_path / "b")


def test_a_newer_report_takes_the_place_of_the_earlier(tmp_path):
    write_report(tmp_path, *parts(1.0), [("s", PIXELS)], PROVENANCE)
    (tmp_path / "mine.txt").write_text("kept")
    (tmp_path / ".new-left").mkdir()  # as a killed run leaves it
    write_report(tmp_path, *parts(2.0), [("s", DRAWING)], PROVENANCE)
    found = files(tmp_path)
    assert "figures/s_errors.png" not in found
    assert "figures/s_count.svg" in found
    assert found["mine.txt"] == b"kept"
    assert b"2.0" in found["metrics.csv"]
    assert not list(tmp_path.glob(".new-*"))


def test_a_report_never_removes_files_outside_its_folder(tmp_path):
    folder = tmp_path / "report"
    folder.mkdir()
    (tmp_path / "precious").write_text("x")
    (folder / "provenance.json").write_text(json.dumps({"files": {"../precious": "", "gone": ""}}))
    write_report(folder, *parts(), [], PROVENANCE)
    assert (tmp_path / "precious").exists()


@pytest.mark.parametrize("call", [0, 3])
def test_a_write_that_fails_leaves_the_earlier_report(tmp_path, monkeypatch, call):
    write_report(tmp_path, *parts(1.0), [("s", PIXELS)], PROVENANCE)
    before = files(tmp_path)
    calls = iter(range(100))

    def full(handle):
        if next(calls) == call:
            raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(InputError, match="No space left on device; choose another"):
        write_report(tmp_path, *parts(2.0), [("s", DRAWING)], PROVENANCE)
    assert files(tmp_path) == before


def test_a_defect_while_drawing_leaves_the_earlier_report(tmp_path):
    write_report(tmp_path, *parts(1.0), [], PROVENANCE)
    before = files(tmp_path)
    with pytest.raises(ValueError, match="two figures"):
        write_report(tmp_path, *parts(2.0), [("s", PIXELS), ("s", PIXELS)], PROVENANCE)
    rows, tables = parts(2.0)
    with pytest.raises(ValueError, match="finite"):
        write_report(tmp_path, rows.assign(value=np.nan), tables, [], PROVENANCE)
    with pytest.raises(ValueError, match="JSON"):
        write_report(tmp_path, *parts(2.0), [], {"seconds": float("inf")})
    assert files(tmp_path) == before


def test_a_folder_that_is_a_file(tmp_path):
    (tmp_path / "report").write_text("in the way")
    with pytest.raises(InputError, match="a folder that can be written"):
        write_report(tmp_path / "report", *parts(), [], PROVENANCE)
    assert (tmp_path / "report").read_text() == "in the way"


def test_writers_take_turns(tmp_path):
    import threading

    pauses = []

    def write(value: float) -> None:
        write_report(tmp_path, *parts(value), [("s", PIXELS)], {**PROVENANCE, "value": value})
        pauses.append(value)

    threads = [threading.Thread(target=write, args=(float(v),)) for v in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(pauses) == [0.0, 1.0, 2.0, 3.0]
    found = files(tmp_path)
    listed = json.loads(found.pop("provenance.json"))["files"]
    assert listed == {name: hashlib.sha256(data).hexdigest() for name, data in found.items()}


class _Tags(HTMLParser):
    VOID = ("meta", "img", "br")

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.loads: list[str] = []

    def handle_starttag(self, tag, attrs):
        given = dict(attrs)
        self.loads += [given[name] for name in ("src", "href") if name in given]
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def test_the_page_parses_and_loads_nothing():
    _, tables = parts()
    text = page.html("A & B", tables, [PIXELS, DRAWING], PROVENANCE)
    tags = _Tags()
    tags.feed(text)
    assert tags.open == []
    assert [load[:22] for load in tags.loads] == ["data:image/png;base64,"]
    assert "<title>A &amp; B</title>" in text
    assert "errors &lt;of&gt; all" in text
    assert "prefers-color-scheme: dark" in text
    assert 'name="viewport"' in text
    assert "1 computed, 1 cached" in text


def test_facts_leave_out_what_is_not_known():
    assert page.facts_of({}) == {}
    facts = page.facts_of(PROVENANCE)
    assert facts["commit"] == "0123456789abcdef with local changes"
    assert facts["inputs"] == "horse.npz (sha256 ffffffffffff…)"
    assert report.PROVENANCE == "provenance.json"
