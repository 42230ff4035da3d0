"""The plan of a run: what it says will be computed is what a run then computes."""

from __future__ import annotations

from unittest import mock

import pytest

from flows.batch import batch
from flows.costs import ROUGH, chains
from flows.forecast import forecast, seconds_with, show
from tests.workflow.test_sweep import TOY, World


def test_an_empty_store_knows_nothing_and_is_not_made(tmp_path):
    world = World(tmp_path)
    world.store.path.rmdir()
    found = forecast(world.graph(3.0), world.config)
    assert [(f.cached, f.cost) for f in found] == [(False, None)] * 4
    assert [f.keyed for f in found] == [True, False, False, False]  # what stands behind a stage to compute is not known
    assert not world.store.path.exists()


def test_the_plan_says_what_a_run_computes(tmp_path, prefect_server):
    world = World(tmp_path)
    world.run(world.graph(3.0))
    assert all(f.cached for f in forecast(world.graph(3.0), world.config))
    graph = world.graph(3.0, tail="slow")
    planned = forecast(graph, world.config)
    assert [f.node.stage for f in planned if not f.cached] == ["slow"]
    assert planned[-1].cost is None
    outcome = world.run(graph)
    assert outcome.computed == {f.node.id for f in planned if not f.cached}

    changed = world.graph(3.0, tail="slow")
    next(n for n in changed.nodes.values() if n.stage == "slow").settings["seconds"] = 0.2
    (todo,) = [f for f in forecast(changed, world.config) if not f.cached]
    assert todo.cost.seconds == outcome.refs[list(graph.nodes)[-1]].seconds  # by the same function's past
    assert todo.cost.size > 0
    assert todo.cost.peak_mb > 0


def test_the_expected_time_lies_between_the_longest_chain_and_all_the_work(tmp_path, prefect_server):
    world = World(tmp_path)
    world.run(world.graph(3.0))
    graph = world.graph(5.0)
    found = forecast(graph, world.config)
    assert not any(f.cached for f in found)
    costs = {f.node.stage: f.seconds for f in found}
    assert seconds_with(graph, found, 1) == pytest.approx(sum(costs.values()))
    longest = costs["make"] + max(costs["double"], costs["sign"] + costs["after"])
    assert seconds_with(graph, found, 2) == pytest.approx(longest)
    assert max(chains(graph, {f.node.id: f.seconds for f in found}).values()) == pytest.approx(longest)


def test_the_longest_chain_starts_first(tmp_path, prefect_server):
    world = World(tmp_path)
    world.config["runner"]["workers"] = 1
    long = {f"{TOY}:slow": 50.0}
    graph = world.graph(1.0, 2.0)
    world.chain(graph, 3.0, tail="slow")
    with mock.patch.dict(ROUGH, long):
        world.run(graph)
    assert world.bodies()[0] == "make 3.0"


def test_a_plan_is_sums_and_on_request_every_stage(tmp_path, capsys):
    places = [f"store.path={tmp_path}/store", "sweep.experiments=[quick,ablation_bones]"]
    found = batch(["+experiment=paper", *places])
    show(found)
    short = capsys.readouterr().out
    assert "ablation_bones" in short
    assert "never computed before" in short
    assert "to compute  " not in short
    show(found, every=True)
    assert "to compute  bones      creature_animal" in capsys.readouterr().out
