"""Stages without a run: plain functions with the settings of the YAML files filled in, for a notebook or a prompt."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from importlib import import_module
from types import SimpleNamespace

from flows import config, schema
from tasks.errors import InputError


def stages(*overrides: str) -> SimpleNamespace:
    """The stages of one case that begins with a moving mesh, by the names that :mod:`flows.pipeline` has for them.

    overrides: as on the command line; ``dataset=…`` and ``method=…`` stand for one each. Every stage is the plain
    function out of ``tasks`` (its ``func``), which takes and gives values and caches nothing. Raises InputError as
    ``flows.run`` does.
    """
    (case, *more) = config.expand([*overrides, "sweep.datasets=null", "sweep.methods=null", "sweep.ablations=null"])
    if more:
        raise InputError("dataset.path", expected="one file", found=f"{len(more) + 1}")
    c = case.config
    if c["pipeline"] != "animate" or c["reconstruction"]["kind"] != "none":
        raise InputError("stages", expected="a moving mesh and a method that poses it", found=" ".join(overrides))
    way = c["skeleton"]
    chosen = {
        "load": (schema.load_function(c["dataset"]["kind"]), c["dataset"]),
        "split": (schema.SPLIT, c["split"]),
        "canonical": (schema.CANONICAL, {"choice": way["canonical"]}),
        "clusters": (schema.CLUSTER, c["bones"]),
        "bones": (schema.BONES[c["bones"]["kind"]], c["bones"]),
        "parts": (schema.PARTS, c["parts"]),
        "database": (schema.DATABASE, {}),
        "evaluate": (schema.EVALUATE, {}),
    }
    if way["kind"] == "given":
        chosen |= {"skeleton": (schema.GIVEN_SKELETON, {}), "poses": (schema.GIVEN_POSES, {})}
    else:
        chosen |= {"surface": (schema.SURFACE, way["surface"]), "curve": (schema.CURVE, way["curve"])}
        chosen |= {"skeleton": (schema.JOINTS[way["joints"]], way[way["joints"]])}
        chosen |= {"poses": (schema.POSES, way["poses"])}
    bound = {name: _bound(function, node, c["seed"]) for name, (function, node) in chosen.items()}
    method = schema.animate_function(c["animate"]["function"])
    return SimpleNamespace(**bound, animate=_bound(method, c["animate"], case.seed))


def _bound(function: str, node: dict, seed: int) -> Callable:
    module, name = function.split(":")
    return partial(getattr(import_module(module), name), **schema.arguments(function, node, seed))
