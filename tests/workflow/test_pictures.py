"""Which cases share a picture."""

from __future__ import annotations

from flows import config
from flows.exhibits import plan_pictures
from flows.graph import Graph
from flows.pipeline import plan


def test_errors_are_drawn_beside_one_truth_only():
    """Fits with and without rigidity end with Gaussians of their own: each has another truth."""
    graph = Graph()
    cases = [plan(case, graph) for case in config.expand(["+experiment=ablation_arap"])]
    pictures = [p for p in plan_pictures(cases, graph) if p.title == "error picture"]
    truths = {case.nodes["animation"][0].id: case.nodes["test"][0].id for case in cases}
    assert len(set(truths.values())) > len(pictures) == 2  # of the figure and the animal
    for picture in pictures:
        drawn = [node.id for node, _ in picture.inputs["animations"].values()]
        assert len(drawn) == 2
        assert {truths[each] for each in drawn} == {picture.inputs["test"][0].id}
