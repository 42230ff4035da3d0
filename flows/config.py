"""From the command line to checked cases: Hydra composes, the schema checks, a sweep is expanded.

A case is one (dataset, method, ablation) with its own complete config. Everything here is light, so that a mistake in a
config answers at once, before torch or Prefect are imported.
"""

from __future__ import annotations

import difflib
import itertools
import re
from collections.abc import Iterator
from dataclasses import dataclass
from glob import glob, has_magic
from pathlib import Path
from typing import Literal

from hydra.core.override_parser.types import Override
from omegaconf import OmegaConf

from flows import schema
from flows.compose import ADDED, compose, groups, parse, plain, plus, points, quoted, set_values
from flows.source import ROOT, signature
from tasks.errors import InputError, NotGiven

NO_ABLATION = "none"
ALONE = "again"  # the report of a case that is run again by itself
NAMING = dict.fromkeys(("report.baselines", "report.bounds", "report.gains_of"), "method")
NAMING |= dict.fromkeys(("evaluate.left_out_of", "sweep.seeds_of"), "dataset")
SWEPT = ("datasets", "methods", "ablations")  # the axes of an experiment's grid
SWEEP = dict.fromkeys(("experiments", *SWEPT), list[str] | None)
SWEEP |= {"seeds": list[schema.SEED] | None, "seeds_of": list[str] | None, "absent": Literal["fail", "skip"]}


@dataclass(frozen=True)
class Case:
    """One row of the sweep: its labels in the tables, its whole config as plain values, and the overrides that run it
    alone, with a report of its own."""

    dataset: str
    method: str
    variant: str
    config: dict
    alone: tuple[str, ...] = ()

    @property
    def seed(self) -> int:
        """What the method's own randomness starts from; bones and data keep the seed of the run."""
        own = self.config["method_seed"]
        return self.config["seed"] if own is None else own

    @property
    def absent(self) -> bool:
        """Its file is neither there nor in the repository, and the experiment does without it then."""
        path = self.config["dataset"].get("path")
        if self.config["sweep"]["absent"] != "skip" or not path:
            return False
        return not any((folder / Path(path).expanduser()).exists() for folder in (Path.cwd(), ROOT))

    @property
    def data(self) -> str:
        """The dataset with the file it reads, if it reads one: what tells subjects apart before they are loaded."""
        stem = Path(self.config["dataset"].get("path") or "").stem
        return self.dataset if stem in self.dataset else f"{self.dataset} {stem}"


@dataclass(frozen=True)
class Missing:
    """What an experiment goes without: the dataset or case, why, and the paper's column that it would stand for."""

    what: str
    why: str
    stands_for: str | None = None


def expand(overrides: list[str], multirun: bool = False) -> list[Case]:
    """All cases of a command line. Raises InputError for a wrong key, type or choice."""
    used: set[str] = set()
    cases = expand_some(overrides, multirun, used)
    check_used(overrides, used, cases)
    return cases


def expand_some(
    overrides: list[str], multirun: bool, used: set[str], missing: list[Missing] | None = None
) -> list[Case]:
    """As :func:`expand`, for one experiment among several: ``used`` collects the overrides that set something; with
    ``missing``, a case whose data is not there is put on that list instead of being an error."""
    parsed = [parse(text) for text in overrides]
    sweeps = [o for o in parsed if o.is_sweep_override()]
    if sweeps and not multirun:
        name = sweeps[0].key_or_group
        raise InputError(name, expected="one value", found=sweeps[0].input_line, do="add -m to run all of them")
    axes = [[parse(f"{plus(o)}{o.key_or_group}={v}") for v in points(o)] for o in sweeps]
    fixed = [o for o in parsed if not o.is_sweep_override()]
    cases: list[Case] = []
    for point in itertools.product(*axes):
        cases += _sweep([*fixed, *point], list(point), used, missing)
    used |= {o.input_line for o, axis in zip(sweeps, axes, strict=True) if all(v.input_line in used for v in axis)}
    return list({(c.dataset, c.method, c.variant, str(c.config)): c for c in cases}.values())


def whole(overrides: list[str]) -> dict:
    """The config of a run itself: its experiment and runner, and the overrides that are not about a dataset or method;
    plain values, not checked."""
    parsed = [parse(text) for text in overrides]
    choices = {o.key_or_group: str(o.value()) for o in parsed if o.key_or_group in ("experiment", "runner")}
    values = [o for o in parsed if o.key_or_group not in groups() and not o.is_sweep_override()]
    return plain(set_values(compose(_group_overrides(choices)), values)[0])


def check_used(overrides: list[str], used: set[str], cases: list[Case]) -> None:
    """Raises InputError for the first override that set nothing in any case."""
    for override in map(parse, overrides):
        if override.input_line not in used:
            raise _nowhere(override, cases)


def _sweep(
    overrides: list[Override], point: list[Override], used: set[str], missing: list[Missing] | None
) -> Iterator[Case]:
    """The cases of one point of a multirun: the experiment's datasets x methods x ablations.

    A key that only some of the methods or datasets have is set in those; used collects what was set anywhere.
    """
    choices = {o.key_or_group: str(o.value()) for o in overrides if o.key_or_group in groups()}
    values = [o for o in overrides if o.key_or_group not in choices]
    used |= {o.input_line for o in overrides if o.key_or_group in choices}
    experiment = {group: choice for group, choice in choices.items() if group == "experiment"}  # it alone has a grid
    base, set_here = set_values(compose(_group_overrides(experiment)), values)
    used |= {text for text in set_here if text.startswith("sweep.")}
    sweep = schema.check(plain(base)["sweep"], SWEEP, "sweep.")
    unnamed = ("seed", "method_seed", "dataset", "dataset.path", "method")  # have columns of their own
    label = ",".join(o.input_line.lstrip("+") for o in point if o.key_or_group not in unnamed)
    for dataset, method, ablation in itertools.product(*(sweep[axis] or [None] for axis in SWEPT)):
        chosen = {"dataset": dataset, "method": method} | choices  # what the user typed wins over the experiment
        if ablation and ablation != NO_ABLATION:
            chosen["ablation"] = f"[{','.join(ablation.split('+'))}]"
        composed, set_here = set_values(compose(_group_overrides(chosen)), values)
        used |= set_here
        config = plain(composed)
        variant = ",".join(filter(None, [ablation, label])) or NO_ABLATION
        name = chosen["dataset"] or config["dataset"].get("kind")
        try:
            config = schema.check_run(schema.check(config, schema.schema(config, SWEEP)))
            _check_names(config, name)
            nodes = _files(config["dataset"])
        except NotGiven as error:
            if missing is None:
                raise
            missing.append(Missing(name, str(error), config["dataset"].get("stands_for")))
            continue
        kept = [o for o in values if o.input_line in set_here]
        for node, seed in itertools.product(nodes, _seeds(config, name)):
            alone = _alone(chosen, ablation, kept, node.get("path"), seed)
            filled = config | {"dataset": node, "method_seed": seed}
            yield Case(name, config["animate"]["name"], variant, filled, alone)


def _check_names(config: dict, dataset: str) -> None:
    """Raises InputError for settings that name a method or dataset which is none: they would be passed over."""
    valid = {"method": [*groups()["method"], config["animate"]["name"]], "dataset": [*groups()["dataset"], dataset]}
    for path, kind in NAMING.items():
        group, key = path.split(".")
        unknown = [name for name in config[group][key] or [] if name not in valid[kind]]
        if unknown:
            near = difflib.get_close_matches(unknown[0], valid[kind], 1)
            do = f"did you mean {near[0]}?" if near else ""
            raise InputError(path, expected=f"names of {kind}s", found=repr(unknown[0]), do=do)


def _seeds(config: dict, dataset: str) -> list[int | None]:
    """The seeds that the method is run with: the experiment's, of which one is enough for a method without randomness
    and for a dataset that they are not meant for."""
    seeds, function, of = config["sweep"]["seeds"], config["animate"].get("function"), config["sweep"]["seeds_of"]
    if not seeds or config["method_seed"] is not None or function is None:
        return [config["method_seed"]]
    several = "seed" in signature(schema.animate_function(function))[1] and (of is None or dataset in of)
    return seeds if several else seeds[:1]


def _alone(
    chosen: dict, ablation: str | None, values: list[Override], path: str | None, seed: int | None
) -> tuple[str, ...]:
    """The overrides that run one case of a sweep by itself. values: those of the command that it has."""
    swept = {} if ablation is None else {"ablation": None}
    groups = _group_overrides(chosen | swept)
    ablations = f"sweep.ablations=[{ablation}]" if ablation not in (None, NO_ABLATION) else "sweep.ablations=null"
    swept_here = {"sweep.datasets": "dataset", "sweep.methods": "method", "sweep.ablations": "ablation"}
    axes = {axis for axis, group in swept_here.items() if (chosen | swept).get(group) or group in swept}
    kept = [
        o for o in values if o.key_or_group not in {"dataset.path", "report.name", "method_seed", "sweep.seeds", *axes}
    ]
    file = [f"dataset.path={quoted(path)}"] if any(o.key_or_group == "dataset.path" for o in values) else []
    lines = [*file, *(o.input_line for o in kept), *([f"method_seed={seed}"] if seed is not None else [])]
    return (*groups, *([ablations] if ablation is not None else []), *lines, f"report.name={ALONE}")


def _files(dataset: dict) -> list[dict]:
    """The dataset's node for every file that a path with {a,b} and wildcards stands for."""
    path = dataset.get("path")
    if not path or Path(path).exists():
        return [dataset]
    found = []
    for one in _alternatives(path):
        matches = sorted(glob(str(Path(one).expanduser()))) if has_magic(one) else [one]
        if not matches:
            raise NotGiven("dataset.path", expected="a file or folder", found=f"nothing that matches {one}")
        found += matches
    return [dataset | {"path": one} for one in found]


def _alternatives(path: str) -> list[str]:
    """a/{b,c}.npz as a/b.npz and a/c.npz, as a shell has it."""
    choice = re.search(r"\{([^{}]*,[^{}]*)\}", path)
    if not choice:
        return [path]
    head, tail = path[: choice.start()], path[choice.end() :]
    return [f"{head}{one}{rest}" for one in choice[1].split(",") for rest in _alternatives(tail)]


def _group_overrides(chosen: dict[str, str | None]) -> tuple[str, ...]:
    """Choices of groups as Hydra's overrides; the experiment comes first, so that all else wins over it."""
    present = {group: choice for group, choice in chosen.items() if choice is not None}
    order = sorted(present, key=lambda group: group != "experiment")
    return tuple(f"{'+' if group in ADDED else ''}{group}={present[group]}" for group in order)


def _nowhere(override: Override, cases: list[Case]) -> InputError:
    """The error for a key that no case has: the first part of it that is wrong, and what would be right there."""
    configs = [case.config for case in cases]
    parts = override.key_or_group.split(".")
    for depth, part in enumerate(parts):
        inside = [c for c in configs if isinstance(c, dict)]
        if not any(part in c for c in inside):
            valid = dict.fromkeys(key for c in inside for key in c)
            return schema.unknown_key(".".join(parts[: depth + 1]), [str(key) for key in valid])
        configs = [c[part] for c in inside if part in c]
    return InputError(override.key_or_group, expected="a key of the config", found=override.input_line)


def to_yaml(case: Case) -> str:
    """A case's config as YAML, for ``--cfg``."""
    return OmegaConf.to_yaml(OmegaConf.create(case.config))
