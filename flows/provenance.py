"""Where a report's numbers come from: configs, code, versions, inputs, and what every stage cost."""

from __future__ import annotations

import platform
import re
import subprocess
from importlib.metadata import PackageNotFoundError, requires, version

from flows.cache import Ref
from flows.config import Case
from flows.graph import Graph
from flows.source import ROOT

PACKAGE = "skelebones"


def provenance(
    arguments: tuple[str, ...], cases: list[Case], graph: Graph, refs: dict[str, Ref], computed: set[str]
) -> dict:
    """A report's provenance as plain JSON. arguments: of ``flows.run``, with which this report is made again."""
    return {
        "command": command(arguments).split(" "),
        "git": git_state(),
        "versions": versions(),
        "machine": {"system": platform.platform(), "python": platform.python_version(), "cpu": platform.machine()},
        "seeds": sorted({seed for case in cases for seed in (case.config["seed"], case.seed)}),
        "inputs": inputs(graph),
        "cases": [
            {"dataset": c.dataset, "method": c.method, "variant": c.variant, "config": portable(c.config)}
            for c in cases
        ],
        "stages": [
            {
                "stage": node.stage,
                "cases": node.cases,
                "key": refs[node.id].key,
                "source": node.source,
                "outputs": refs[node.id].outputs,
                "how": "computed" if node.id in computed else "cached",
                "seconds": refs[node.id].seconds,
                "peak_mb": refs[node.id].peak_mb,
            }
            for node in graph.nodes.values()
            if node.id in refs
        ],
    }


def command(arguments: tuple[str, ...]) -> str:
    """The command line that makes a report's numbers, without what belongs to one machine."""
    kept = [a for a in arguments if not a.startswith(("store", "runner", "report.path", "plan"))]
    return " ".join(["python -m flows.run", *(_without_folders(a) for a in kept)])


def portable(config: dict) -> dict:
    """A config without what belongs to one machine: the store, the runner, the folders of inputs and reports."""
    kept = {name: value for name, value in config.items() if name not in ("store", "runner", "data_root", "plan")}
    if isinstance(kept["dataset"].get("path"), str):
        kept["dataset"] = kept["dataset"] | {"path": _without_folders(kept["dataset"]["path"])}
    kept["report"] = {name: value for name, value in kept["report"].items() if name != "path"}
    return kept


def inputs(graph: Graph) -> dict[str, str]:
    """Name of every input file or folder -> sha256 of its bytes."""
    loaders = [node for node in graph.nodes.values() if node.files]
    return {_without_folders(str(node.settings["path"])): node.files for node in loaders}


def _without_folders(text: str) -> str:
    """A path's last name, or KEY=NAME for KEY=PATH: folders belong to one machine."""
    key, equals, value = text.rpartition("=")
    return f"{key}{equals}{value.replace(chr(92), '/').rstrip('/').rpartition('/')[2]}"


def git_state() -> dict:
    """Commit and whether the tree had changes; empty outside a checkout."""

    def git(*arguments: str) -> str:
        done = subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True, timeout=20, check=True)
        return done.stdout.strip()

    try:
        return {"commit": git("rev-parse", "HEAD"), "changed": bool(git("status", "--porcelain", "-uno"))}
    except (OSError, subprocess.SubprocessError):
        return {}


def versions() -> dict[str, str]:
    """Versions of Python and of what the project requires."""
    found = {"python": platform.python_version()}
    try:
        required = [text for text in requires(PACKAGE) or () if "extra ==" not in text]
    except PackageNotFoundError:
        return found
    for name in sorted(re.match(r"[\w.-]+", text).group() for text in required):
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found
