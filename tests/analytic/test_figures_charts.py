"""Charts of rows, with the places of their dots worked out by hand."""

from __future__ import annotations

import xml.etree.ElementTree as ET

import numpy as np
import pytest

from tasks.drawing.charts import ablation_chart, clips_chart
from tasks.reporting.rows import join, rows_of
from tasks.values import Metrics


def row(value: float, *, metric="rmse", subject="horse", method="partmm", variant="", seed=0):
    metrics = Metrics((metric,), ("mm",), np.array([value]))
    case = {"experiment": "e", "dataset": "d", "subject": subject, "method": method, "variant": variant}
    return rows_of(metrics, seed=seed, key="k", **case)


def read(svg: str) -> tuple[dict[str, float], list[tuple[float, float]], list[str]]:
    """Pixels of the numbers under the axis, the dots that are no legend, and all words."""
    elements = list(ET.fromstring(svg).iter())
    ticks, words = {}, []
    for e in elements:
        if e.tag.endswith("text"):
            words.append(e.text)
            if e.get("text-anchor") == "middle" and e.text.replace("−", "").replace(".", "").isdigit():
                ticks[float(e.text.replace("−", "-"))] = float(e.get("x"))
    found = [
        (float(e.get("cx")), float(e.get("cy"))) for e in elements if e.tag.endswith("circle") and e.get("r") == "4.5"
    ]
    return ticks, found, words


def values_at(ticks: dict[float, float], dots: list) -> np.ndarray:
    slope, start = np.polyfit(list(ticks.values()), list(ticks), 1)
    return np.array([slope * x + start for x, _ in dots])


def test_changes_are_taken_seed_by_seed():
    rows = join(
        [
            row(10.0),
            row(20.0, seed=1),
            row(11.0, variant="k_1"),
            row(22.0, variant="k_1", seed=1),  # + 10 % with either seed: no whisker
            row(5.0, variant="k_3"),
            row(16.0, variant="k_3", seed=1),  # - 50 % and - 20 %
        ]
    )
    svg = ablation_chart(rows, metric="rmse", method="partmm", labels={"partmm/k_1": "K = 1", "partmm": "PartMM"})
    ticks, dots, words = read(svg)
    assert values_at(ticks, dots) == pytest.approx([10, -35], abs=0.3)
    assert {"K = 1", "k_3", "PartMM", "change of RMSE [%], left is better"} <= set(words)
    whiskers = [e for e in ET.fromstring(svg).iter() if e.tag.endswith("line") and e.get("stroke-width") == "2"]
    assert len(whiskers) == 1
    ends = values_at(ticks, [(float(whiskers[0].get(x)), 0) for x in ("x1", "x2")])
    assert ends[1] - ends[0] == pytest.approx(2 * np.std([-50, -20], ddof=1), abs=0.6)


def test_a_subject_without_a_variant_has_no_dot_there():
    horse = [row(10.0), row(11.0, variant="a"), row(9.0, variant="b")]
    rows = join([*horse, row(4.0, subject="cat"), row(5.0, variant="a", subject="cat")])
    ticks, dots, words = read(ablation_chart(rows, metric="rmse", method="partmm", labels={}))
    assert sorted(values_at(ticks, dots)) == pytest.approx([-10, 10, 25], abs=0.3)
    assert {"horse", "cat", "a", "b"} <= set(words)


def test_an_ablation_needs_the_plain_method():
    with pytest.raises(ValueError, match="no partmm without a variant on d/horse"):
        ablation_chart(join([row(1.0, variant="a")]), metric="rmse", method="partmm", labels={})


def test_clips():
    rows = join(
        [
            row(9.0),
            row(10.0, metric="rmse@walk"),
            row(20.0, metric="rmse@run"),
            row(30.0, metric="rmse@run", seed=1),
            row(12.0, metric="rmse@walk", method="lbs"),
            row(1.0, metric="rmse@walk", subject="cat"),
        ]
    )
    ticks, dots, words = read(clips_chart(rows, metric="rmse", dataset="d", subject="horse", labels={"lbs": "LBS"}))
    assert sorted(values_at(ticks, dots)) == pytest.approx([10, 12, 25], abs=0.3)
    assert {"walk", "run", "LBS", "partmm", "RMSE [mm]"} <= set(words)
    with pytest.raises(ValueError, match="no rows rmse@clip of d/dog"):
        clips_chart(rows, metric="rmse", dataset="d", subject="dog", labels={})
