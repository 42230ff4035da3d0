"""Which stage feeds which where Gaussians come first: nothing of the unseen frames may reach what is learned."""

from __future__ import annotations

import pytest

from flows import config
from flows.exhibits import plan_files
from flows.graph import Graph, Node
from flows.pipeline import Planned, plan
from tasks.errors import InputError

TABLE4 = ["+experiment=table4", "sweep.datasets=[scene_figure]"]


def planned(overrides: list[str]) -> dict[str, Planned]:
    graph = Graph()
    cases = config.expand(overrides)
    return {case.method: plan(case, graph) for case in cases}


def behind(node: Node) -> set[tuple[str, str]]:
    """(stage, output) of all that a node is made from."""
    found: set[tuple[str, str]] = set()
    pending = [node]
    while pending:
        for value in pending.pop().inputs.values():
            for upstream, output in value.values() if isinstance(value, dict) else [value]:
                if (upstream.stage, output) not in found:
                    found.add((upstream.stage, output))
                    pending.append(upstream)
    return found


def test_no_unseen_frame_reaches_gaussians_bones_skeleton_or_database():
    case = planned(TABLE4)["partmm"]
    for name in ("reconstruction", "skinning", "skeleton", "poses", "parts"):
        assert ("split", "test") not in behind(case.nodes[name][0])
    assert ("split", "train") in behind(case.nodes["reconstruction"][0])
    assert ("scene", "views") not in behind(case.nodes["reconstruction"][0])


@pytest.mark.parametrize("experiment", ["quick", "table3_garments", "table4"])
def test_what_a_method_learns_from_is_made_of_training_frames_alone(experiment):
    """The unseen frames are seen in the query alone, and there through poses; only bounds fit them."""
    cases = planned([f"+experiment={experiment}"])
    judged = {name: case.nodes["animation"][0] for name, case in cases.items() if "animation" in case.nodes}
    assert len(judged) >= 5
    for name, node in judged.items():
        if name == "compression_floor":
            continue
        assert set(node.inputs) == {"training", "query"}
        for part, (upstream, output) in node.inputs["training"].items():
            made = behind(upstream) | {(upstream.stage, output)}
            assert ("split", "test") not in made, (name, part)
            assert ("anchors", "test") not in made, (name, part)
        assert node.inputs["query"][0].stage == "poses"
        for rig in ("skinning", "skeleton", "clusters", "canonical"):
            assert ("split", "test") not in behind(cases[name].nodes[rig][0])


def test_all_methods_are_judged_on_the_same_views():
    cases = planned(TABLE4)
    seen = {(node.id, output) for node, output in (case.nodes["seen"] for case in cases.values())}
    assert len(seen) == 1
    assert cases["partmm"].nodes["reconstruction"] == cases["lbs"].nodes["reconstruction"]
    best = cases["ground_truth"].nodes["reconstruction"][0]
    assert ("split", "test") in behind(best)
    assert ("split", "train") not in behind(best)


def test_gaussian_bones_are_bobs_alone():
    cases = planned(TABLE4)
    function = {
        method: case.nodes["skinning"][0].function for method, case in cases.items() if "skinning" in case.nodes
    }
    assert function["bob"] == "tasks.bones.gaussian:gaussian_bones"
    assert {f for method, f in function.items() if method != "bob"} == {"tasks.bones.ssdr:ssdr"}


def test_images_without_a_fit_are_one_clear_line():
    graph = Graph()
    (case,) = config.expand(["dataset=dnerf", "dataset.path=nowhere", "sweep.datasets=null", "sweep.methods=null"])
    with pytest.raises(InputError, match="reconstruction=cpu"):
        plan(case, graph)


def test_captures_go_down_the_same_stages():
    words = ["dataset=dnerf", "dataset.path=nowhere", "reconstruction=cpu", "sweep.datasets=null"]
    graph = Graph()
    (case,) = config.expand([*words, "sweep.methods=[partmm]"])
    nodes = plan(case, graph).nodes
    assert ("gaussians", "reconstruction") in behind(nodes["skinning"][0])
    (case,) = config.expand([*words, "sweep.methods=[gaussians]"])
    assert [node.stage for node in plan(case, Graph()).metrics] == ["evaluate"]


def exported(overrides: list[str]) -> list[Node]:
    graph = Graph()
    files = plan_files([plan(case, graph) for case in config.expand(overrides)], graph)
    return [node for node, _ in files if node.stage == "export"]


def test_gaussians_are_exported_as_they_are_posed_and_only_where_there_are_some():
    (node,) = exported([*TABLE4, "sweep.methods=[partmm]", "export.formats=[ply]"])
    assert node.inputs["reconstruction"][0].stage == "pose"
    captured = ["dataset=dnerf", "dataset.path=nowhere", "reconstruction=cpu", "sweep.datasets=null"]
    (node,) = exported([*captured, "sweep.methods=[lbs]", "export.formats=[rigged_ply]"])
    assert node.inputs["reconstruction"][0].stage == "pose"
    (node,) = exported(["+experiment=table2", "sweep.datasets=[scene_animal]", "export.formats=[splat]"])
    assert node.inputs["reconstruction"][0].stage == "gaussians"
    with pytest.raises(InputError, match=r"export.formats.*ply: no reconstruction.*reconstruction=cpu"):
        exported(["sweep.datasets=[creature_animal]", "sweep.methods=[lbs]", "export.formats=[ply]"])
    with pytest.raises(InputError, match=r"export.formats.*glb: no canonical"):
        exported(["+experiment=table2", "sweep.datasets=[scene_animal]", "export.formats=[glb]"])


def test_scenes_are_made_of_the_whole_motion_and_are_those_of_table2():
    made = planned(["+experiment=make_scenes", "sweep.datasets=[scene_animal]"])["raycast"]
    fitted = planned(["+experiment=table2", "sweep.datasets=[scene_animal]"])["gaussians"]
    assert made.nodes["views"][0].id == fitted.nodes["views"][0].id
    assert not {stage for stage, _ in behind(made.nodes["scene_files"][0])} & {"split", "gaussians"}


def test_weights_of_lpips_count_by_their_bytes(tmp_path):
    weights = tmp_path / "lpips.npz"
    identities = set()
    for content in (b"one", b"two"):
        weights.write_bytes(content)
        (case,) = config.expand(
            ["dataset=scene_figure", "sweep.datasets=null", "sweep.methods=[gaussians]", f"views.lpips={weights}"]
        )
        views = plan(case, Graph()).metrics[0]
        identities.add(views.files)
    assert len(identities) == 2
