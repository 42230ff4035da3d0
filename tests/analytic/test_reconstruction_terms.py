"""The terms of the fit's loss and the steps between, each against what can be worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from tasks.reconstruction import density
from tasks.reconstruction.adam import Adam
from tasks.reconstruction.cuts import View
from tasks.reconstruction.losses import photometric
from tasks.reconstruction.nodes import BOUND, Nodes
from tasks.reconstruction.rigidity import rotation_of
from tasks.reconstruction.splines import spline


def test_rotation_vectors_are_rodrigues():
    vectors = np.random.default_rng(0).normal(0, 1.5, (50, 3))
    found = rotation_of(torch.from_numpy(vectors)).numpy()
    np.testing.assert_allclose(found, Rotation.from_rotvec(vectors).as_matrix(), atol=1e-9)


def test_a_grey_error_costs_what_the_paper_says():
    """GA eq. 2: all pixels off by a tenth, of which a quarter of the image is looked at."""
    true = torch.full((20, 20, 3), 0.4)
    true[::2] += 0.2
    alpha = torch.full((20, 20), 0.5)
    seen = View(torch.eye(4), torch.eye(3), true, alpha, 4 * 20 * 20)
    background = torch.tensor([0.2, 0.4, 0.6])
    wanted = true + 0.5 * background
    terms, squared = photometric(wanted + 0.1, alpha - 0.3, seen, background, structure=0.2, cover=0.1)
    assert terms["colour"].item() == pytest.approx(0.8 * 0.1, rel=1e-5)
    assert terms["alpha"].item() == pytest.approx(0.1 * 0.3, rel=1e-5)
    assert squared.item() == pytest.approx(0.1**2 / 4, rel=1e-5)  # outside of what is looked at nothing is wrong
    equal, _ = photometric(wanted, alpha, seen, background, structure=0.2, cover=0.1)
    assert max(term.item() for term in equal.values()) == pytest.approx(0.0, abs=1e-6)
    assert terms["structure"].item() > 0.0


def test_gaussians_follow_near_nodes_by_a_bell_as_wide_as_the_nodes_are_apart():
    points = np.stack([np.arange(12.0), np.zeros(12), np.zeros(12)], axis=1).astype(np.float32)
    nodes = Nodes.placed(spline(np.array([0, 10]), 4.0), points, 12)
    nodes.bind(np.float32([[5.0, 0, 0], [5.25, 0, 0]]))
    assert nodes.weights.shape == (2, BOUND)
    for row, at in enumerate((5.0, 5.25)):
        away = nodes.rest.numpy()[nodes.index[row].numpy(), 0] - at
        bell = np.exp(-(away**2) / 2)
        np.testing.assert_allclose(nodes.weights[row].numpy(), bell / bell.sum(), atol=1e-5)


def test_an_even_motion_is_not_rough_and_a_bend_costs_its_square():
    points = np.random.default_rng(1).normal(size=(40, 3)).astype(np.float32)
    nodes = Nodes.placed(spline(np.array([0, 20, 30]), 4.0), points, 8)
    with torch.no_grad():
        nodes.table[:] = torch.arange(len(nodes.table), dtype=torch.float32)[:, None, None]
    assert nodes.roughness().item() == pytest.approx(0.0, abs=1e-8)
    with torch.no_grad():
        nodes.table[:] = 0.0
        nodes.table[3, 0, 4] = 1.0  # a knot inside of the first clip: seen as 1, -2, 1 by three differences
    inside = sum(int(n) - 2 for n in np.diff(nodes.spline.clip_knots))
    assert nodes.roughness().item() == pytest.approx(6.0 / inside)


def test_both_halves_of_a_divided_gaussian_lie_about_its_place():
    count = 50
    params = {
        "means": torch.zeros(count, 3),
        "log_scales": torch.full((count, 1), -1.0),
        "opacities": torch.full((count,), 3.0),
        "sh": torch.zeros(count, 1, 3),
    }
    params["means"][:, 0] = 10.0 * torch.arange(count)
    pull = density.Pull(count)
    pull.add(torch.ones(count, 3))
    made = density.divide(params, Adam(), pull, 60, 0.2, np.random.default_rng(0))
    assert made == 10
    means = params["means"].detach()
    halves = means[count:]
    parents = (halves[:, 0] / 10.0).round().long()
    apart = means[parents] - halves
    middle = (means[parents] + halves) / 2
    np.testing.assert_allclose(middle[:, 0], 10.0 * parents, atol=1e-4)
    np.testing.assert_allclose(middle[:, 1:], 0.0, atol=1e-5)
    assert 0.2 < apart.norm(dim=1).mean().item() / (2 * density.APART * np.exp(-1.0)) / np.sqrt(3) < 2.0
