"""What every key of the config may hold.

The settings of a stage are the keyword-only arguments of its function, read from the source (see ``flows.source``), so
a type, the range of a number and what must hold between settings are written once, where they are used, and checked
before anything is computed. What belongs to the run and not to a stage is declared here.
"""

from __future__ import annotations

import contextlib
import difflib
import types
import typing
from typing import Annotated, Literal

from flows import ranges
from flows.source import choices, signature
from tasks.errors import InputError, NotGiven

CLUSTER = "tasks.bones.clustering:cluster"
SSDR = "tasks.bones.ssdr:ssdr"
RIGID = "tasks.bones.rigid:rigid_skinning"
GAUSSIAN_BONES = "tasks.bones.gaussian:gaussian_bones"
BONES = {"ssdr": SSDR, "clusters": RIGID, "gaussian": GAUSSIAN_BONES}
ABOUT = "tasks.datasets.validate:about"
ABOUT_CAPTURE = "tasks.captures.validate:about"
SPLIT = "tasks.datasets.split:split"
CANONICAL = "tasks.datasets.canonical:canonical"
SURFACE = "tasks.skeleton.surface:closed_surface"
CURVE = "tasks.skeleton.curve:curve_skeleton"
JOINTS = {
    "motion": "tasks.skeleton.joints_motion:joints_by_motion",
    "gradient": "tasks.skeleton.joints_gradient:joints_by_gradient",
}
GIVEN_SKELETON = "tasks.skeleton.given:given_skeleton"
GIVEN_POSES = "tasks.skeleton.given:given_poses"
POSES = "tasks.skeleton.poses:fit_poses"
DATABASE = "tasks.motion.database:build_database"
PARTS = "tasks.motion.parts:find_parts"
SCENE_MOTION = "tasks.captures.scenes:scene_motion"
SCENE = "tasks.captures.scenes:render_scene"
SCENE_FILES = "tasks.captures.scenes:scene_files"
EVALUATE_SCENE = "tasks.evaluation.scenes:evaluate_scene"
SCENE_PICTURE = "tasks.drawing.pictures:scene_picture"
FIT = "tasks.reconstruction.fit:fit"
TRAJECTORIES = "tasks.reconstruction.motion:motion_of"
ANCHORED = "tasks.reconstruction.anchors:anchored"
POSE_GAUSSIANS = "tasks.reconstruction.views:pose_gaussians"
RENDER = "tasks.reconstruction.views:render_views"
EVALUATE_VIEWS = "tasks.evaluation.images:evaluate_views"
EVALUATE_PATHS = "tasks.evaluation.paths:evaluate_paths"
EVALUATE = "tasks.evaluation.metrics:evaluate"
EVALUATE_RIG = "tasks.evaluation.rig:evaluate_rig"
EVALUATE_JOINTS = "tasks.evaluation.rig:evaluate_joints"
MATCHING = "tasks.methods.partmm:animate"
CONFIDENCE = "tasks.motion.confidence:confidence"
EVALUATE_CONFIDENCE = "tasks.evaluation.confidence:evaluate_confidence"
EVALUATE_PARTS = "tasks.evaluation.by_part:evaluate_parts"
FLOOR = "tasks.bones.refit:compression_floor"
LEAVE_OUT = "tasks.motion.left_out:leave_out"
EVALUATE_LEFT_OUT = "tasks.evaluation.left_out:evaluate_left_out"
SPREAD = "tasks.evaluation.left_out:spread"
BENCHMARKS = {
    "benchmark_bones": "tasks.benchmarks.bones:benchmark_bones",
    "benchmark_rasterizer": "tasks.benchmarks.rasterizer:benchmark_rasterizer",
    "benchmark_skeleton": "tasks.benchmarks.skeleton:benchmark_skeleton",
    "scale_bones": "tasks.benchmarks.scale:scale_bones",
    "benchmark_matching": "tasks.benchmarks.matching:benchmark_matching",
    "benchmark_stages": "tasks.benchmarks.stages:benchmark_stages",
}
GARMENTS = {
    "body": "tasks.garments.body:anny_body",
    "cutting": "tasks.garments.pattern:cutting_pose",
    "cut": "tasks.garments.pattern:cut",
    "dressing": "tasks.garments.retarget:dressing",
    "clip": "tasks.garments.retarget:motion_clip",
    "simulate": "tasks.garments.simulate:simulate_frames",
    "pack_body": "tasks.garments.pack:pack_body",
    "pack": "tasks.garments.pack:pack_garment",
    "check": "tasks.garments.manifest:check_garment",
    "manifest": "tasks.garments.manifest:manifest",
    "picture": "tasks.drawing.pictures:garment_picture",
}
EXPORTS = {
    "glb": "tasks.export.character:bones_glb",
    "skeleton_glb": "tasks.export.character:skeleton_glb",
    "bvh": "tasks.export.character:skeleton_bvh",
    "npz": "tasks.export.character:points_npz",
    "ply": "tasks.export.splat_files:gaussians_ply",
    "splat": "tasks.export.splat_files:gaussians_splat",
    "rigged_ply": "tasks.export.splat_files:rigged_ply",
}
PER_CLIP = ("clip", "cycles", "turn", "slow")  # settings of a motion that differ from clip to clip
PER_RUN = ("fps", "frames")  # settings of garments that several stages share

DRIVE = "tasks.driving.drive:driving_poses"
PIPELINES = ("animate", "rig", "drive", "reconstruct", "make_garments", "make_scenes", *BENCHMARKS)

REPORT = {
    "name": str,
    "title": str,
    "path": str,
    "figures": bool,
    "videos": bool,
    "baselines": list[str],
    "bounds": list[str],
    "gains_of": list[str],
    "paper_table": Literal[2, 3, 4] | None,
    "curve": list[str] | None,
    "note": str,
}
LEFT_OUT = {"left_out": Annotated[int, "[0, inf)"], "left_out_of": list[str] | None}
RUNNER = {"kind": Literal["threads", "processes", "dask", "ray"], "workers": Annotated[int, "[1, inf)"]}
SEED = Annotated[int, "[0, inf)"]
CLUSTERS = ("dask", "ray")  # runners that may use workers which run already
FROM_RUN = {"seed"}  # arguments that come from the top of the config
OF_STAGES = {
    *("clustering", "decomposition", "closing", "tracing", "jointing", "posing", "parting"),
    "matching",
}  # a benchmark's arguments that are whole stages' settings
DECIDING = {  # what the rest of the schema hangs on, beside the pipeline
    **dict.fromkeys(("dataset", "bones", "skeleton", "reconstruction", "runner"), "kind"),
    "animate": "function",
}
LARGEST = 1e30  # of a setting's size: its square is still a number
UNIONS = (types.UnionType, typing.Union)  # of A | B, and of one in which a Literal is
RENAMED = {"lambda_": "lambda"}  # Python keywords that are the field's names in the config


def load_function(kind: str) -> str:
    """The loader of a kind of dataset: ``tasks/datasets/<kind>.py``, or of images ``tasks/captures/<kind>.py``."""
    return choices(("datasets", "captures"), "load", "dataset.kind", kind)


def is_capture(kind: str) -> bool:
    """Whether a kind of dataset holds images rather than moving meshes."""
    return load_function(kind).startswith("tasks.captures.")


def animate_function(function: str) -> str:
    """The method's function: ``tasks/methods/<function>.py``, or the floor below all methods, which sees the truth."""
    return FLOOR if function == FLOOR.split(":")[1] else choices(("methods",), "animate", "animate.function", function)


def schema(config: dict, sweep: dict[str, object]) -> dict[str, object]:
    """The type of every key that this config may have, nested as the config is. sweep: those of the grid. Raises
    InputError where a value that decides over others is wrong itself."""
    _check_deciding(config)
    dataset = config["dataset"]
    pipeline = config["pipeline"]
    skeleton: dict[str, object] = {"kind": Literal["curve", "given"]}
    if pipeline in ("benchmark_skeleton", "benchmark_stages"):
        skeleton["kind"] = Literal["curve"]
    if config["skeleton"].get("kind") != "given":
        skeleton |= {
            "joints": Literal["motion", "gradient"],
            "surface": settings(SURFACE),
            "curve": settings(CURVE),
            "poses": settings(POSES),
            **{name: settings(function) for name, function in JOINTS.items()},
        }
    bones = {"kind": Literal["ssdr", "clusters", "gaussian"], **settings(CLUSTER)}
    if pipeline in ("benchmark_bones", "scale_bones", "benchmark_stages"):
        bones["kind"] = Literal["ssdr"]
    bones |= settings(BONES.get(config["bones"].get("kind"), SSDR))
    return {
        "seed": SEED,
        "plan": bool | Literal["stages"],
        "method_seed": SEED | None,
        "confidence": settings(CONFIDENCE),
        "data_root": str,
        "pipeline": Literal[PIPELINES],
        "dataset": {
            "kind": str,
            "status": Literal["paper", "substitute"],
            "stands_for": str | None,
            **settings(load_function(dataset.get("kind", ""))),
        },
        **_images(config),
        "split": settings(SPLIT),
        "bones": bones,
        "skeleton": skeleton | settings(CANONICAL, rename={"choice": "canonical"}),
        **_method(config),
        "evaluate": settings(EVALUATE) | settings(EVALUATE_RIG) | LEFT_OUT,
        "report": REPORT,
        **({"drive": settings(DRIVE)} if pipeline == "drive" else {}),
        "export": {"formats": list[Literal[tuple(EXPORTS)]]},
        "store": {"path": str},
        "memory": {"max_gb": Annotated[float, "(0, inf)"] | None},
        "runner": RUNNER | ({"address": str | None} if config["runner"].get("kind") in CLUSTERS else {}),
        "sweep": sweep,
    }


def _check_deciding(config: dict) -> None:
    _typed(config["pipeline"], str, "pipeline")
    groups = {group: config[group] for group in DECIDING}
    if config["pipeline"] == "make_garments":
        groups["make"] = config["make"]
    for group, node in groups.items():
        _check_group(node, group)
        if DECIDING.get(group) in node:
            _typed(node[DECIDING[group]], str, f"{group}.{DECIDING[group]}")
    for name in ("cut", "clips"):
        if "make" in groups:
            _check_group(groups["make"].get(name), f"make.{name}")


def _check_group(node: object, where: str) -> None:
    if not isinstance(node, dict):
        raise InputError(where, expected="a group of settings", found=repr(node))


def _images(config: dict) -> dict[str, object]:
    """The fit of Gaussians, and where there is one, what is rendered for it and of it."""
    reconstruction: dict[str, object] = {"kind": Literal["none", "fit"]}
    if config["reconstruction"].get("kind") != "fit":
        return {"reconstruction": reconstruction}
    return {
        "reconstruction": reconstruction | settings(FIT) | settings(TRAJECTORIES),
        "scene": {"part": Literal["all", "train", "test"], **settings(SCENE_MOTION), **settings(SCENE)},
        "views": settings(RENDER) | settings(EVALUATE_VIEWS),
    }


def _method(config: dict) -> dict[str, object]:
    """What a file of the group ``method`` sets: a method of ours, or a peer to be measured against."""
    labels = {"name": str, "label": str}
    if config["pipeline"] == "make_garments":
        return {"animate": labels, "make": _make(config["make"])}
    benchmark, own = BENCHMARKS.get(str(config["pipeline"])), {}
    if benchmark:
        own = {"benchmark": {n: t for n, t in settings(benchmark).items() if n not in OF_STAGES}}
        if config["pipeline"] not in ("benchmark_matching", "benchmark_stages"):
            return {"animate": labels} | own
    if config["pipeline"] in ("reconstruct", "make_scenes"):
        return {"animate": labels}
    function = animate_function(config["animate"].get("function", ""))
    method = {"animate": labels | {"function": str, **settings(function)}, "parts": settings(PARTS)}
    return method | own


def _make(make: dict) -> dict[str, object]:
    """The group ``make`` of the pipeline make_garments; garments and clips are whatever it names."""
    of = {name: settings(function) for name, function in GARMENTS.items()}
    return {
        "only": list[str],
        "frames": of["clip"]["frames"],
        "fps": of["clip"]["fps"],
        "every": of["check"]["every"],
        "step": of["pack"]["step"],
        "body": of["body"],
        "cut": dict.fromkeys(make["cut"], of["cut"]),
        "dressing": of["dressing"],
        "motion": {n: t for n, t in of["clip"].items() if n not in (*PER_CLIP, *PER_RUN)},
        "clips": {name: {n: of["clip"][n] for n in PER_CLIP} for name in make["clips"]},
        "simulate": {n: t for n, t in of["simulate"].items() if n not in PER_RUN},
    }


def settings(function: str, *, rename: dict[str, str] | None = None) -> dict[str, object]:
    """Config key -> type for the settings of a function."""
    names = RENAMED | (rename or {})
    return {names.get(n, n): t for n, t in signature(function)[1].items() if n not in FROM_RUN}


def arguments(function: str, node: dict, seed: int) -> dict[str, object]:
    """The keyword arguments of a function, taken from its node of the config."""
    values = {n: node[RENAMED.get(n, n)] for n in signature(function)[1] if n not in FROM_RUN}
    return values | ({"seed": seed} if "seed" in signature(function)[1] else {})


def check(config: dict, expected: dict[str, object], where: str = "") -> dict:
    """The config with every value of its declared type. Raises InputError naming the first key that is not."""
    for key in config:
        if key not in expected:
            raise unknown_key(f"{where}{key}", list(expected))
    missing = [f"{where}{key}" for key in expected if key not in config]
    if missing:
        raise InputError(missing[0], expected="a value", found="nothing", do="add it to the yaml file of its group")
    out = {}
    for key, kind in expected.items():
        path = f"{where}{key}"
        if isinstance(kind, dict):
            if not isinstance(config[key], dict):
                raise InputError(path, expected=f"a group with {', '.join(kind)}", found=repr(config[key]))
            out[key] = check(config[key], kind, f"{path}.")
        else:
            out[key] = _typed(config[key], kind, path)
    _check_relations(out, expected, where)
    return out


def _check_relations(group: dict, expected: dict[str, object], where: str) -> None:
    """Raises InputError for the first setting that does not go with others of its group."""
    named = group | {argument: group[key] for argument, key in RENAMED.items() if key in group}
    for key, kind in expected.items():
        for relation in ranges.relations(kind):
            if not relation(named):
                beside = " and ".join(f"{other}={named[other]}" for other in relation.others(key))
                found = str(group[key]) + (f" with {beside}" if beside else "")
                raise InputError(f"{where}{key}", expected=relation.words, found=found)


def check_run(config: dict) -> dict:
    """The config again. Raises InputError for values of the run itself that no stage checks."""
    name = config["report"]["name"]
    if name in ("", ".", "..") or set(name) & set("/\\%&<>"):
        raise InputError("report.name", expected="the name of a folder", found=repr(name), do="set report.path instead")
    if not name.isprintable():
        raise InputError("report.name", expected="the name of a folder, on one line", found=repr(name))
    _check_curve(config)
    for group in ("store", "report"):
        if not config[group]["path"].strip():
            raise InputError(f"{group}.path", expected="a folder", found=repr(config[group]["path"]))
    return config


def _check_curve(config: dict) -> None:
    from tasks.evaluation.metrics import METRICS

    curve = config["report"]["curve"]
    if not curve:
        return
    value: object = config
    for part in curve[0].split("."):
        value = value.get(part) if isinstance(value, dict) else None
    if len(curve) != 2 or curve[1] not in METRICS or isinstance(value, bool) or not isinstance(value, int | float):
        expected = "a key of the config that holds a number, and a metric such as rmse"
        raise InputError("report.curve", expected=expected, found=f"[{', '.join(curve)}]")


def unknown_key(path: str, valid: list[str]) -> InputError:
    """The error for a key that does not exist, with the nearest one that does."""
    name = path.rpartition(".")[2]
    near = difflib.get_close_matches(name, valid, 1)
    hint = f"did you mean {near[0]}?" if near else "remove it"
    return InputError(path, expected=f"one of the keys {', '.join(valid)}", found=f"the unknown key {name!r}", do=hint)


def _typed(value: object, kind: object, path: str) -> object:
    """The value as the type; a whole number may stand for a float, nothing else is converted."""
    origin = typing.get_origin(kind)
    if value == "???":  # OmegaConf's mark for a value that the user must give
        raise NotGiven(path, expected=describe(kind), found="nothing", do=f"add {path}=… to the command")
    if origin is Literal:
        if value in typing.get_args(kind) and not isinstance(value, bool):
            return value
    elif origin in UNIONS:
        members = typing.get_args(kind)
        if value is None and type(None) in members:
            return None
        *others, last = [m for m in members if m is not type(None)]
        for member in others:
            with contextlib.suppress(InputError):
                return _typed(value, member, path)
        with contextlib.suppress(InputError) if others else contextlib.nullcontext():
            return _typed(value, last, path)
    elif origin is Annotated:
        plain = _typed(value, kind.__origin__, path)
        span = ranges.interval(kind)
        if span is None or plain in span:
            return plain
    elif origin is list:
        if isinstance(value, list):
            return [_typed(v, typing.get_args(kind)[0], f"{path}[{i}]") for i, v in enumerate(value)]
    elif kind is float and isinstance(value, int | float) and not isinstance(value, bool):
        if abs(value) <= LARGEST:  # not for nan
            return float(value)
    elif kind is str and isinstance(value, int | float) and not isinstance(value, bool):
        return str(value)  # a file or a clip may be called 7
    elif kind is int and isinstance(value, int) and not isinstance(value, bool):
        if abs(value) < 2**63:  # what numpy holds
            return value
    elif kind in (str, bool) and isinstance(value, kind):
        return value
    raise InputError(path, expected=describe(kind), found=f"{value!r}")


def describe(kind: object) -> str:
    """A type in words."""
    if typing.get_origin(kind) is Literal:
        return "one of " + ", ".join(str(a) for a in typing.get_args(kind))
    if typing.get_origin(kind) in UNIONS:
        return " or ".join("null" if m is type(None) else describe(m) for m in typing.get_args(kind))
    if typing.get_origin(kind) is Annotated:
        span = ranges.interval(kind)
        return describe(kind.__origin__) + (f", {span}" if span else "")
    if typing.get_origin(kind) is list:
        return f"a list, each entry {describe(typing.get_args(kind)[0])}"
    return {int: "a whole number", float: "a finite number", str: "text", bool: "true or false"}[kind]
