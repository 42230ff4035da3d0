"""Several experiments in one run: what is expanded, what is shared, what is left out and says why."""

from __future__ import annotations

import pytest

from flows.batch import batch, work
from flows.compose import groups
from flows.config import whole
from tasks.errors import InputError

ONE = "sweep.methods=[partmm]"
TWO = "sweep.experiments=[ablation_matching,table3_garments]"


def test_every_experiment_keeps_its_own_cases_and_report():
    found = batch(["+experiment=paper", TWO, "seed=3", ONE])
    alone = {
        name: batch([f"+experiment={name}", "seed=3", ONE]).experiments[0]
        for name in ("ablation_matching", "table3_garments")
    }
    assert found.index
    assert found.config["report"]["name"] == "paper"
    for experiment in found.experiments:
        assert experiment.cases == alone[experiment.name].cases
        assert experiment.arguments == (f"+experiment={experiment.name}", "seed=3", ONE)
        assert {c.config["seed"] for c in experiment.cases} == {3}


def test_equal_stages_of_two_experiments_are_one():
    found = batch(["+experiment=paper", TWO])
    graph, works = work(found.experiments, {"figures": True, "videos": True})
    single = [len(w.graph.nodes) for w in works]
    assert max(single) < len(graph.nodes) < sum(single)
    bones = [n for n in graph.nodes.values() if n.stage == "bones"]
    assert len(bones) == 2  # a garment's bones are the same in both
    assert {c for n in bones for c in n.cases} >= {"garments_tshirt partmm k_1", "garments_dress gru"}
    order = list(graph.nodes)
    assert all(order.index(u.id) < order.index(n.id) for n in graph.nodes.values() for u in n.upstream())


def test_the_paper_names_experiments_that_exist():
    names = whole(["+experiment=paper"])["sweep"]["experiments"]
    assert set(names) <= set(groups()["experiment"])
    assert len(set(names)) == len(names)


def test_data_that_is_not_given_is_left_out_with_the_reason():
    with pytest.raises(InputError, match=r"data for one of them at least.*add dataset.path=… to the command"):
        batch(["+experiment=paper", "sweep.experiments=[table3,quick]", "dataset=mesh_sequence"])
    full = batch(["+experiment=paper", "sweep.experiments=[table3_full]", "data_root=nowhere", ONE]).experiments[0]
    assert {c.dataset for c in full.cases} == {"garments_tshirt", "garments_dress"}
    assert (
        "deer, fox, horse, husky, trex, triceratops, human_samba, human_crane",
        "its file is absent",
    ) in full.not_run


@pytest.mark.parametrize(
    ("override", "word"),
    [("bones.max_bone=3", "max_bones"), ("seed=x", "a whole number"), ("sweep.experiments=[nope]", "'nope'")],
)
def test_a_mistake_is_an_error_and_not_left_out(override, word):
    with pytest.raises(InputError, match=word):
        batch(["+experiment=paper", *([TWO] if "experiments" not in override else []), override])
