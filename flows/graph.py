"""The graph of a sweep: equal stages of different cases are one node, so shared work is done once.

Prefect does not merge equal tasks that run together; this does, before anything is submitted.
"""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

from flows import source
from flows.cache import canonical_json
from tasks.errors import InputError


@dataclass
class Node:
    """A stage with its settings and where its inputs come from. cases: the names of all cases that need it; title:
    what readers call it where one kind of stage comes several times."""

    id: str
    stage: str
    function: str
    outputs: tuple[str, ...]
    settings: dict
    inputs: dict
    source: str
    files: str
    title: str
    cases: list[str] = field(default_factory=list)

    def __getitem__(self, output: str) -> tuple[Node, str]:
        """One of the node's outputs, to hand to another stage."""
        if output not in self.outputs:
            raise KeyError(f"{self.stage} has the outputs {', '.join(self.outputs)}, not {output}")
        return self, output

    def walk(self) -> Iterator[Node]:
        """The node and all that it depends on, each once."""
        seen: dict[str, Node] = {}
        pending = [self]
        while pending:
            node = pending.pop()
            if node.id not in seen:
                seen[node.id] = node
                pending += node.upstream()
        yield from seen.values()

    def upstream(self) -> list[Node]:
        """The nodes whose artefacts this one reads."""
        found: list[Node] = []
        for value in self.inputs.values():
            pairs = value.values() if isinstance(value, dict) else [value]
            found += [node for node, _ in pairs]
        return found


class Graph:
    """Nodes by identity, in an order in which every node stands after what it needs."""

    def __init__(self, files: dict[str, str] | None = None) -> None:
        """files: digests of input files by path, to be shared by graphs that read the same."""
        self.nodes: dict[str, Node] = {}
        self._files = {} if files is None else files  # an input shared by many cases is read once

    def add(
        self,
        stage: str,
        function: str,
        settings: dict,
        *,
        outputs: tuple[str, ...],
        case: str,
        path: str | None = None,
        title: str | None = None,
        **inputs: object,
    ) -> Node:
        """The node of a stage, made or found. path: an input file or folder whose bytes count in the cache key; title:
        its name for readers, if not that of the stage."""
        files = self._digest(path) if path else ""
        described = {n: _identity(v) for n, v in inputs.items()}
        text = canonical_json([stage, function, settings, list(outputs), described, files])
        identity = hashlib.sha256(text.encode()).hexdigest()
        code = source.digest(function.split(":")[0])
        new = Node(identity, stage, function, outputs, settings, inputs, code, files, title or stage)
        node = self.nodes.setdefault(identity, new)
        if case not in node.cases:
            node.cases.append(case)
        return node

    def _digest(self, path: str) -> str:
        if path not in self._files:
            self._files[path] = digest_of_files(path)
        return self._files[path]


def union(graphs: list[Graph]) -> Graph:
    """All nodes of several graphs; equal ones become one that names the cases of all."""
    whole = Graph()
    for graph in graphs:
        for node in graph.nodes.values():
            one = whole.nodes.setdefault(node.id, replace(node, cases=[]))
            one.cases += [case for case in node.cases if case not in one.cases]
    return whole


def digest_of_files(path: str) -> str:
    """Digest of a file, or of all files of a folder with their names; "absent" if there is nothing. Raises InputError
    for files that cannot be read or that vanish meanwhile."""
    try:
        return _digest_of_files(Path(path).expanduser())
    except OSError as error:
        found = f"{error.strerror} ({Path(error.filename or path).name})"
        raise InputError(path, expected="files that can be read", found=found, do="check permissions") from None


def _digest_of_files(root: Path) -> str:
    files = sorted(p for p in root.rglob("*") if p.is_file()) if root.is_dir() else [root]
    total = hashlib.sha256()
    for file in files:
        if not file.is_file():
            return "absent"  # the loader says so in its own words
        with open(file, "rb") as stream:
            content = hashlib.file_digest(stream, "sha256").hexdigest()
        total.update(f"{file.relative_to(root) if root.is_dir() else ''}:{content}\n".encode())
    return total.hexdigest()


def _identity(value: object) -> object:
    if isinstance(value, dict):
        return {n: _identity(v) for n, v in value.items()}
    node, output = value
    return [node.id, output]


def short(cases: list[str]) -> str:
    """The cases of a shared stage, in as few words as say it: the words they all begin with."""
    columns = zip(*(case.split() for case in cases), strict=False)
    common = [words[0] for words in itertools.takewhile(lambda words: len(set(words)) == 1, columns)]
    return " ".join(common) or f"{cases[0]} and {len(cases) - 1} more"
