"""Figures and metrics on real meshes: a dancer in a skirt and a rigged horse."""

from __future__ import annotations

import numpy as np

from tasks.datasets import canonical, mesh_sequence, rigged_character
from tasks.drawing import figures
from tasks.evaluation.metrics import frame_rmse
from tasks.geometry import measure, rigid
from tasks.values import Skeleton, Skinning


def covered(image: np.ndarray) -> float:
    return float(np.mean(np.abs(image.astype(int) - image[0, 0]).max(-1) > 8))


def test_a_dancer(shared_data):
    path = str(shared_data / "mesh_sequences" / "human_samba.npz")
    motion = mesh_sequence.load(path=path, fps=30.0, faces=True, unit="unit").take_frames([slice(0, 20)], ["samba"])
    shape = canonical.canonical(motion, choice="middle")
    lag = motion.points[np.maximum(np.arange(20) - 3, 0)]  # three frames late: right where nothing moves
    errors = frame_rmse(lag, motion.points)
    assert errors[0] == 0.0
    assert errors[10] > 0.0
    diagonal = measure.diagonal(shape.points)
    settings = {"focus": "late", "azimuth": figures.azimuth_of(motion)}
    image = figures.error_figure(motion, {"late": lag}, diagonal, **settings)
    assert 0.08 < covered(image) < 0.5
    assert np.array_equal(image, figures.error_figure(motion, {"late": lag}, diagonal, **settings))


def test_a_rigged_horse(shared_data):
    path = str(shared_data / "rigged_quaternius" / "decoded" / "horse.npz")
    motion = rigged_character.load(path=path, fps=30.0, hierarchy="attached", unit="unit")
    shape = canonical.canonical(motion, choice="rest")
    rig, azimuth = motion.rig, figures.azimuth_of(motion)
    skeleton = Skeleton(rig.names, rig.parents, rig.joints, rig.weights)
    image = figures.skeleton_figure(shape, skeleton, None, azimuth=azimuth)
    assert 0.05 < covered(image) < 0.6
    skinning = Skinning(shape.points, rig.weights, rigid.identity(1, len(rig.names)), np.zeros(1))
    assert 0.05 < covered(figures.bones_figure(shape, skinning, azimuth=azimuth)) < 0.6
