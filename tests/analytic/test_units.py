"""A character is the same in millimetres as in kilometres, and a hundred of its lengths away from the origin."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tasks.geometry.measure import diagonal
from tasks.methods import bone_kernel, bone_response, gru, lbs, lbs_fitted, lbs_residual, mlp, part_kernel, partmm
from tasks.motion.confidence import confidence
from tasks.motion.database import build_database
from tasks.values import Poses, Training
from tests.analytic import planted
from tests.analytic.test_methods import PAPER

CLIPS = [planted.gesture(40, seed, 0.4) for seed in (1, 2, 3)]
ASKED = [planted.gesture(20, 9, 0.4)]
NET = {"hidden": 16, "steps": 20, "patience": 20, "rate": 0.01, "represent": "residual", "dynamics": True}
NET |= {"mirror": False, "seed": 0}
REGRESSION = {"dynamics": 0.5, "reach": 4, "width": 1.0, "ridge": 0.03, "landmarks": 1000, "mirror": True}
METHODS = {
    "lbs": (lbs, {}),
    "lbs_fitted": (lbs_fitted, {"influences": 4, "keep": 0.1}),
    "lbs_residual": (lbs_residual, {}),
    "mlp": (mlp, NET),
    "gru": (gru, NET),
    "partmm": (partmm, PAPER),
    "partmm_plus": (partmm, PAPER | {"levels": 1, "represent": "residual", "dynamics": 0.5, "sources": 30}),
    "shrunk": (partmm, PAPER | {"represent": "residual", "shrink": True}),
    "part_kernel": (part_kernel, REGRESSION | {"represent": "residual", "tune": True}),
    "bone_kernel": (bone_kernel, REGRESSION),
    "bone_response": (
        bone_response,
        {"lag": 2, "lags": 2, "pose": True, "width": 1.0, "ridge": 0.1, "landmarks": 1000},
    ),
}


@pytest.fixture(scope="module")
def train() -> Training:
    return planted.training(CLIPS, affinity=0.0)


def moved(train: Training, scale: float, offset: np.ndarray) -> Training:
    """The character with x -> scale x + offset for every point of it, at rest and in motion."""

    def place(points: np.ndarray) -> np.ndarray:
        return (scale * points.astype(np.float64) + offset).astype(np.float32)

    bones = train.skinning.transforms.astype(np.float64)
    bones[..., 3] = scale * bones[..., 3] + offset - bones[..., :3] @ offset
    motion = replace(train.motion, points=place(train.motion.points))
    skinning = replace(train.skinning, rest=place(train.skinning.rest), transforms=bones.astype(np.float32))
    known = train.database.poses
    return replace(
        train,
        motion=motion,
        canonical=replace(train.canonical, points=place(train.canonical.points)),
        skinning=skinning,
        skeleton=replace(train.skeleton, joints=place(train.skeleton.joints)),
        database=build_database(motion, skinning, shifted(known, scale)),
    )


def shifted(poses: Poses, scale: float) -> Poses:
    return Poses(poses.rotations, (scale * poses.translations).astype(np.float32), poses.clip_start)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_no_method_minds_the_unit(train, method, scale):
    module, settings = METHODS[method]
    query = planted.poses(ASKED)
    here = module.animate(train, query, **settings).points
    there = module.animate(moved(train, scale, np.zeros(3)), shifted(query, scale), **settings).points / scale
    assert np.abs(there - here).max() < 2e-4 * diagonal(train.canonical.points)


@pytest.mark.parametrize("method", METHODS)
def test_no_method_minds_the_place(train, method):
    module, settings = METHODS[method]
    query, far = planted.poses(ASKED), np.array([100.0, -50.0, 200.0])
    here = module.animate(train, query, **settings).points
    there = module.animate(moved(train, 1.0, far), query, **settings).points - far
    assert np.abs(there - here).max() < 2e-3 * diagonal(train.canonical.points)


@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_the_error_to_be_expected_has_the_unit_of_the_data(train, scale):
    settings = {"k": 3, "patch": 5, "dynamics": 1.0}
    query = planted.poses(ASKED)
    here = confidence(train, query, **settings)
    there = confidence(moved(train, scale, np.zeros(3)), shifted(query, scale), **settings)
    np.testing.assert_allclose(there.expected / scale, here.expected, rtol=1e-3)
    np.testing.assert_allclose(there.outside, here.outside, atol=0.02)
