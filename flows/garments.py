"""The pipeline ``make_garments``: body, patterns, motions, cloth and packed files as stages, one simulation a clip."""

from __future__ import annotations

from flows import schema
from flows.config import Case
from flows.graph import Graph, Node
from flows.schema import GARMENTS, PER_RUN
from tasks.errors import InputError


def plan_garment(case: Case, name: str, graph: Graph) -> dict[str, tuple[Node, str]]:
    """The stages that make one garment, whose name the dataset gives; body and motions are shared by all garments."""
    config = case.config
    make, seed, garment = config["make"], config["seed"], config["dataset"].get("garment")
    if garment not in make["cut"]:
        known = " or ".join(f"garments_{n}" for n in make["cut"])
        raise InputError("dataset", expected=f"dataset={known}", found=f"dataset.kind={config['dataset']['kind']}")
    clips = _chosen(make)

    def add(stage: str, which: str, settings: dict, outputs: str, clip: str = "", **inputs: object) -> Node:
        function = GARMENTS[which]
        own = schema.arguments(function, settings, seed)
        label = f"{name} {clip}".rstrip()
        return graph.add(stage, function, own, outputs=tuple(outputs.split()), case=label, **inputs)

    body = add("body", "body", make["body"], "body")["body"]
    cutting = add("cutting", "cutting", {}, "poses", body=body)["poses"]
    pattern = add("pattern", "cut", make["cut"][garment], "garment", body=body)["garment"]
    standing = add("motion", "dressing", make["dressing"], "poses", "dressing", body=body, start=cutting)["poses"]
    worn = {"body": body, "garment": pattern}
    physics = make["simulate"] | {"fps": make["fps"]}
    settled = add("simulate", "simulate", physics, "cloth state", "dressing", **worn, poses=standing)["state"]
    poses, cloth = {}, {}
    for clip in clips:
        motion = make["motion"] | make["clips"][clip] | {n: make[n] for n in PER_RUN}
        poses[clip] = add("motion", "clip", motion, "poses", clip, body=body)["poses"]
        inputs = worn | {"poses": poses[clip], "settled": settled}
        cloth[clip] = add("simulate", "simulate", physics, "cloth state", clip, **inputs)["cloth"]

    body_file = add("pack", "pack_body", {}, "file", body=body, cutting=cutting)["file"]
    order = {"clips": clips}
    packing = worn | {"poses": poses, "cloth": cloth}
    garment_file = add("pack", "pack", order | {"step": make["step"]}, "file", **packing)["file"]
    files = {"body": body_file, "garment": garment_file}
    checked = add("check", "check", {"every": make["every"]}, "metrics facts about", **files)
    picture = add("figures", "picture", order, "picture", body=body, poses=poses, cloth=cloth)
    outputs = {output: checked[output] for output in checked.outputs}
    return outputs | {"body_file": body_file, "garment_file": garment_file, "frames_picture": picture["picture"]}


def plan_manifest(made: dict[str, dict], every: int, graph: Graph) -> list[tuple[Node, str]]:
    """The files of all garments, and the manifest that describes them. made: garment -> nodes of its plan."""
    files = {"body": next(iter(made.values()))["body_file"]}
    files |= {garment: nodes["garment_file"] for garment, nodes in made.items()}
    facts = {garment: nodes["facts"] for garment, nodes in made.items()}
    stated = graph.add(
        "manifest", GARMENTS["manifest"], {"every": every}, outputs=("file",), case="garments", files=files, facts=facts
    )
    return [*files.values(), stated["file"]]


def _chosen(make: dict) -> list[str]:
    unknown = [clip for clip in make["only"] if clip not in make["clips"]]
    if unknown:
        raise InputError("make.only", expected=f"clips among {', '.join(make['clips'])}", found=unknown[0])
    return [clip for clip in make["clips"] if not make["only"] or clip in make["only"]]
