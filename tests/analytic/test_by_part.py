"""Errors by clip and part, and how a report shows them."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from flows.contents import _part_error_tables
from tasks.evaluation.by_part import evaluate_parts
from tasks.evaluation.metrics import METRICS
from tasks.values import Animation, Motion, Parts, Skinning

# three bones: the first follows the leg alone, the second the leg a little, the third the arm; nothing follows the tail
PARTS = Parts(
    ("leg", "arm", "tail"),
    np.eye(3, dtype=bool),
    np.arange(3, dtype=np.int32),
    np.array([[1.0, 0.3, 0.0], [0.0, 0.7, 1.0], [0.0, 0.0, 0.0]]),
)
# points 0 and 1 lie on the leg, 2 (half the first bone's, half the second's) too, 3 on the arm
WEIGHTS = np.array([[1, 0, 0], [0.8, 0, 0.2], [0.5, 0.5, 0], [0, 1, 0]], np.float32)


def test_a_vertex_counts_for_the_part_that_holds_most_of_it():
    truth = np.zeros((5, 4, 3), np.float32)
    points = truth.copy()
    points[:2, 0, 0] = 3.0  # of three leg vertices one is off by 3 in the first clip
    points[:2, 3, 1] = 2.0
    points[2:, 2, 2] = 6.0
    test = Motion("m", truth, None, np.array([0, 2, 5]), ("a", "b"), 30.0, "m")
    skinning = Skinning(truth[0], WEIGHTS, np.zeros((0, 3, 3, 4), np.float32), np.zeros((0, 2)))
    found = evaluate_parts(Animation(points), test, skinning, PARTS)
    named = dict(zip(found.names, found.values, strict=True))
    unit = 1000.0  # millimetres
    assert named == pytest.approx(
        {
            "part_rmse@a, leg": unit * np.sqrt(3.0),
            "part_rmse@a, arm": unit * 2.0,
            "part_rmse@b, leg": unit * np.sqrt(12.0),
            "part_rmse@b, arm": 0.0,
        }
    )


def rows(methods: list[str]) -> pd.DataFrame:
    kinds = [("rmse", 9.0), ("part_rmse@kick, torso", 5.0), ("part_rmse@kick, arm", 7.0)]
    return pd.DataFrame(
        [
            SimpleNamespace(
                dataset="cloth",
                subject=subject,
                method=method,
                variant="",
                key="",
                seed=0,
                metric=metric,
                value=v + i,
                unit="mm",
            ).__dict__
            for subject in ("dress", "shirt")
            for i, method in enumerate(methods)
            for metric, v in kinds
        ]
    )


def test_a_report_folds_them_with_methods_side_by_side():
    common = {"labels": {"partmm": "PartMM", "robust_lbs": "Robust LBS"}, "bounds": []}
    found = _part_error_tables(rows(["partmm", "nearest", "robust_lbs"]), common)
    assert [t.title for t in found] == ["Error by clip and part: dress", "Error by clip and part: shirt"]
    table = found[0]
    assert table.folded
    assert table.rows == ("kick, torso", "kick, arm")
    assert [(c.group, [cell.value for cell in c.cells]) for c in table.columns] == [
        ("Robust LBS", [7.0, 9.0]),
        ("PartMM", [5.0, 7.0]),
    ]
    assert _part_error_tables(rows(["partmm"]), common) == []  # nothing to compare
    assert "part_rmse" in METRICS
