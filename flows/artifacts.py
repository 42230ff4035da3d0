"""What Prefect's pages show of a run beside its graph: progress, tables, figures, and what failed.

A run never depends on them: when the server stops answering it says so once and goes on without.
"""

from __future__ import annotations

import base64
import logging
import re
from collections import Counter
from collections.abc import Callable
from pathlib import Path

from flows.graph import Graph, Node
from flows.server import alive, watched

STEP = 5  # per cent
LARGEST_FIGURE = 400_000  # bytes; larger pictures stay in the report's folder
LOST = "Prefect's server does not answer; the run goes on, its page will not show the rest"


class Board:
    """The artifacts of one flow run, posted from within the flow. note: told once if the server is lost."""

    def __init__(self, name: str, graph: Graph, note: Callable[[str], None]) -> None:
        self._name, self._note = name, note
        self._on = watched()
        self._lost = False
        self._totals = Counter(node.stage for node in graph.nodes.values())
        self._done: Counter[str] = Counter()
        self._bars: dict[str, Bar] = {}

    def start(self) -> None:
        """A bar for all stages together and one for every kind of stage."""
        self._post(self._make_bars)

    def _make_bars(self) -> None:
        self._bars[""] = Bar(f"{self._name}-progress", "all stages")
        for stage, total in self._totals.items():
            self._bars[stage] = Bar(f"{self._name}-progress-{stage}", f"{stage}, {total} to do")

    def update(self, node: Node) -> None:
        """A stage has finished, well or badly. Also notices a server that is gone, with or without pages."""
        if not alive():
            self._lose()
        self._done[node.stage] += 1
        if self._bars:
            self._post(self._bars[""].move, self._done.total() / self._totals.total())
        if self._bars:
            self._post(self._bars[node.stage].move, self._done[node.stage] / self._totals[node.stage])

    def publish(self, folder: Path, tables: str) -> None:
        """A report's tables (Markdown) and figures."""
        from prefect.artifacts import create_image_artifact, create_markdown_artifact

        table = {"key": key(f"{self._name}-table"), "description": f"tables of {self._name}"}
        self._post(create_markdown_artifact, markdown=tables, **table)
        for figure in sorted((folder / "figures").glob("*.png")):
            data = figure.read_bytes()
            if len(data) <= LARGEST_FIGURE:
                url = "data:image/png;base64," + base64.b64encode(data).decode()
                about = {"key": key(f"{self._name}-{figure.stem}"), "description": figure.stem.replace("_", " ")}
                self._post(create_image_artifact, image_url=url, **about)

    def failure(self, what: str, cases: list[str], error: BaseException, command: str) -> None:
        """What failed, for which cases, and how to run one of them alone: as an artifact and in the run's log."""
        from prefect import get_run_logger
        from prefect.artifacts import create_markdown_artifact

        lines = [
            f"# {what} failed",
            f"**Why:** {type(error).__name__}: {error}",
            "**For:**\n" + "\n".join(f"- {case}" for case in cases),
            f"**Run just this case again:**\n\n```\n{command}\n```",
            "What was finished is kept in the store and is not computed again.",
        ]
        self._post(get_run_logger().error, f"{what} failed for {', '.join(cases)}: {error}\nrun it alone: {command}")
        about = {"key": key(f"{self._name}-failed-{what}"), "description": f"{what} failed for {cases[0]}"}
        self._post(create_markdown_artifact, markdown="\n\n".join(lines), **about)

    def _post(self, call: Callable, *arguments: object, **named: object) -> None:
        if self._on and not _posted(call, *arguments, **named):
            self._lose()

    def _lose(self) -> None:
        if not self._lost:
            self._note(LOST)
        self._on, self._lost = False, True
        self._bars.clear()


class Bar:
    """A progress artifact, moved in steps that are worth a call to the server."""

    def __init__(self, name: str, description: str) -> None:
        from prefect.artifacts import create_progress_artifact

        self._percent = 0.0
        self._id = create_progress_artifact(progress=0.0, key=key(name), description=description)

    def move(self, share: float, description: str | None = None) -> None:
        """To a share of the whole, 0 to 1; description: what it says from now on."""
        from prefect.artifacts import update_progress_artifact

        percent = 100.0 * min(share, 1.0)  # a damaged artefact counts again when it is made anew
        if percent >= self._percent + STEP or share >= 1:
            self._percent = percent
            update_progress_artifact(self._id, progress=percent, description=description)


class StageBar:
    """How far one long stage is, as an artifact of its task; short stages never say, and have none."""

    def __init__(self, stage: str, case: str) -> None:
        self._stage, self._case = stage, case
        self._on = watched()
        self._bar: Bar | None = None

    def say(self, text: str, share: float) -> None:
        """Moves the bar; text stands beside it."""
        self._on = self._on and _posted(self._move, text, share)

    def _move(self, text: str, share: float) -> None:
        about = f"{self._stage}: {self._case}"
        self._bar = self._bar or Bar(about, about)
        self._bar.move(share, f"{about}, {text}")


def _posted(call: Callable, *arguments: object, **named: object) -> bool:
    """Calls the server; False when it is gone or refuses: a page that cannot be filled must not end a run."""
    if not alive():
        return False
    try:
        call(*arguments, **named)
    except Exception as error:  # whatever the client raises
        logging.getLogger(__name__).debug("posting failed", exc_info=error)
        return False
    return True


def key(text: str) -> str:
    """A name as Prefect wants it: small letters, digits and dashes."""
    return re.sub(r"[^a-z0-9]+", "-", text.lower()).strip("-") or "report"
