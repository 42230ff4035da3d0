"""Metrics against numbers worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest

from tasks.errors import InputError
from tasks.evaluation.joints import counting_joints
from tasks.evaluation.metrics import METRICS, clip_keys, evaluate, frame_rmse, metric_of, score, unit_of
from tasks.evaluation.rig import at_canonical, evaluate_rig
from tasks.geometry import rigid
from tasks.geometry.rotations import from_rotation_vector
from tasks.reporting.rows import COLUMNS, from_csv, join, rows_of, to_csv
from tasks.values import Animation, Canonical, Metrics, Motion, Poses, Rig, Skeleton, Skinning

BOX = np.array([[0, 0, 0], [3, 0, 0], [0, 4, 0], [0, 0, 12]], np.float32)  # its bounding box's diagonal is 13


def motion(points: np.ndarray, clips: list[int], unit: str = "unit") -> Motion:
    start = np.concatenate([[0], np.cumsum(clips)])
    names = tuple(f"clip{c}" for c in range(len(clips)))
    return Motion("box", points.astype(np.float32), None, start, names, fps=10.0, unit=unit)


SHAPE = Canonical(BOX, None, 0, "first")


def rig_numbers(shift: float, unit: str = "unit") -> Metrics:
    """Four points that stand still; one bone that is ``shift`` off along x, one joint that is twice that off."""
    train = motion(np.repeat(BOX[None], 3, 0), [3], unit)
    bones = rigid.identity(3, 1)
    bones[..., 0, 3] = shift
    moved = np.zeros((3, 1, 3), np.float32)
    moved[..., 0] = 2 * shift
    turns = np.broadcast_to(np.eye(3, dtype=np.float32), (3, 1, 3, 3)).copy()
    ones = np.ones((4, 1), np.float32)
    skeleton = Skeleton(("root",), np.array([-1], np.int32), BOX[:1], ones)
    skinning = Skinning(BOX, ones, bones, np.zeros(1))
    return evaluate_rig(train, SHAPE, skinning, skeleton, Poses(turns, moved, train.clip_start), turn=5.0)


def numbers(result: Metrics) -> dict[str, float]:
    return dict(zip(result.names, result.values, strict=True))


def test_errors_of_a_known_displacement():
    test = motion(np.repeat(BOX[None], 4, 0), [2, 2])
    made = test.points.copy()
    made[0, 0] += [3, 4, 0]  # one point of 16, 5 away
    made[3] += [0, 0, 2]  # the last frame, every point 2 away
    found = numbers(evaluate(Animation(made), test, SHAPE))
    rmse = np.sqrt((25 + 4 * 4) / 16)
    assert found["rmse"] == pytest.approx(rmse)
    assert found["rmse_coordinate"] == pytest.approx(rmse / np.sqrt(3))
    assert found["rmse_pct"] == pytest.approx(100 * rmse / 13)
    assert found["max_error"] == pytest.approx(5)
    assert found["rmse@clip0"] == pytest.approx(np.sqrt(25 / 8))
    assert found["rmse@clip1"] == pytest.approx(np.sqrt(16 / 8))
    assert found["rmse_pct@clip1"] == pytest.approx(100 * np.sqrt(2) / 13)


def test_bones_and_skeleton_by_themselves():
    found = numbers(rig_numbers(0.5))
    assert found["bones_rmse"] == pytest.approx(0.5)
    assert found["bones_rmse_pct"] == pytest.approx(50 / 13)
    assert found["skeleton_rmse"] == pytest.approx(1.0)
    assert (found["bones_count"], found["joints_count"]) == (1, 1)
    assert numbers(rig_numbers(0.25, "m"))["bones_rmse"] == pytest.approx(250)
    assert numbers(rig_numbers(0.0))["bones_rmse"] == 0.0


def test_true_joints_are_taken_where_the_canonical_frame_has_them():
    turns = np.broadcast_to(np.eye(3, dtype=np.float32), (2, 2, 3, 3)).copy()
    turns[1, 0] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]  # the root turns by 90 degrees about z
    joints = np.array([[1, 0, 0], [3, 0, 0]], np.float32)
    rig = Rig(("a", "b"), np.array([-1, 0]), joints, np.ones((4, 2)) / 2, turns, np.zeros((2, 2, 3), np.float32))
    found = at_canonical(rig, Canonical(BOX, None, 1, ""))
    assert np.allclose(found.joints, [[1, 0, 0], [1, 2, 0]])
    assert np.allclose(found.rotations[1], np.eye(3), atol=1e-6)
    assert np.allclose(found.rotations[0, 0], turns[1, 0].T, atol=1e-6)
    assert np.allclose(found.translations, 0.0, atol=1e-6)
    assert at_canonical(rig, Canonical(BOX, None, -1, "rest")) is rig


def test_true_joints_that_keep_the_turn_of_the_canonical_frame_do_not_count():
    """Both are bent at rest already, one of them goes on turning."""
    turns = from_rotation_vector(np.array([[[0, 0, 0.5], [0, 0, 0.5]], [[0, 0, 0.5], [0, 0, 0.9]]]))
    joints = np.array([[1, 0, 0], [3, 0, 0]], np.float32)
    rig = Rig(("a", "b"), np.array([-1, 0]), joints, np.eye(2)[[0, 0, 1, 1]], turns, np.zeros((2, 2, 3)))
    assert len(counting_joints(at_canonical(rig, Canonical(BOX, None, -1, "rest")), 5.0)[0]) == 2
    assert len(counting_joints(at_canonical(rig, Canonical(BOX, None, 0, "")), 5.0)[0]) == 1


def test_velocities_never_cross_a_cut():
    """Both clips run along x, 1 unit a frame; between them the points jump by 100. The result runs at 3/4 the speed."""
    along = np.zeros((6, 4, 3))
    along[:, :, 0] = np.array([0, 1, 2, 100, 101, 102])[:, None]
    test = motion(BOX + along, [3, 3])
    slow = along.copy()
    slow[:, :, 0] = np.array([0, 0.75, 1.5, 0, 0.75, 1.5])[:, None]
    found = numbers(evaluate(Animation((BOX + slow).astype(np.float32)), test, SHAPE))
    assert found["speed_ratio"] == pytest.approx(0.75)
    assert found["velocity_rmse"] == pytest.approx(0.25 * 10)  # 10 frames a second


def test_velocities_are_left_out_where_there_are_none():
    still = motion(np.repeat(BOX[None], 2, 0), [2])
    assert "speed_ratio" not in numbers(evaluate(Animation(still.points), still, SHAPE))
    single = motion(np.repeat(BOX[None], 2, 0), [1, 1])
    found = numbers(evaluate(Animation(single.points), single, SHAPE))
    assert "velocity_rmse" not in found
    assert found["rmse"] == 0.0


def test_metres_are_reported_in_millimetres():
    test = motion(np.repeat(BOX[None], 2, 0), [2], "m")
    result = evaluate(Animation(test.points + np.float32(0.5)), test, SHAPE)
    units = dict(zip(result.names, result.units, strict=True))
    found = numbers(result)
    assert found["rmse"] == pytest.approx(500 * np.sqrt(3))
    assert (units["rmse"], units["rmse_pct"], units["velocity_rmse"]) == ("mm", "%", "mm/s")
    assert unit_of("length", "unit") == ("unit", 1.0)


def test_a_result_that_does_not_fit_the_truth_is_a_defect():
    test = motion(np.repeat(BOX[None], 2, 0), [2])
    with pytest.raises(ValueError, match="shape"):
        evaluate(Animation(test.points[:1]), test, SHAPE)
    bad = test.points.copy()
    bad[1, 2, 0] = np.nan
    with pytest.raises(ValueError, match="not finite in frame 1"):
        evaluate(Animation(bad), test, SHAPE)


def test_frames_in_pieces_give_the_same_errors():
    rng = np.random.default_rng(0)
    a, b = rng.standard_normal((2, 150, 5, 3)).astype(np.float32)
    direct = np.sqrt(((a.astype(np.float64) - b) ** 2).sum(-1).mean(1))
    assert np.array_equal(frame_rmse(a, b), direct)


def test_every_metric_is_declared_once_with_unit_and_direction():
    test = motion(np.repeat(BOX[None], 4, 0) + np.arange(4)[:, None, None], [2, 2])
    result = evaluate(Animation(test.points + np.float32(0.1)), test, SHAPE)
    assert {name.split("@")[0] for name in (*result.names, *rig_numbers(0.1).names)} <= set(METRICS)
    assert metric_of("rmse@walk") is METRICS["rmse"]
    assert [score(2.0, way) for way in ("lower", "higher")] == [2.0, -2.0]
    assert score(0.5, "one") == score(2.0, "one") > score(1.1, "one")
    assert score(0.0, "one") == np.inf
    assert clip_keys(("walk", "run")) == ["walk", "run"]
    assert clip_keys(("walk", "walk")) == ["walk#0", "walk#1"]


def some_rows(values: np.ndarray):
    metrics = Metrics(tuple(["rmse"] * len(values)), tuple(["mm"] * len(values)), values)
    case = {"experiment": "e", "dataset": "NA", "subject": "001", "method": "lbs", "variant": "", "seed": 0}
    return rows_of(metrics, key="1e5", **case)


def test_csv_gives_back_the_same_bits():
    rng = np.random.default_rng(1)
    values = np.concatenate(
        [rng.standard_normal(200) * 10.0 ** rng.integers(-20, 20, 200), [0.1, 1 / 3, 5e-324, 1e308]]
    )
    rows = some_rows(values)
    text = to_csv(rows)
    back = from_csv(text, "metrics.csv")
    assert text.split("\n", 1)[0] == ",".join(COLUMNS)
    assert back["value"].to_numpy().tobytes() == values.tobytes()
    assert to_csv(back) == text
    assert (back["dataset"][0], back["subject"][0], back["variant"][0], back["key"][0]) == ("NA", "001", "", "1e5")
    assert "\r" not in text


def test_csv_refuses_what_is_no_number():
    with pytest.raises(ValueError, match="finite"):
        to_csv(some_rows(np.array([1.0, np.nan])))
    with pytest.raises(InputError, match=r"metrics\.csv.*columns"):
        from_csv("a,b\n1,2\n", "metrics.csv")
    with pytest.raises(InputError, match="numbers"):
        from_csv(to_csv(some_rows(np.array([1.0]))).replace("1.0", "one"), "metrics.csv")


def test_no_cases_make_an_empty_table():
    assert to_csv(join([])) == ",".join(COLUMNS) + "\n"


def test_joined_rows_keep_their_order():
    first, second = some_rows(np.array([2.0])), some_rows(np.array([1.0])).assign(method="partmm")
    assert join([first, second])["method"].tolist() == ["lbs", "partmm"]
