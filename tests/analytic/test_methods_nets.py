"""The network baselines: they learn, they repeat bit by bit, they stop early."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tasks.geometry.measure import vertex_rmse
from tasks.methods import gru, lbs, mlp
from tasks.motion import nets
from tests.analytic import planted

SMALL = {
    "hidden": 32,
    "steps": 150,
    "patience": 150,
    "rate": 0.01,
    "represent": "residual",
    "dynamics": False,
    "mirror": False,
    "seed": 0,
}
NETS = [mlp, gru]
A, B = planted.gesture(40, 1), planted.gesture(50, 2)


@pytest.fixture(scope="module")
def train():
    return planted.training([A, B, A])


@pytest.mark.parametrize("net", NETS)
def test_it_fits_what_it_was_shown(train, net):
    query = planted.poses([A, B])
    true = planted.truth(train, query)
    plain = vertex_rmse(lbs.animate(train, query).points, true)
    assert vertex_rmse(net.animate(train, query, **SMALL).points, true) < 0.5 * plain


@pytest.mark.parametrize("net", NETS)
def test_a_seed_gives_the_same_bits_and_another_seed_does_not(train, net):
    query = planted.poses([B])
    quick = SMALL | {"steps": 5}
    one, two = (net.animate(train, query, **quick).points for _ in range(2))
    assert one.tobytes() == two.tobytes()
    assert one.tobytes() != net.animate(train, query, **quick | {"seed": 1}).points.tobytes()


@pytest.mark.parametrize("net", NETS)
def test_moving_the_root_level_moves_the_result(train, net):
    query = planted.poses([B])
    moved = replace(query, translations=query.translations.copy())
    moved.translations[:, 0] += (1.0, 0.5, -2.0)
    quick = SMALL | {"steps": 5, "represent": "root"}
    here, there = net.animate(train, query, **quick).points, net.animate(train, moved, **quick).points
    np.testing.assert_allclose(there, here + np.array([1.0, 0.5, -2.0]), atol=1e-4)


def test_the_held_back_clip_stops_the_training():
    import torch

    rng = np.random.default_rng(0)
    noise = [(rng.normal(size=(30, 4)), rng.normal(size=(30, 2))) for _ in range(2)]
    recipe = nets.Recipe(64, 400, 40, 0.01, "root", False, False, 0)
    best, _ = nets._descend(lambda i, h, o: torch.nn.Linear(i, o), noise[:1], noise[1:], 400, recipe)
    assert best < 400
    unseen, _ = nets._descend(lambda i, h, o: torch.nn.Linear(i, o), noise, [], 7, recipe)
    assert unseen == 7


def test_a_clip_is_held_back_with_its_image_and_seen_alone():
    clips = [[(np.full((5, 1), c), np.full((5, 1), side)) for side in (0, 1)] for c in range(3)]
    train, held = nets._hold_back(clips, np.random.default_rng(0))
    (drawn, side), trained = (int(held[0][0][0, 0]), held[0][1][0, 0]), [int(x[0, 0]) for x, _ in train]
    assert len(held) == 1
    assert side == 0
    assert sorted(trained) == sorted(2 * [c for c in range(3) if c != drawn])


def test_one_clip_and_dynamics(train):
    lone = planted.training([B])
    made = mlp.animate(lone, planted.poses([A[:9]]), **SMALL | {"steps": 20, "dynamics": True})
    assert made.points.shape == (9, *lone.canonical.points.shape)
    assert np.isfinite(made.points).all()
