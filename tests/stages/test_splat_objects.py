"""Gaussians that others made: what we write of them is what they wrote."""

from __future__ import annotations

import json

import numpy as np
import pytest

from tasks.export.splat_files import WRITERS
from tests.analytic.splats import read_ply, read_splat

OBJECTS = ("spot", "bob", "cat", "koala", "penguin")


@pytest.mark.parametrize("name", OBJECTS)
def test_published_splats_are_written_again(shared_data, name):
    file = shared_data / "splat_objects" / f"{name}_10k.splat"
    found = read_splat(file.read_bytes())
    assert json.loads((shared_data / "splat_objects" / f"{name}_meta.json").read_text())
    assert len(found.means) == 10_000
    assert np.ptp(found.means, axis=0).max() == pytest.approx(1, abs=0.02)  # "longest axis = 1"
    assert (found.opacities == 1).all()
    assert found.scales.shape == (10_000, 3)
    assert (found.scales > 0).all()
    flat = found.scales.min(1) / found.scales.max(1)
    assert np.median(flat) < 0.3  # "flat disks"
    np.testing.assert_allclose(np.linalg.norm(found.quaternions, axis=1), 1, atol=1e-5)
    ours, theirs = (np.frombuffer(d, np.uint8).reshape(-1, 32) for d in (WRITERS["splat"](found), file.read_bytes()))
    assert np.array_equal(ours[:, :28], theirs[:, :28])
    rounded = np.abs(ours[:, 28:].astype(int) - theirs[:, 28:])  # theirs are of unit length but for rounding
    assert rounded.max() <= 1
    np.testing.assert_allclose(read_ply(WRITERS["ply"](found)).scales, found.scales, rtol=1e-5)


def test_discs_lie_along_the_surface(shared_data):
    """The thin axis of a disc is the surface's normal there: quaternions, their order and sign, are read rightly."""
    from scipy.spatial import cKDTree

    found = read_splat((shared_data / "splat_objects" / "spot_10k.splat").read_bytes())
    from tasks.geometry.rotations import from_quaternion

    thin = found.scales.argmin(1)
    axis = from_quaternion(found.quaternions)[np.arange(len(thin)), :, thin]
    _, near = cKDTree(found.means).query(found.means, 12)
    offset = found.means[near] - found.means[near].mean(1, keepdims=True)
    normal = np.linalg.svd(offset)[2][:, 2]
    assert np.median(np.abs((axis * normal).sum(1))) > 0.97
