"""The plan of a run: what it says will be computed is what a run then computes."""

from __future__ import annotations

from flows.forecast import critical_path, forecast
from tests.workflow.test_sweep import World


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


def test_the_longest_chain_bounds_the_time(tmp_path, prefect_server):
    world = World(tmp_path)
    world.run(world.graph(3.0))
    found = forecast(world.graph(5.0), world.config)
    assert not any(f.cached for f in found)
    costs = {f.node.stage: f.cost.seconds for f in found}
    assert critical_path(found) == costs["make"] + max(costs["double"], costs["sign"] + costs["after"])
