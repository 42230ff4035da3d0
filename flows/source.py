"""Reading our own sources without running them: signatures for the config schema, digests for the cache key."""

from __future__ import annotations

import ast
import hashlib
import re
from functools import cache
from pathlib import Path
from typing import Annotated, Literal

from tasks.errors import InputError

ROOT = Path(__file__).resolve().parent.parent
WORKSPACE = "workspace"  # a keyword that is no setting: see tasks.workspace
FILES = ("path", "lpips")  # settings that name an input file, whose bytes count and not its place
_TYPES = {
    "int": int,
    "float": float,
    "str": str,
    "bool": bool,
    "None": None,
    "list": list,
    "dict": dict,
    "Literal": Literal,
    "Annotated": Annotated,
}


@cache
def signature(function: str) -> tuple[tuple[str, ...], dict[str, object]]:
    """Positional names and keyword-only types of ``"package.module:function"``, read from its source.

    Settings live in the signature of the function that uses them and nowhere else; reading the source instead of
    importing it keeps torch out of a config error.
    """
    module, name = function.split(":")
    for node in _tree(module).body:
        if isinstance(node, ast.FunctionDef) and node.name == name:
            types = {a.arg: _type(a.annotation, function, a.arg) for a in node.args.kwonlyargs if a.arg != WORKSPACE}
            return tuple(a.arg for a in node.args.args), types
    raise LookupError(f"{module} has no function {name}")


@cache
def returns(function: str) -> str:
    """The return annotation of ``"package.module:function"`` as text."""
    module, name = function.split(":")
    for node in _tree(module).body:
        if isinstance(node, ast.FunctionDef) and node.name == name:
            return ast.unparse(node.returns) if node.returns else ""
    raise LookupError(f"{module} has no function {name}")


@cache
def digest(module: str) -> str:
    """Digest of a module of ``tasks`` and of all of ``tasks`` that it imports, comments and docstrings left out.

    Only for the main thread: CPython 3.11's parser fails at random when several threads use it.
    """
    seen: dict[str, str] = {}
    pending = [module]
    while pending:
        name = pending.pop()
        if name not in seen:
            seen[name], needs = _code(name)
            pending.extend(needs)
    text = "\n".join(f"# {name}\n{seen[name]}" for name in sorted(seen))
    return hashlib.sha256(text.encode()).hexdigest()


@cache
def _code(module: str) -> tuple[str, list[str]]:
    """A module's code without comments and docstrings, and what of ``tasks`` it imports."""
    tree = _tree(module)
    needs = _imports(tree)
    return ast.unparse(_without_docstrings(ast.parse(_source(module)))), needs


def has(module: str) -> bool:
    """Whether a module of ours exists."""
    return _path(module).is_file()


def _path(module: str) -> Path:
    base = ROOT.joinpath(*module.split("."))
    return base / "__init__.py" if base.is_dir() else base.with_suffix(".py")


@cache
def _source(module: str) -> str:
    return _path(module).read_text("utf-8")


@cache
def _tree(module: str) -> ast.Module:
    return ast.parse(_source(module))


def _type(annotation: ast.expr | None, function: str, name: str) -> object:
    """The type an annotation names: int, float, str, bool, list[...], Literal[...] and unions of them with None; a
    number may have the interval it lies in, any of them what must hold beside others, as ``Annotated[float, "(0, 1]"]``
    (see :mod:`flows.ranges`)."""
    try:
        return eval(compile(ast.Expression(annotation), "<annotation>", "eval"), {"__builtins__": {}}, dict(_TYPES))
    except (NameError, TypeError, ValueError, AttributeError) as error:
        found = f"{name}: {ast.unparse(annotation)}" if annotation else f"{name} without a type"
        expected = f"settings of the types {', '.join(_TYPES)}, or unions of them"
        raise InputError(function, expected=expected, found=found) from error


def _imports(tree: ast.Module) -> list[str]:
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found += [a.name for a in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            found.append(node.module)
            found += [f"{node.module}.{a.name}" for a in node.names]
    return [m for m in found if m.split(".")[0] == "tasks" and has(m)]


def _without_docstrings(tree: ast.Module) -> ast.Module:
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if isinstance(body, list) and body and isinstance(body[0], ast.Expr):
            constant = body[0].value
            if isinstance(constant, ast.Constant) and isinstance(constant.value, str):
                body[0] = ast.Pass()
    return tree


def choices(folders: tuple[str, ...], function: str, what: str, name: str) -> str:
    """``tasks.<folder>.<name>:<function>`` of the first folder that has it. Raises InputError, listing what there is,
    where none has."""
    known: dict[str, str] = {}
    for folder in folders:
        for path in (ROOT / "tasks" / folder).glob("*.py"):
            if _defines(f"tasks.{folder}.{path.stem}", function):
                known.setdefault(path.stem, folder)
    if name not in known:
        there = [f"tasks/{f}/{name}.py" for f in folders if has(f"tasks.{f}.{name}")] if name.isidentifier() else []
        found = f"{there[0]} without a function {function}" if there else repr(name)
        raise InputError(what, expected=f"one of {', '.join(sorted(known))}", found=found)
    return f"tasks.{known[name]}.{name}:{function}"


def _defines(module: str, function: str) -> bool:
    return re.search(rf"^def {function}\(", _source(module), re.MULTILINE) is not None
