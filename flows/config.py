"""From the command line to checked cases: Hydra composes, the schema checks, a sweep is expanded.

A case is one (dataset, method, ablation) with its own complete config. Everything here is light, so that a mistake in a
config answers at once, before torch or Prefect are imported.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from hydra import compose, initialize_config_dir
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from flows import schema
from flows.source import ROOT
from tasks.errors import InputError

CONF = ROOT / "conf"
NO_ABLATION = "none"


@dataclass(frozen=True)
class Case:
    """One row of the sweep: its labels in the tables and its whole config, as plain values."""

    dataset: str
    method: str
    variant: str
    config: dict


def groups() -> dict[str, list[str]]:
    """Config groups and their choices, read from the folder."""
    return {
        folder.name: sorted(p.stem for p in folder.glob("*.yaml"))
        for folder in sorted(CONF.iterdir())
        if folder.is_dir() and folder.name != "paper"
    }


def headline(group: str, choice: str) -> str:
    """The first comment line of a config file: what it is for."""
    lines = (CONF / group / f"{choice}.yaml").read_text("utf-8").splitlines()
    comments = (line[1:].strip() for line in lines if line.startswith("#") and "@package" not in line)
    return next(comments, "")


def expand(overrides: list[str], multirun: bool = False) -> list[Case]:
    """All cases of a command line. Raises InputError for a wrong key, type or choice."""
    parsed = _parse(overrides)
    sweeps = [o for o in parsed if o.is_sweep_override()]
    if sweeps and not multirun:
        name = sweeps[0].key_or_group
        raise InputError(name, expected="one value", found=sweeps[0].input_line, do="add -m to run all of them")
    fixed = [o.input_line for o in parsed if not o.is_sweep_override()]
    axes = [[f"{_plus(o)}{o.key_or_group}={v}" for v in o.sweep_string_iterator()] for o in sweeps]
    cases = [case for point in itertools.product(*axes) for case in _sweep(fixed, list(point))]
    return list({(c.dataset, c.method, c.variant, str(c.config)): c for c in cases}.values())


def _sweep(fixed: list[str], point: list[str]) -> Iterable[Case]:
    """The cases of one point of a multirun: the experiment's datasets x methods x ablations."""
    base = _compose([*fixed, *point])
    label = ",".join(p.lstrip("+") for p in point if not p.startswith("seed="))
    sweep = schema.check(dict(_plain(base).get("sweep") or {}), dict.fromkeys(_SWEEP, list[str] | None), "sweep.")
    for dataset, method, ablation in itertools.product(*(sweep[n] or [None] for n in _SWEEP)):
        chosen = [f"dataset={dataset}"] if dataset else []
        chosen += [f"method={method}"] if method else []
        if ablation and ablation != NO_ABLATION:
            chosen.append(f"+ablation=[{','.join(ablation.split('+'))}]")
        # what the user typed comes last, so that it wins over the experiment's grid
        kept = [o for o in (*fixed, *point) if not (dataset and o.startswith("dataset="))]
        kept = [o for o in kept if not (method and o.startswith("method="))]
        kept.sort(key=lambda o: not o.startswith("+experiment="))  # stable: the experiment first, so that all else wins
        first = sum(o.startswith("+experiment=") for o in kept)
        config = _plain(_compose([*kept[:first], *chosen, *kept[first:]])) if chosen else _plain(base)
        config = schema.check(config, schema.schema(config))
        variant = ",".join(filter(None, [ablation, label])) or NO_ABLATION
        yield Case(dataset or config["dataset"]["kind"], config["animate"]["name"], variant, config)


_SWEEP = ("datasets", "methods", "ablations")


def _parse(overrides: list[str]) -> list[Override]:
    known = groups()
    parser = OverridesParser.create()
    parsed = []
    for text in overrides:
        try:
            override = parser.parse_override(text)
        except HydraException as error:
            raise InputError(text, expected="KEY=VALUE", found=_first_line(error)) from None
        parsed.append(override)
        group = override.key_or_group.split("@")[0]
        if group in known and not override.is_sweep_override() and isinstance(override.value(), str):
            _check_choice(group, str(override.value()), known[group])
    return parsed


def _check_choice(group: str, choice: str, valid: list[str]) -> None:
    if choice not in valid:
        raise InputError(group, expected=f"one of {', '.join(valid)}", found=repr(choice))


def _compose(overrides: list[str]) -> DictConfig:
    known = groups()
    for text in overrides:  # sweeps are strings only here, so their choices are checked now
        group, _, choice = text.lstrip("+").partition("=")
        if group in known and not choice.startswith("["):
            _check_choice(group, choice, known[group])
    needs_plus = ("ablation", "experiment")
    for text in overrides:
        if text.split("=")[0] in needs_plus:
            raise InputError(text, expected=f"+{text}", found=text, do="an experiment or ablation is added with a plus")
    try:
        with initialize_config_dir(str(CONF), version_base="1.3"):
            return compose("config", overrides)
    except HydraException as error:
        raise _explain(error, overrides) from None
    except OmegaConfBaseException as error:
        raise InputError("config", expected="values that fit together", found=_first_line(error)) from None


def _explain(error: Exception, overrides: list[str]) -> InputError:
    """Hydra's several lines about an override as one, with the keys that would have been right."""
    text = str(error)
    found = re.search(r"Could not (?:override|append to config\. An item is already at) '([\w.@/]+)'", text)
    if not found:
        return InputError("config", expected="a config that composes", found=_first_line(error))
    key = found.group(1).rstrip(".")
    with initialize_config_dir(str(CONF), version_base="1.3"):
        names = {o.partition("=")[0].lstrip("+") for o in overrides}
        whole_groups = [o for o in overrides if o.partition("=")[0].lstrip("+") in groups()]
        config = compose("config", whole_groups if names & set(groups()) else [])
    if "already at" in text:
        return InputError(key, expected=f"{key}=…", found=f"+{key}=…", do="leave out the plus, the key exists")
    parts = key.split(".")
    for depth in range(len(parts)):
        parent = ".".join(parts[:depth])
        node = OmegaConf.select(config, parent) if parent else config
        if isinstance(node, DictConfig) and parts[depth] not in node:
            return schema.unknown_key(".".join(parts[: depth + 1]), [str(k) for k in node])
    return InputError(key, expected="a key of the config", found=_first_line(error))


def _plain(config: DictConfig) -> dict:
    try:
        return OmegaConf.to_container(config, resolve=True)
    except OmegaConfBaseException as error:
        raise InputError("config", expected="values that resolve", found=_first_line(error)) from None


def _plus(override: Override) -> str:
    return "+" if override.is_add() else ""


def _first_line(error: Exception) -> str:
    return next((line.strip() for line in str(error).splitlines() if line.strip()), type(error).__name__)


def to_yaml(case: Case) -> str:
    """A case's config as YAML, for ``--cfg``."""
    return OmegaConf.to_yaml(OmegaConf.create(case.config))


def repository_path(path: str) -> Path:
    """A path of the config: absolute, or relative to where the command runs."""
    return Path(path).expanduser()
