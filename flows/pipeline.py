"""The paper's stages in their order: a case's config becomes nodes of the graph.

This is the only place that knows which stage feeds which. A stage's function is named in ``flows.schema``, which also
reads its settings from there.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from flows import schema
from flows.config import Case
from flows.graph import Graph, Node


@dataclass(frozen=True)
class Planned:
    """A case in the graph: the nodes whose artefacts the report reads."""

    case: Case
    name: str
    metrics: tuple[Node, ...]
    nodes: dict[str, tuple[Node, str]] = field(default_factory=dict)


def plan(case: Case, graph: Graph) -> Planned:
    """Adds a case's stages to the graph."""
    config = case.config
    seed = config["seed"]
    name = f"{case.dataset} {case.method}" + (f" {case.variant}" if case.variant != "none" else "")

    def add(stage: str, function: str, node: dict, outputs: str, **inputs: object) -> Node:
        settings = schema.arguments(function, node, seed)
        path = settings.get("path") if stage == "dataset" else None
        return graph.add(stage, function, settings, outputs=tuple(outputs.split()), case=name, path=path, **inputs)

    data = config["dataset"]
    motion = add("dataset", schema.load_function(data["kind"]), data, "motion")["motion"]
    halves = add("split", schema.SPLIT, config["split"], "train test", motion=motion)
    train, test = halves["train"], halves["test"]
    canonical_node = {"choice": config["skeleton"]["canonical"]}
    canonical = add("canonical", schema.CANONICAL, canonical_node, "canonical", train=train)["canonical"]

    bones = config["bones"]
    clusters = add("clusters", schema.CLUSTER, bones, "clusters", train=train, canonical=canonical)["clusters"]
    decompose = schema.SSDR if bones["kind"] == "ssdr" else schema.RIGID
    skinning = add("bones", decompose, bones, "skinning", train=train, canonical=canonical, clusters=clusters)[
        "skinning"
    ]

    found = _skeleton(config["skeleton"], add, train, test, canonical, skinning)
    skeleton = found["skeleton"]
    database = add("database", schema.DATABASE, {}, "database", train=train, skinning=skinning, poses=found["poses"])
    parts = add("parts", schema.PARTS, config["parts"], "parts", skeleton=skeleton, skinning=skinning)["parts"]

    training = {
        "motion": train,
        "canonical": canonical,
        "skinning": skinning,
        "skeleton": skeleton,
        "database": database["database"],
        "parts": parts,
    }
    method = schema.animate_function(config["animate"]["function"])
    animation = add("animate", method, config["animate"], "animation", training=training, query=found["query"])
    unseen = {"animation": animation["animation"], "test": test, "canonical": canonical}
    result = add("evaluate", schema.EVALUATE, config["evaluate"], "metrics", **unseen)
    shared = {"train": train, "canonical": canonical, "skinning": skinning, "skeleton": skeleton}
    rig = add("evaluate", schema.EVALUATE_RIG, config["evaluate"], "metrics", **shared, poses=found["poses"])
    named = {"test": test, "clusters": clusters, "animation": animation["animation"]}
    return Planned(case, name, (result, rig), named | found | training)


def _skeleton(settings: dict, add, train, test, canonical, skinning) -> dict[str, tuple[Node, str]]:
    """Stage 3: the data's own skeleton, or one found on the curve; poses of the training and of the unseen frames."""
    if settings["kind"] == "given":
        skeleton = add("skeleton", schema.GIVEN_SKELETON, {}, "skeleton", train=train, canonical=canonical)["skeleton"]

        def pose(motion):
            inputs = {"motion": motion, "canonical": canonical, "skeleton": skeleton}
            return add("poses", schema.GIVEN_POSES, {}, "poses", **inputs)["poses"]

        return {"skeleton": skeleton, "poses": pose(train), "query": pose(test)}

    surface = add("surface", schema.SURFACE, settings["surface"], "surface", canonical=canonical)["surface"]
    curve = add("curve", schema.CURVE, settings["curve"], "curve", surface=surface)["curve"]
    joints = settings["joints"]
    inputs = {"train": train, "canonical": canonical, "skinning": skinning, "surface": surface, "curve": curve}
    skeleton = add("skeleton", schema.JOINTS[joints], settings[joints], "skeleton", **inputs)["skeleton"]

    def fit(motion):
        inputs = {"motion": motion, "canonical": canonical, "skeleton": skeleton}
        return add("poses", schema.POSES, settings["poses"], "poses", **inputs)["poses"]

    return {"surface": surface, "curve": curve, "skeleton": skeleton, "poses": fit(train), "query": fit(test)}


def plan_pictures(planned: list[Planned], graph: Graph) -> list[Node]:
    """The figures of a report: for every dataset, its last case and the errors of up to four methods or variants."""
    found: list[Node] = []
    for dataset in dict.fromkeys(p.case.dataset for p in planned):
        cases = [p for p in planned if p.case.dataset == dataset]
        first = [p for p in cases if p.case.variant == cases[0].case.variant]
        shown = (first if len(first) > 1 else cases)[:4]
        found += _pictures(shown, graph)
    return found


def _pictures(shown: list[Planned], graph: Graph) -> list[Node]:
    lead = shown[-1]

    def add(function: str, settings: dict, **inputs: object) -> Node:
        path = f"tasks.evaluation.pictures:{function}"
        return graph.add("figures", path, settings, outputs=("picture",), case=lead.case.dataset, **inputs)

    def take(*names: str) -> dict:
        return {n: lead.nodes["motion" if n == "train" else n] for n in names}

    labels = [p.case.config["animate"]["label"] for p in shown]
    if len(set(labels)) < len(labels):
        labels = [p.case.variant for p in shown]
    animations = {label: p.nodes["animation"] for label, p in zip(labels, shown, strict=True)}
    return [
        add("error_picture", {"focus": labels[-1]}, **take("test", "canonical"), animations=animations),
        add("skeleton_picture", {}, **take("train", "canonical", "skeleton", "parts")),
        add("parts_picture", {}, **take("train", "canonical", "skinning", "parts")),
        add("bones_picture", {}, **take("train", "canonical", "skinning")),
        add("count_picture", {}, **take("train", "canonical", "clusters")),
    ]
