"""Imports point one way: from the flow to the science, from what stands above the stages to the stages, never back."""

import ast
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

from flows.source import ROOT

BASE = {"errors", "values", "geometry", "workspace", "compiled"}  # what every stage may stand on
ABOVE = {  # what a folder of tasks may use besides; a folder that is not named is a stage and uses the base alone
    "methods": {"motion"},
    "drawing": {"evaluation"},
    "reporting": {"evaluation"},
    "garments": {"datasets", "evaluation"},
    "benchmarks": {"bones", "skeleton", "motion", "methods", "reconstruction", "evaluation", "drawing"},
}
FOREIGN = {"flows", "prefect", "hydra", "omegaconf"}


def imports(source: str) -> set[str]:
    """The modules that a source names in its imports, each name of ``from a import b`` as a.b too."""
    found = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    return found


def sources(folder: str) -> dict[str, str]:
    """Texts of a folder's modules by their dotted names."""
    paths = {p: p.relative_to(ROOT).with_suffix("") for p in sorted((ROOT / folder).rglob("*.py"))}
    return {".".join(name.parts).removesuffix(".__init__"): p.read_text("utf-8") for p, name in paths.items()}


def strangers(module: str, source: str) -> set[str]:
    """What a module of tasks imports though its layer may not."""
    home = module.split(".")[1] if module.count(".") else ""
    allowed = BASE | ABOVE.get(home, set()) | {home}
    names = {tuple(name.split(".")) for name in imports(source)}
    inside = {name[1] for name in names if name[0] == "tasks" and len(name) > 1}
    return (inside - allowed) | ({name[0] for name in names} & FOREIGN)


def test_the_science_stands_on_its_own_and_stages_do_not_know_each_other():
    found = {module: strangers(module, source) for module, source in sources("tasks").items()}
    assert len(found) > 100
    assert not {module: names for module, names in found.items() if names}


def test_a_wrong_import_would_be_seen():
    assert strangers("tasks.bones.ssdr", "from tasks.skeleton.flow import x") == {"skeleton"}
    assert strangers("tasks.bones.ssdr", "def f():\n    import prefect.flows") == {"prefect"}
    assert strangers("tasks.geometry.rigid", "from tasks import motion") == {"motion"}


def test_no_module_imports_itself_by_a_detour():
    texts = sources("tasks") | sources("flows")
    graph = {module: (imports(text) & texts.keys()) - {module, "tasks", "flows"} for module, text in texts.items()}
    assert len(list(TopologicalSorter(graph).static_order())) == len(texts)
    with pytest.raises(CycleError):
        list(TopologicalSorter(graph | {"tasks.values": {"tasks.bones.ssdr"}}).static_order())


def test_the_layers_named_here_exist():
    folders = {p.name for p in Path(ROOT / "tasks").iterdir() if p.is_dir() and not p.name.startswith("_")}
    assert set(ABOVE) <= folders
