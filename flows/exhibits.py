"""What a report shows of its cases beside their numbers: figures, videos of unseen clips, files to take along."""

from __future__ import annotations

from flows import schema
from flows.config import NO_ABLATION
from flows.garments import plan_manifest
from flows.graph import Graph, Node
from flows.intake import Output
from flows.pipeline import Planned, file_name
from flows.source import signature
from tasks.errors import InputError

# side by side: the first of each that was run
IN_VIDEOS = (("robust_lbs", "lbs"), ("fullmm",), ("partmm",), ("part_cloth", "part_kernel"))
PANELS = 4  # methods or variants side by side in the picture of errors


def plan_files(planned: list[Planned], graph: Graph) -> list[Output]:
    """The files that the report brings along."""
    character = ("skinning", "reconstruction")
    found = [output for p in planned if any(n in p.nodes for n in character) for output in _exports(p, graph)]
    found += [p.nodes["scene_files"] for p in planned if "scene_files" in p.nodes]
    found += _sources(planned, graph)
    made = {p.case.config["dataset"]["garment"]: p for p in planned if "garment_file" in p.nodes}
    if made:
        every = next(iter(made.values())).case.config["make"]["every"]
        found += plan_manifest({garment: p.nodes for garment, p in made.items()}, every, graph)
    return found


def _sources(planned: list[Planned], graph: Graph) -> list[Output]:
    """For every dataset, which training frames its unseen ones resemble, part by part, by the last method's parts."""
    lead = {p.case.data: p for p in planned if "confidence" in p.nodes and p.case.variant == NO_ABLATION}
    found = []
    for data, case in lead.items():
        inputs = {n: case.nodes[n] for n in ("confidence", "test", "train")}
        name = file_name(data)
        function = "tasks.evaluation.confidence:confidence_file"
        node = graph.add("confidence", function, {"name": name}, outputs=("files",), case=data, **inputs)
        found.append(node["files"])
    return found


def _exports(planned: Planned, graph: Graph) -> list[Output]:
    """A case's character for other programs: the method's answer to unseen poses, or the training frames."""
    nodes, seed = planned.nodes, planned.case.seed
    name = file_name(planned.name) + (f"_seed{seed}" if seed else "")
    moving = {"motion": "train", "poses": "poses", "reconstruction": "reconstruction"}
    if "driven_animation" in nodes:
        moving = {n: f"driven_{n}" for n in ("motion", "poses", "animation")}
    elif "animation" in nodes:
        moving = {"motion": "test", "poses": "query", "reconstruction": "posed", "animation": "animation"}
    values = {n: n for n in ("canonical", "skinning", "skeleton")} | moving
    values = {n: nodes[value] for n, value in values.items() if value in nodes}
    found = []
    for kind in planned.case.config["export"]["formats"]:
        function = schema.EXPORTS[kind]
        missing = [n for n in signature(function)[0] if n not in values and n != "animation"]
        if missing:
            do = "add reconstruction=cpu" if missing == ["reconstruction"] else "leave it out"
            raise InputError("export.formats", expected="what this run makes", found=f"{kind}: no {missing[0]}", do=do)
        inputs = {n: values[n] for n in signature(function)[0] if n in values}
        node = graph.add("export", function, {"name": name}, outputs=("files",), case=planned.name, **inputs)
        found.append(node["files"])
    return found


def plan_pictures(planned: list[Planned], graph: Graph) -> list[Node]:
    """The figures of a report: for every dataset, its last case, and the errors of some methods or variants."""
    drawn = [p.nodes[n] for p in planned for n in ("picture", "frames_picture") if n in p.nodes]
    found = [node for node, _ in drawn]
    found += _views_pictures([p for p in planned if "rendered" in p.nodes], graph)
    planned = [p for p in planned if "skinning" in p.nodes]  # benchmarks make none
    for data in dict.fromkeys(p.case.data for p in planned):
        cases = [p for p in planned if p.case.data == data]
        cases = [p for p in cases if p.case.seed == min(q.case.seed for q in cases if q.case.method == p.case.method)]
        truth = cases[0].nodes.get("test")  # that of other Gaussians has other points
        cases = [p for p in cases if p.nodes.get("test") == truth]
        first = [p for p in cases if p.case.variant == cases[0].case.variant]
        shown = first if len(first) > 1 else cases
        found += _pictures(_side_by_side(shown), graph)
    return found


def _side_by_side(cases: list[Planned]) -> list[Planned]:
    """The few that a picture has room for, in their order: the last, those of ``IN_VIDEOS``, the first, the latest."""
    methods = {p.case.method: p for p in reversed(cases)}
    known = [next(methods[m] for m in names if m in methods) for names in IN_VIDEOS if {*names} & {*methods}]
    wanted = [cases[-1], *known, cases[0], *reversed(cases)]
    chosen = list({id(p): p for p in wanted})[:PANELS]
    return [p for p in cases if id(p) in chosen]


def _views_pictures(planned: list[Planned], graph: Graph) -> list[Node]:
    """What the same cameras saw and what methods or variants show them, side by side."""
    seen: dict[Output, list[Planned]] = {}
    for case in planned:
        node, output = case.nodes["seen"]
        seen.setdefault((node.id, output), []).append(case)
    found = []
    for cases in seen.values():
        rendered = {label: p.nodes["rendered"] for label, p in zip(_labels(cases), cases, strict=True)}
        function, truth = "tasks.drawing.pictures:views_picture", cases[0].nodes["seen"]
        inputs = {"truth": truth, "rendered": dict(list(rendered.items())[:PANELS])}
        found.append(graph.add("figures", function, {}, outputs=("picture",), case=cases[0].case.data, **inputs))
    return found


def plan_videos(planned: list[Planned], graph: Graph) -> list[Node]:
    """For every dataset, truth and the methods of ``IN_VIDEOS`` in an unseen clip, where two of them or more were run;
    a character that a file drives."""
    found = [_driven_video(p, graph) for p in planned if "driven_animation" in p.nodes]
    planned = [p for p in planned if "animation" in p.nodes and p.case.variant == NO_ABLATION]
    for data in dict.fromkeys(p.case.data for p in planned):
        methods = {p.case.method: p for p in reversed(planned) if p.case.data == data}  # of several seeds, the first
        chosen = [next((methods[m] for m in names if m in methods), None) for names in IN_VIDEOS]
        shown = [p for p in chosen if p]
        if len(shown) < 2:
            continue
        animations = {label: p.nodes["animation"] for label, p in zip(_labels(shown), shown, strict=True)}
        inputs = {n: shown[0].nodes[n] for n in ("test", "canonical")} | {"animations": animations}
        function, settings = "tasks.drawing.pictures:clip_picture", {"focus": list(animations)[-1]}
        found.append(graph.add("video", function, settings, outputs=("picture",), case=data, **inputs))
    return found


def _driven_video(planned: Planned, graph: Graph) -> Node:
    inputs = {"motion": planned.nodes["driven_motion"], "animation": planned.nodes["driven_animation"]}
    inputs["canonical"] = planned.nodes["canonical"]
    function = "tasks.drawing.pictures:driven_clip"
    return graph.add("video", function, {}, outputs=("picture",), case=planned.case.data, **inputs)


def _labels(cases: list[Planned]) -> list[str]:
    """What to call cases side by side: their methods, or their variants where those are the same."""
    labels = [p.case.config["animate"]["label"] for p in cases]
    return labels if len(set(labels)) == len(labels) else [p.case.variant for p in cases]


def _pictures(shown: list[Planned], graph: Graph) -> list[Node]:
    lead = shown[-1]

    def add(function: str, names: str, settings: dict | None = None, **inputs: object) -> Node:
        path = f"tasks.drawing.pictures:{function}"
        inputs |= {n: lead.nodes[n] for n in names.split()}
        about = {"outputs": ("picture",), "case": lead.case.data, "title": function.replace("_", " ")}
        return graph.add("figures", path, settings or {}, **about, **inputs)

    pictures = [
        add("skeleton_picture", "train canonical skeleton parts"),
        add("parts_picture", "train canonical skinning parts"),
        add("bones_picture", "train canonical skinning"),
        add("count_picture", "train canonical clusters"),
    ]
    if "animation" in lead.nodes:
        labels = _labels(shown)
        animations = {label: p.nodes["animation"] for label, p in zip(labels, shown, strict=True)}
        errors = add("error_picture", "test canonical", {"focus": labels[-1]}, animations=animations)
        pictures.append(_confidence_picture(lead, animations, graph))
        pictures.insert(0, errors)
    if "driven_animation" in lead.nodes:
        moving = {"animation": lead.nodes["driven_animation"], "motion": lead.nodes["driven_motion"]}
        pictures.insert(0, add("driven_picture", "canonical", **moving))
    return pictures


def _confidence_picture(lead: Planned, animations: dict[str, Output], graph: Graph) -> Node:
    function = "tasks.drawing.confidence:confidence_picture"
    inputs = {n: lead.nodes[n] for n in ("confidence", "test")} | {"animations": animations}
    return graph.add("figures", function, {}, outputs=("picture",), case=lead.case.data, **inputs)
