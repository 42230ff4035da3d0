"""Path errors of Gaussians against a surface whose motion is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tasks.evaluation.paths import evaluate_paths
from tasks.values import Gaussians, Motion, Reconstruction

FRAMES = 5


def sheet_and_gaussians(lift: float, drift: float, stray: int = 0) -> tuple[Reconstruction, Motion]:
    """A unit square in the xy plane that rises by one a frame, and Gaussians over it: lifted off, drifting along x."""
    corners = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32)
    rise = np.arange(FRAMES, dtype=np.float32)[:, None, None] * np.float32([0, 0, 1])
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    start = np.array([0, FRAMES], np.int64)
    truth = Motion("sheet", corners + rise, faces, start, ("clip",), 24.0)
    inner = np.random.default_rng(0).uniform(0.1, 0.9, (40, 3)).astype(np.float32)
    inner[:, 2] = lift
    along = np.arange(FRAMES, dtype=np.float32)[:, None, None] * np.float32([drift, 0, 0])
    points = inner + rise + along
    points[:, :stray] += 100.0
    opacities = np.ones(40, np.float32)
    opacities[:stray] = 0.4
    scales = np.full((40, 1), 0.01, np.float32)
    rest = Gaussians(points[0], scales, None, opacities, np.zeros((40, 1, 3), np.float32))
    times = np.linspace(0, 1, FRAMES).astype(np.float32)
    empty = np.zeros((0, 3))
    found = Reconstruction("sheet", rest, points, None, None, None, times, 24.0, start, ("clip",), "unit", None, empty)
    return found, truth


@pytest.mark.parametrize(("lift", "drift"), [(0.0, 0.0), (0.1, 0.0), (0.0, 0.2)])
def test_path_error_is_lift_and_drift_in_percent_of_the_diagonal(lift, drift):
    found = evaluate_paths(*sheet_and_gaussians(lift, drift))
    start, whole = 100 * lift / np.sqrt(2), 100 * (lift + drift * np.arange(FRAMES).mean()) / np.sqrt(2)
    assert found.names == ("path_pct", "path_start_pct")
    assert found.units == ("%", "%")
    np.testing.assert_allclose(found.values, [whole, start], atol=1e-3)


def test_transparent_gaussians_do_not_count():
    found = evaluate_paths(*sheet_and_gaussians(0.1, 0.0, stray=5))
    np.testing.assert_allclose(found.values, 10 / np.sqrt(2), atol=1e-3)


def test_truth_of_other_frames_is_refused():
    found, truth = sheet_and_gaussians(0.0, 0.0)
    with pytest.raises(ValueError, match="surface of triangles"):
        evaluate_paths(found, replace(truth, faces=None))
