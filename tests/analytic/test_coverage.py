"""What of the paper was measured: every printed cell has a status, and the paper's own data wins."""

from __future__ import annotations

import re
from dataclasses import replace

import cv2
import numpy as np
import pytest

from tasks.drawing import video
from tasks.reporting import index
from tasks.reporting.coverage import Measured, claims, cover
from tasks.reporting.page import size_of
from tasks.reporting.paper import paper_of
from tasks.reporting.rows import join
from tasks.values import Motion, Picture
from tests.analytic.test_tables import row, table


def paper():
    cell = {"table": 3, "dataset": "vto", "subject": "dress", "metric": "rmse", "unit": "mm", "read": "clear"}
    cells = [cell | {"method": m, "value": v} for m, v in (("lbs", 52.2), ("gru", 37.5), ("peer", 40.0))]
    cells.append(cell | {"dataset": "d4d", "subject": "animals", "method": "lbs", "value": 65.3})
    absent = {"methods": {"peer": "not ours"}, "columns": {"d4d/animals": "on request"}}
    return paper_of(
        {"source": "s", "methods": {}, "columns": {"vto/dress": "VTO dress"}, "absent": absent, "cells": cells}
    )


def ours(value: float, status: str) -> Measured:
    rows = join(
        [
            row("lbs", value, dataset=status, subject="cloth"),
            row("gru", value, dataset=status, subject="cloth", variant="k"),
        ]
    )
    return Measured(3, rows, {status: status}, {f"{status}/cloth": "vto/dress"})


def statuses(cells) -> dict[tuple[str, str], tuple]:
    return {(c.method, c.column): (c.ours, c.status, c.why) for c in cells}


def test_every_cell_has_a_status_and_a_reason():
    found = statuses(cover(paper(), [ours(60.0, "substitute")], {})[3])
    assert found == {
        ("lbs", "VTO dress"): (60.0, "substitute data", ""),
        ("gru", "VTO dress"): (None, "not run", "not measured in this run"),  # a variant is not the method
        ("peer", "VTO dress"): (None, "not run", "not ours"),
        ("lbs", "d4d/animals"): (None, "not run", "on request"),
    }


def test_the_papers_own_data_wins_and_a_run_knows_best_what_is_absent():
    both = [ours(60.0, "substitute"), ours(52.0, "paper")]
    found = statuses(cover(paper(), both, {"d4d/animals": "its file is absent"})[3])
    assert found["lbs", "VTO dress"] == (52.0, "reproduced", "")
    assert found["lbs", "d4d/animals"][2] == "its file is absent"


def test_a_mean_over_several_datasets_stands_beside_a_printed_mean():
    known = paper()
    known = replace(
        known, means={"d4d/animals": ["fox", "horse"]}, ours={"gru": "net"}, remarks={"d4d/animals": "units"}
    )
    values = {"fox": (10.0, 12.0), "horse": (20.0,), "cat": (500.0,)}
    rows = join([row("lbs", v, dataset=d, subject=d, seed=s) for d, each in values.items() for s, v in enumerate(each)])
    rows = join([rows, row("net", 30.0, dataset="cloth", subject="cloth")])
    found = cover(known, [Measured(3, rows, {}, {"cloth/cloth": "vto/dress"})], {"d4d/animals": "absent"})[3]
    assert statuses(found)["lbs", "d4d/animals"] == (15.5, "substitute data", "")  # a subject's seeds count as one
    assert statuses(found)["gru", "VTO dress"] == (30.0, "substitute data", "")
    (animals,) = [c for c in found if c.column == "d4d/animals"]
    assert animals.of == ("fox", "horse")
    assert animals.remark == "units"


def test_claims_say_whether_the_order_of_two_rows_is_the_papers():
    known = replace(paper(), leads={3: "gru"})
    for value, holds in ((40.0, True), (70.0, False)):
        rows = join([row(m, v, dataset="s", subject="c") for m, v in (("lbs", 50.0), ("gru", value), ("mlp", 1.0))])
        (claim,) = claims(known, cover(known, [Measured(3, rows, {}, {"s/c": "vto/dress"})], {}))[3]
        assert (claim.lead, claim.other, claim.column) == ("gru", "lbs", "VTO dress")
        assert claim.printed == pytest.approx(100 * (37.5 / 52.2 - 1))
        assert claim.ours == pytest.approx(100 * (value / 50.0 - 1))
        assert claim.holds == holds


def test_what_stands_beside_the_paper_exists():
    from flows.compose import groups
    from flows.contents import paper_numbers

    known = paper_numbers()
    assert {d for several in known.means.values() for d in several} <= set(groups()["dataset"])
    assert set(known.ours.values()) <= set(groups()["method"])
    assert set(known.ours) | set(known.leads.values()) <= set(known.methods)
    assert set(known.means) | set(known.remarks) <= set(known.columns)


def test_the_page_holds_all_and_loads_nothing():
    figure = Picture("count", "a <chart>", svg='<svg xmlns="http://www.w3.org/2000/svg"></svg>')
    made = table([row("lbs", 60.0)])
    sections = [
        index.Section("one", "The <first>", "python -m flows.run +experiment=one", [made], [figure], []),
        index.Section("two", "Second", "python -m flows.run +experiment=two", [], [figure], [("deer", "no file")]),
    ]
    page = index.html("Title", sections, cover(paper(), [ours(60.0, "substitute")], {}), {"git": {"commit": "abc"}})
    assert page.count("<svg") == 1  # the same figure is shown once
    assert "The &lt;first&gt;" in page
    assert "<b>deer</b> not run: no file" in page
    assert "4 cells: 0 on the paper's data, 1 on substitute data, 3 not run" in page.replace("&#39;", "'")
    assert "+7.8" in page  # 60.0 - 52.2
    assert "width=device-width" in page
    assert not re.findall(r'(?:src|href)="(?!data:|#)', page)


def square(frames: int) -> Motion:
    """A square that grows upwards, in two clips."""
    rest = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32)
    points = np.repeat(rest[None], frames, 0)
    points[:, :, 1] *= np.linspace(1, 2, frames)[:, None]
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    start = np.array([0, frames // 2, frames])
    return Motion("square", points, faces, start, ("a", "b"), 25.0, "m", rest)


def test_a_video_shows_the_median_clip_of_the_method_in_focus():
    motion = square(40)
    wrong = motion.points.copy()
    wrong[20:] += 0.5  # clip b is the worse, and of two the upper one is taken
    data, caption = video.clip_video(motion, {"exact": motion.points, "off": wrong}, 1.5, focus="off", azimuth=0.3)
    picture = Picture("video", caption, webp=np.frombuffer(data, np.uint8))
    assert "clip b" in caption
    assert picture.suffix == "webp"
    done, animation = cv2.imdecodeanimation(picture.webp)
    assert done
    assert len(animation.frames) == 10  # every second of 20 frames
    assert list(animation.durations) == [80] * 10
    assert animation.loop_count == 0
    assert size_of(picture) == animation.frames[0].shape[1::-1]
    again, _ = video.clip_video(motion, {"exact": motion.points, "off": wrong}, 1.5, focus="off", azimuth=0.3)
    assert again == data


def test_a_driven_shape_is_shown_at_the_files_pace_from_its_beginning():
    motion = square(200)
    data = video.driven_video(motion.points, motion.faces, 25.0, azimuth=0.3)
    done, animation = cv2.imdecodeanimation(np.frombuffer(data, np.uint8))
    assert done
    assert list(animation.durations) == [80] * video.LONGEST  # every second frame, and no more than fit


@pytest.mark.parametrize("limit", [10**9, 9000])
def test_a_video_that_is_too_large_is_written_in_less_quality(monkeypatch, limit):
    rng = np.random.default_rng(0)
    noise = [cv2.resize(rng.integers(0, 256, (12, 12, 3), np.uint8), (96, 96)) for _ in range(8)]
    best = len(video.animated(noise, 0.1))
    monkeypatch.setattr(video, "LARGEST", limit)
    found = len(video.animated(noise, 0.1))
    assert (found == best) == (best <= limit)
    assert found <= best
