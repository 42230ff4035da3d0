"""The true motion of Gaussians on a surface that is known: for data that was rendered."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tasks.errors import InputError
from tasks.geometry.nearest import anchor
from tasks.values import Motion


def anchored(gaussians: Motion, train: Motion, test: Motion) -> Motion:
    """The frames of ``test`` as the Gaussians should show them: each follows the surface point that is nearest to it
    in the first training frame.

    gaussians: (F, N, 3), reconstructed from images of ``train`` and frame by frame with it; train, test: meshes of one
    topology -> (F_test, N, 3) bare points with the test's clips, and its rig without weights. Raises InputError where
    the data has no faces, or other frames than the Gaussians.
    """
    if train.faces is None:
        raise InputError(
            f"dataset {train.name}", expected="a mesh", found="bare points", do="choose a dataset with faces"
        )
    if train.frames != gaussians.frames:
        raise ValueError(f"{gaussians.frames} frames of Gaussians against {train.frames} of the surface")
    points = anchor(gaussians.points[0], train.points[0], train.faces).follow(test.points)
    rig = test.rig
    if rig is not None:
        rig = replace(rig, weights=np.zeros((0, len(rig.parents)), np.float32))
    return replace(test, points=points, faces=None, rest=None, rig=rig)
