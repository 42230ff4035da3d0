"""Hydra's part: overrides of the command line are parsed, config files composed, values set.

Faster than ``hydra.compose``, to whose result a test holds it: a grid of hundreds of cases reads every file once.
"""

from __future__ import annotations

import copy
import re
from functools import cache
from pathlib import Path

from hydra import version
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.config_repository import CachingConfigRepository, ConfigRepository
from hydra._internal.defaults_list import create_defaults_list
from hydra._internal.utils import create_config_search_path
from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Glob, Override
from hydra.errors import HydraException
from hydra.plugins.config_source import ConfigResult
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from flows.source import ROOT
from tasks.errors import InputError

CONF = ROOT / "conf"
ADDED = ("experiment", "ablation")  # groups that the config does not choose from by itself: +GROUP=CHOICE
PATHS = ("path", "data_root")  # last parts of keys whose values are places on the disk


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


def set_values(config: DictConfig, values: list[Override]) -> tuple[DictConfig, set[str]]:
    """A copy of the config with the values set whose keys it has, and which those were."""
    config = config.copy()
    done = set()
    for override in values:
        parent, _, name = override.key_or_group.rpartition(".")
        node = OmegaConf.select(config, parent) if parent else config
        if isinstance(node, DictConfig) and name in node.keys():  # noqa: SIM118, "in node" skips keys still to be given
            OmegaConf.update(config, override.key_or_group, override.value(), merge=False)
            done.add(override.input_line)
    return config, done


def parse(text: str) -> Override:
    """An override of the command line. Raises InputError where it is none, or names no choice of its group."""
    known = groups()
    key, _, value = text.partition("=")
    try:
        override = OverridesParser.create().parse_override(text)
    except (HydraException, ValueError) as error:  # ValueError: of a number too long to be read
        in_quotes = value if value.startswith(("'", '"')) else quoted(value)
        if key.rpartition(".")[2] in PATHS and in_quotes != value:  # files have names of any kind
            return parse(f"{key}={in_quotes}")
        do = f"put quotes round what is more than a word: \"{_short(key)}='...'\"" if value else ""
        raise InputError(_short(text), expected="KEY=VALUE", found=_first_line(error), do=do) from None
    name = override.key_or_group
    if name in ADDED and not override.is_add():
        raise InputError(text, expected=f"+{text}", found=text, do="an experiment or ablation is added with a plus")
    if override.is_delete() or (override.is_add() and name not in ADDED):
        raise InputError(text, expected=f"{name}=…", found=text, do="leave out the sign in front, no key can be added")
    if name in known and not override.is_sweep_override():
        _check_choices(name, str(override.value()), known[name])
    return override


def _check_choices(group: str, choice: str, valid: list[str]) -> None:
    for one in choice.strip("[]").split(","):
        if one.strip(" '") not in valid:
            raise InputError(group, expected=f"one of {', '.join(valid)}", found=repr(one))


@cache
def compose(overrides: tuple[str, ...]) -> DictConfig:
    """The config of some choices of groups. Ablations that choose no groups themselves come last in Hydra's order, so
    they are merged into what the rest composes to: a grid of many ablations composes once."""
    known = groups()
    for text in overrides:  # the choices of an experiment's own grid are checked here, the user's were before
        group, _, choice = text.lstrip("+").partition("=")
        _check_choices(group, choice, known[group])
    *rest, last = overrides or ("",)
    ablations = last.partition("=")[2].strip("[]").split(",") if last.startswith("+ablation=") else []
    files = [CONF / "ablation" / f"{name.strip()}.yaml" for name in ablations]
    try:
        if files and all(map(_only_values, files)):
            return OmegaConf.unsafe_merge(compose(tuple(rest)).copy(), *map(OmegaConf.load, files))
        return _by_hydra(overrides)
    except (HydraException, OmegaConfBaseException) as error:
        absent = re.match(r"Could not override '(\w+)'", str(error))
        if absent and absent[1] in known:
            do = "scene and views come with reconstruction=cpu, other groups with a dataset or method that has them"
            raise InputError(absent[1], expected="a group of this config", found="none of this name", do=do) from None
        raise InputError("config", expected="a config that composes", found=_first_line(error)) from None


@cache
def _only_values(file: Path) -> bool:
    """Whether a config file only sets values, at the places that it spells out."""
    text = file.read_text("utf-8")
    return text.startswith("# @package _global_\n") and not re.search(r"^defaults:", text, re.MULTILINE)


def _by_hydra(overrides: tuple[str, ...]) -> DictConfig:
    """As ``hydra.compose`` does it, but files are read once for all compositions and Hydra's own settings, which nobody
    reads here, stay out: a third of the time."""
    loader, read = _loader()
    parsed, files = OverridesParser.create().parse_overrides(list(overrides)), CachingConfigRepository(read)
    found = create_defaults_list(files, "config", parsed, prepend_hydra=False, skip_missing=False)
    return loader._compose_config_from_defaults_list(found.defaults, files)


class _ReadOnce(ConfigRepository):
    """Config files, each read from the disk once; a copy is handed out, since Hydra writes into what it gets."""

    def __init__(self, search_path: ConfigSearchPath) -> None:
        super().__init__(search_path)
        self._read: dict[str, ConfigResult | None] = {}

    def load_config(self, config_path: str) -> ConfigResult | None:
        if config_path not in self._read:
            self._read[config_path] = super().load_config(config_path)
        return copy.deepcopy(self._read[config_path])


@cache
def _loader() -> tuple[ConfigLoaderImpl, ConfigRepository]:
    version.setbase("1.3")
    places = create_config_search_path(str(CONF))
    return ConfigLoaderImpl(places), _ReadOnce(places)


def plain(config: DictConfig) -> dict:
    try:
        return OmegaConf.to_container(config, resolve=True)
    except OmegaConfBaseException as error:
        raise InputError("config", expected="values that resolve", found=_first_line(error)) from None


def points(override: Override) -> list[str]:
    """The values that an axis of a multirun takes."""
    pattern, name = override.value(), override.key_or_group
    if not isinstance(pattern, Glob):
        return list(override.sweep_string_iterator())
    found = pattern.filter(groups().get(name, []))
    if not found:
        raise InputError(name, expected="a pattern that some choice of a group matches", found=override.input_line)
    return found


def plus(override: Override) -> str:
    return "+" if override.is_add() else ""


def quoted(text: str | None) -> str:
    """A value that Hydra's grammar reads back as this text."""
    plain = text is None or re.fullmatch(r"[\w./:-]+", text, re.ASCII)
    return str(text) if plain else "'" + text.replace("\\", "\\\\").replace("'", "\\'") + "'"


def _short(text: str) -> str:
    return text if len(text) <= 200 else f"{text[:200]}…"


def _first_line(error: Exception) -> str:
    return next((line.strip() for line in str(error).splitlines() if line.strip()), type(error).__name__)
