"""Stage 1 of a case: motion from meshes, or from images through Gaussians, and what is rendered of it.

Three ways in. A moving mesh is the motion itself. Images (``tasks/captures``) are fitted with Gaussians, whose paths
are the motion. A moving mesh with ``reconstruction=…`` is rendered first, its seen and its unseen frames apart, so that
nothing of the unseen ones can reach the fit, and its true motion is known beside the Gaussians'.
"""

from __future__ import annotations

from flows import schema
from flows.graph import Node
from tasks.errors import InputError

Output = tuple[Node, str]  # a node and one of its outputs
Nodes = dict[str, Output]


def data(config: dict, add) -> Nodes:
    """The motion and what is odd about it, its seen and unseen part, the canonical shape."""
    if config["reconstruction"]["kind"] == "none":
        nodes = _meshes(config, add)
    elif schema.is_capture(config["dataset"]["kind"]):
        nodes = _captured(config, add)
    else:
        nodes = _rendered(config, add)
    choice = {"choice": config["skeleton"]["canonical"]}
    canonical = add("canonical", schema.CANONICAL, choice, "canonical", train=nodes["train"])
    return nodes | {"canonical": canonical["canonical"]}


def reconstruct(config: dict, add) -> tuple[Nodes, list[Node]]:
    """Gaussians fitted to images, rendered from views that the fit did not see; with the metrics of both."""
    if schema.is_capture(config["dataset"]["kind"]):
        nodes = _images(config, add)
        truth = None
    else:
        nodes = _mesh(config, add)
        truth = _part(config, add, nodes)
        nodes |= _scene(config, add, truth)
    nodes |= _fit(config, add, nodes["capture"])
    metrics = [_compare(config, add, nodes, nodes["reconstruction"], nodes["views"])]
    if truth:
        inputs = {"reconstruction": nodes["reconstruction"], "truth": truth}
        metrics.append(add("evaluate", schema.EVALUATE_PATHS, {}, "metrics", **inputs))
    return nodes, metrics


def scene(config: dict, add, name: str) -> tuple[Nodes, list[Node]]:
    """Images rendered of moving meshes, as files, with what they hold."""
    nodes = _mesh(config, add)
    truth = _part(config, add, nodes)
    nodes |= _scene(config, add, truth)
    images = {n: nodes[n] for n in ("capture", "views")}
    nodes["scene_files"] = add("files", schema.SCENE_FILES, {"name": name}, "files", **images)["files"]
    nodes["picture"] = add("figures", schema.SCENE_PICTURE, {}, "picture", **images)["picture"]
    return nodes, [add("evaluate", schema.EVALUATE_SCENE, {}, "metrics", **images, motion=truth)]


def posed(config: dict, add, nodes: Nodes) -> Nodes:
    """The Gaussians in the unseen poses, where something is made of them: views or files."""
    wanted = "unseen_views" in nodes or {"ply", "splat", "rigged_ply"} & set(config["export"]["formats"])
    if not wanted or "reconstruction" not in nodes:
        return {}
    inputs = {n: nodes[n] for n in ("reconstruction", "animation")}
    return {"posed": add("pose", schema.POSE_GAUSSIANS, {}, "reconstruction", **inputs)["reconstruction"]}


def unseen_views(config: dict, add, nodes: Nodes) -> list[Node]:
    """The metrics of the posed Gaussians, rendered where cameras see the unseen frames; none without such cameras."""
    if "unseen_views" not in nodes:
        return []
    return [_compare(config, add, nodes, nodes["posed"], nodes["unseen_views"])]


def _meshes(config: dict, add) -> Nodes:
    nodes = _mesh(config, add)
    return nodes | _split(config, add, nodes["motion"])


def _mesh(config: dict, add) -> Nodes:
    kind = config["dataset"]["kind"]
    if schema.is_capture(kind):
        raise InputError(
            "reconstruction",
            expected=f"a fit, for the dataset {kind} holds images",
            found="none",
            do="add reconstruction=cpu",
        )
    motion = add("dataset", schema.load_function(kind), config["dataset"], "motion")["motion"]
    if "scene" in config:
        motion = add("shown", schema.SCENE_MOTION, config["scene"], "motion", motion=motion)["motion"]
    about = add("about", schema.ABOUT, {}, "about", motion=motion)["about"]
    return {"motion": motion, "about": about}


def _captured(config: dict, add) -> Nodes:
    nodes = _images(config, add)
    nodes |= _fit(config, add, nodes["capture"])
    motion = nodes["paths"]
    return nodes | {"motion": motion} | _split(config, add, motion)


def _rendered(config: dict, add) -> Nodes:
    true = _meshes(config, add)
    nodes = {"motion": true["motion"], "about": true["about"]} | _scene(config, add, true["train"])
    nodes |= _fit(config, add, nodes["capture"])
    inputs = {"gaussians": nodes["paths"], "train": true["train"], "test": true["test"]}
    test = add("anchors", schema.ANCHORED, {}, "test", **inputs)["test"]
    unseen = _scene(config, add, true["test"])["views"]
    return nodes | {"train": nodes["paths"], "test": test, "unseen_views": unseen}


def _split(config: dict, add, motion: Output) -> Nodes:
    halves = add("split", schema.SPLIT, config["split"], "train test", motion=motion)
    return {"train": halves["train"], "test": halves["test"]}


def _images(config: dict, add) -> Nodes:
    loaded = add("dataset", schema.load_function(config["dataset"]["kind"]), config["dataset"], "capture views")
    about = add("about", schema.ABOUT_CAPTURE, {}, "about", capture=loaded["capture"])["about"]
    return {"capture": loaded["capture"], "views": loaded["views"], "about": about}


def _part(config: dict, add, nodes: Nodes) -> Output:
    """The frames that are rendered where no motion is held out."""
    part = config["scene"]["part"]
    return nodes["motion"] if part == "all" else _split(config, add, nodes["motion"])[part]


def _scene(config: dict, add, motion: Output) -> Nodes:
    rendered = add("scene", schema.SCENE, config["scene"], "capture views", motion=motion)
    return {"capture": rendered["capture"], "views": rendered["views"]}


def _fit(config: dict, add, capture: Output) -> Nodes:
    settings = config["reconstruction"]
    fitted = add("gaussians", schema.FIT, settings, "reconstruction", capture=capture)["reconstruction"]
    paths = add("paths", schema.TRAJECTORIES, settings, "motion", reconstruction=fitted)["motion"]
    return {"reconstruction": fitted, "paths": paths}


def _compare(config: dict, add, nodes: Nodes, reconstruction: Output, views: Output) -> Node:
    """Renders what the cameras of ``views`` should see and holds it against what they saw."""
    inputs = {"reconstruction": reconstruction, "capture": views}
    nodes["rendered"] = add("render", schema.RENDER, config["views"], "capture", **inputs)["capture"]
    nodes["seen"] = views
    inputs = {"rendered": nodes["rendered"], "truth": views}
    return add("evaluate", schema.EVALUATE_VIEWS, config["views"], "metrics", **inputs)
