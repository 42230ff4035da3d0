"""The paper's stages in their order: a case's config becomes nodes of the graph.

This is the only place that knows which stage feeds which. A stage's function is named in ``flows.schema``, which also
reads its settings from there.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field

from flows import intake, schema
from flows.config import NO_ABLATION, Case
from flows.garments import plan_garment
from flows.graph import Graph, Node
from flows.intake import Output
from flows.source import FILES, signature
from tasks.driving.drive import existing
from tasks.errors import InputError


@dataclass(frozen=True)
class Planned:
    """A case in the graph: the nodes whose artefacts the report reads. beside: metrics with a row of their own, by its
    name."""

    case: Case
    name: str
    metrics: tuple[Node, ...]
    nodes: dict[str, Output] = field(default_factory=dict)
    beside: dict[str, Node] = field(default_factory=dict)


def plan(case: Case, graph: Graph) -> Planned:
    """Adds a case's stages to the graph; ``pipeline: make_scenes`` ends with images, ``reconstruct`` with what is seen,
    ``rig`` with the skeleton, ``animate`` with unseen poses; a benchmark measures a stage against a peer."""
    config = case.config
    name = f"{case.data} {case.method}" + (f" {case.variant}" if case.variant != NO_ABLATION else "")

    def add(stage: str, function: str, node: dict, outputs: str, title: str | None = None, **inputs: object) -> Node:
        settings = schema.arguments(function, node, case.seed if stage == "animate" else config["seed"])
        path = next((settings[n] for n in FILES if settings.get(n)), None)
        about = {"outputs": tuple(outputs.split()), "case": name, "path": path, "title": title}
        return graph.add(stage, function, settings, **about, **inputs)

    if config["pipeline"] == "make_garments":
        made = plan_garment(case, name, graph)
        return Planned(case, name, (made["metrics"][0],), made)
    if config["pipeline"] in schema.BENCHMARKS:
        return _benchmark(case, name, add)
    if config["pipeline"] == "make_scenes":
        nodes, measured = intake.scene(config, add, file_name(name))
        return Planned(case, name, tuple(measured), nodes)
    if config["pipeline"] == "reconstruct":
        nodes, measured = intake.reconstruct(config, add)
        return Planned(case, name, tuple(measured), nodes)
    nodes = _rig(config, add)
    shared = {n: nodes[n] for n in ("train", "canonical", "skinning", "skeleton", "poses")}
    metrics = [add("evaluate", schema.EVALUATE_RIG, config["evaluate"], "metrics", "evaluate rig", **shared)]
    if config["pipeline"] == "animate":
        nodes |= _animation(config, add, nodes)
        nodes |= intake.posed(config, add, nodes)
        unseen = {n: nodes[n] for n in ("animation", "test", "canonical")}
        metrics.append(add("evaluate", schema.EVALUATE, config["evaluate"], "metrics", **unseen))
        metrics += intake.unseen_views(config, add, nodes)
        nodes |= _confidence(config, add, nodes)
        seen = {n: nodes[n] for n in ("confidence", "animation", "test")}
        metrics.append(add("evaluate", schema.EVALUATE_CONFIDENCE, {}, "metrics", **seen))
        metrics += _by_part(config, add, nodes)
        metrics += _left_out(case, add, nodes)
    if config["pipeline"] == "drive":
        nodes |= _driven(config, add, nodes)
    return Planned(case, name, tuple(metrics), nodes, _other_joints(config, add, nodes))


def _driven(config: dict, add, nodes: dict[str, Output]) -> dict[str, Output]:
    """The method's answer to poses out of a file, for which there is no truth."""
    existing(config["drive"]["path"])
    if schema.animate_function(config["animate"]["function"]) == schema.FLOOR:
        raise InputError(
            "method", expected="a method that answers poses", found="the floor below all, fitted to the truth"
        )
    found = add(
        "drive", schema.DRIVE, config["drive"], "motion poses about", skeleton=nodes["skeleton"], train=nodes["train"]
    )
    known = nodes | _database(add, nodes)
    answer = _answer(config, add, known, nodes["train"], found["poses"], nodes["test"])
    driven = {f"driven_{output}": found[output] for output in found.outputs}
    return driven | {"driven_animation": answer}


def _benchmark(case: Case, name: str, add) -> Planned:
    """A stage of ours, timed in one stage of its own, beside a peer where there is one."""
    config, function = case.config, schema.BENCHMARKS[case.config["pipeline"]]
    if config["pipeline"] == "benchmark_matching":
        nodes = _rig(config, add)
        nodes |= _database(add, nodes)
        own = {"matching": schema.arguments(schema.MATCHING, config["animate"], config["seed"])}
        inputs = {"training": _training(nodes, nodes["train"]), "query": nodes["query"]}
        measured = add("benchmark", function, config["benchmark"] | own, "metrics", **inputs)
        return Planned(case, name, (measured,), nodes)
    nodes = intake.data(config, add)
    inputs = {n: nodes[n] for n in signature(function)[0] if n != "surface"}
    own = {}
    if config["pipeline"] == "benchmark_skeleton":
        own = {"tracing": schema.arguments(schema.CURVE, config["skeleton"]["curve"], config["seed"])}
        surface = config["skeleton"]["surface"]
        inputs["surface"] = add("surface", schema.SURFACE, surface, "surface", canonical=nodes["canonical"])["surface"]
    elif config["pipeline"] == "benchmark_stages":
        own = _all_stages(config)
    elif "clustering" in signature(function)[1]:
        stages = {"clustering": schema.CLUSTER, "decomposition": schema.SSDR}
        own = {n: schema.arguments(f, config["bones"], config["seed"]) for n, f in stages.items()}
    outputs = "metrics picture" if config["pipeline"] == "scale_bones" else "metrics"
    measured = add("benchmark", function, config["benchmark"] | own, outputs, **inputs)
    drawn = {"picture": measured["picture"]} if "picture" in measured.outputs else {}
    return Planned(case, name, (measured,), nodes | drawn)


def _all_stages(config: dict) -> dict[str, dict]:
    """The settings of every stage without training, by the names that a benchmark has for them."""
    skeleton = config["skeleton"]
    stages = {
        "clustering": (schema.CLUSTER, config["bones"]),
        "decomposition": (schema.SSDR, config["bones"]),
        "closing": (schema.SURFACE, skeleton["surface"]),
        "tracing": (schema.CURVE, skeleton["curve"]),
        "jointing": (schema.JOINTS["motion"], skeleton["motion"]),
        "posing": (schema.POSES, skeleton["poses"]),
        "parting": (schema.PARTS, config["parts"]),
        "matching": (schema.MATCHING, config["animate"]),
    }
    return {name: schema.arguments(function, node, config["seed"]) for name, (function, node) in stages.items()}


def _rig(config: dict, add) -> dict[str, Output]:
    """Stages 1 to 3: data, bones, skeleton, parts."""
    data = intake.data(config, add)
    train, test, canonical = data["train"], data["test"], data["canonical"]
    bones = config["bones"]
    clusters = add("clusters", schema.CLUSTER, bones, "clusters", train=train, canonical=canonical)["clusters"]
    decompose = schema.BONES[bones["kind"]]
    fitted = add("bones", decompose, bones, "skinning", train=train, canonical=canonical, clusters=clusters)
    skinning = fitted["skinning"]

    found = _skeleton(config["skeleton"], add, train, test, canonical, skinning)
    inputs = {"skeleton": found["skeleton"], "skinning": skinning}
    parts = add("parts", schema.PARTS, config["parts"], "parts", **inputs)["parts"]
    nodes = data | {"clusters": clusters, "skinning": skinning}
    return nodes | found | {"parts": parts}


def _animation(config: dict, add, nodes: dict[str, Output]) -> dict[str, Output]:
    """Stage 4: the database, and the method's answer to the unseen poses."""
    found = _database(add, nodes)
    return found | {"animation": _answer(config, add, nodes | found, nodes["train"], nodes["query"], nodes["test"])}


def _database(add, nodes: dict[str, Output]) -> dict[str, Output]:
    inputs = {n: nodes[n] for n in ("train", "skinning", "poses")}
    return {"database": add("database", schema.DATABASE, {}, "database", **inputs)["database"]}


def _training(nodes: dict[str, Output], motion: Output) -> dict[str, Output]:
    """All that a method may learn from."""
    return {"motion": motion, **{n: nodes[n] for n in ("canonical", "skinning", "skeleton", "parts", "database")}}


def _answer(config: dict, add, nodes: dict[str, Output], motion: Output, query: Output, truth: Output) -> Output:
    """The method, trained on a motion, on the poses of a query. truth: only for the floor below all methods."""
    method = schema.animate_function(config["animate"]["function"])
    if method == schema.FLOOR:
        return add("animate", method, {}, "animation", unseen=truth, skinning=nodes["skinning"])["animation"]
    inputs = {"training": _training(nodes, motion), "query": query}
    return add("animate", method, config["animate"], "animation", **inputs)["animation"]


def _confidence(config: dict, add, nodes: dict[str, Output]) -> dict[str, Output]:
    """How far the unseen poses lie from the database."""
    inputs = {"training": _training(nodes, nodes["train"]), "query": nodes["query"]}
    return {
        "confidence": add("confidence", schema.CONFIDENCE, config["confidence"], "confidence", **inputs)["confidence"]
    }


def _by_part(config: dict, add, nodes: dict[str, Output]) -> list[Node]:
    """Errors by clip and part, of data whose skeleton is given: joints found by us have no names that say something.
    The parts are the same for all methods, those of FullMM, too."""
    if config["skeleton"]["kind"] != "given":
        return []
    kind = {"kind": "auto"} if config["parts"]["kind"] == "whole" else {}
    settings = config["parts"] | kind | {"affinity": 0.0}
    parts = add("parts", schema.PARTS, settings, "parts", skeleton=nodes["skeleton"], skinning=nodes["skinning"])
    inputs = {n: nodes[n] for n in ("animation", "test", "skinning")} | {"parts": parts["parts"]}
    return [add("evaluate", schema.EVALUATE_PARTS, {}, "metrics", **inputs)]


def _left_out(case: Case, add, nodes: dict[str, Output]) -> list[Node]:
    """The method again without one training clip, in turn: on the unseen clips and on the one left out. Of several
    seeds, the first."""
    config = case.config
    runs, of = config["evaluate"]["left_out"], config["evaluate"]["left_out_of"]
    if (
        runs == 0
        or (of is not None and case.dataset not in of)
        or case.seed != (config["sweep"]["seeds"] or [case.seed])[0]
    ):
        return []
    scores = {}
    for run in range(runs):
        inputs = {n: nodes[n] for n in ("train", "test", "skinning", "poses", "query")}
        rest = add(
            "left_out", schema.LEAVE_OUT, {"run": run, "runs": runs}, "motion skinning database asked truth", **inputs
        )
        without = nodes | {n: rest[n] for n in ("skinning", "database")}
        answer = _answer(config, add, without, rest["motion"], rest["asked"], rest["truth"])
        inputs = {"animation": answer, "truth": rest["truth"], "test": nodes["test"]}
        scores[f"run_{run}"] = add("evaluate", schema.EVALUATE_LEFT_OUT, {}, "metrics", **inputs)["metrics"]
    return [add("evaluate", schema.SPREAD, {}, "metrics", scores=scores)]


def _skeleton(settings: dict, add, train, test, canonical, skinning) -> dict[str, Output]:
    """Stage 3: the data's own skeleton, or one found on the curve; poses of the training and of the unseen frames."""
    if settings["kind"] == "given":
        skeleton = add("skeleton", schema.GIVEN_SKELETON, {}, "skeleton", train=train, canonical=canonical)["skeleton"]

        def pose(motion, which: str):
            inputs = {"motion": motion, "train": train, "canonical": canonical, "skeleton": skeleton}
            return add("poses", schema.GIVEN_POSES, {}, "poses", f"poses, {which}", **inputs)["poses"]

        return {"skeleton": skeleton, "poses": pose(train, "seen"), "query": pose(test, "unseen")}

    surface = add("surface", schema.SURFACE, settings["surface"], "surface", canonical=canonical)["surface"]
    curve = add("curve", schema.CURVE, settings["curve"], "curve", surface=surface)["curve"]
    joints = settings["joints"]
    inputs = {"train": train, "canonical": canonical, "skinning": skinning, "surface": surface, "curve": curve}
    skeleton = add("skeleton", schema.JOINTS[joints], settings[joints], "skeleton", **inputs)["skeleton"]

    def fit(motion, which: str):
        inputs = {"motion": motion, "canonical": canonical, "skeleton": skeleton}
        return add("poses", schema.POSES, settings["poses"], "poses", f"poses, {which}", **inputs)["poses"]

    poses = {"poses": fit(train, "seen"), "query": fit(test, "unseen")}
    return {"surface": surface, "curve": curve, "skeleton": skeleton} | poses


def _other_joints(config: dict, add, nodes: dict[str, Output]) -> dict[str, Node]:
    """The other way to joints, held against the true rig where there is one: every report shows both."""
    skeleton = config["skeleton"]
    if skeleton["kind"] == "given":
        return {}
    (way,) = [name for name in schema.JOINTS if name != skeleton["joints"]]
    settings = dict(skeleton[way])
    if way == "gradient":
        settings["refits"] = 0  # they fit its weights, which nobody asks for, and leave the joints where they are
    inputs = {n: nodes[n] for n in ("train", "canonical", "skinning", "surface", "curve")}
    found = add("skeleton", schema.JOINTS[way], settings, "skeleton", f"skeleton by {way}", **inputs)["skeleton"]
    inputs = {"train": nodes["train"], "canonical": nodes["canonical"], "skeleton": found}
    measured = add("evaluate", schema.EVALUATE_JOINTS, config["evaluate"], "metrics", **inputs)
    return {f"by {way}": measured}


def file_name(text: str) -> str:
    return re.sub(r"[^A-Za-z0-9.-]+", "_", text)
