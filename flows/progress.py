"""What a user sees while a sweep works: which stage, which case, cached or computed, seconds; then the tables."""

from __future__ import annotations

import contextlib
import json
import threading
import time
from collections.abc import Callable
from pathlib import Path

from rich.console import Console
from rich.live import Live
from rich.spinner import Spinner
from rich.table import Table
from rich.text import Text

from flows.cache import Ref
from flows.graph import Graph, Node, short


class Progress:
    """A line for every finished stage and a live line for the running ones; on a pipe, only the finished ones.

    Workers report the start of a stage in a file of events, since they may be other processes.
    """

    def __init__(self, graph: Graph, show: bool = True) -> None:
        self.tell: Callable[[Node], None] = lambda node: None  # hears of every stage that finished
        self.total = len(graph.nodes)
        self.finished = 0
        self._start = time.monotonic()
        self.console = Console(quiet=not show, highlight=False)
        self._events: Path | None = None
        self._read = 0
        self._running: dict[tuple[str, str], tuple[float, str]] = {}  # since when, and how far in its own words
        self._lock = threading.Lock()
        self._live = Live(console=self.console, get_renderable=self._now, refresh_per_second=4, transient=True)

    def __enter__(self) -> Progress:
        if self.console.is_terminal:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._live.stop()

    def follow(self, events: str) -> None:
        """The file in which workers write what they start."""
        with self._lock:
            self._events, self._read, self._running = Path(events), 0, {}

    def done(self, node: Node, ref: Ref) -> None:
        """A stage finished."""
        self.finished += 1
        how = Text("cached  ", "dim") if ref.cached else Text("computed", "green")
        took = "" if ref.cached else f"{ref.seconds:8.1f} s {ref.peak_mb:7.0f} MB"
        self._line(node, how, took)

    def failed(self, node: Node, error: BaseException) -> None:
        """A stage failed; what does not depend on it goes on."""
        self.finished += 1
        self._line(node, Text("failed  ", "bold red"), f"  {type(error).__name__}")

    def note(self, text: str) -> None:
        """A remark that the user should see."""
        self._print(Text(f"  {text}", "yellow"))

    def finish(self, tables: list, folder: Path, computed: int) -> None:
        """The tables, and where the report lies."""
        for table in tables:
            self.console.print()
            self.console.print(table)
        how = "nothing was computed, all was cached" if not computed else f"{computed} of {self.total} stages computed"
        self.console.print()
        self._print(f"{how}; {time.monotonic() - self._start:.1f} s; report in {folder}")

    def running(self) -> list[str]:
        """The stages that workers have begun and not finished."""
        self._poll()
        with self._lock:
            return [f"{stage} ({case})" for stage, case in self._running]

    def _line(self, node: Node, how: Text, rest: str) -> None:
        self._poll()  # or its beginning would be heard of after its end
        with self._lock:
            self._running.pop((node.stage, short(node.cases)), None)
        self.tell(node)
        more = f" (+{len(node.cases) - 1} cases)" if len(node.cases) > 1 else ""
        count = f"[{self.finished:{len(str(self.total))}}/{self.total}] "
        self._print(Text.assemble((count, "dim"), how, f" {node.stage:<10} {node.cases[0]}{more}", rest))

    def _print(self, text: str | Text) -> None:
        """One line, however long: a command or a path that is cut in two can be neither copied nor searched for."""
        self.console.print(text, soft_wrap=True)

    def _now(self) -> Table:
        self._poll()
        table = Table.grid(padding=(0, 1))
        with self._lock:
            for (stage, case), (since, how_far) in self._running.items():
                table.add_row(Spinner("dots"), stage, case, f"{time.time() - since:.0f} s", how_far)
        return table

    def _poll(self) -> None:
        with self._lock:
            new = b""
            with contextlib.suppress(OSError):  # nothing was begun so far
                if self._events:
                    with open(self._events, "rb") as file:
                        file.seek(self._read)
                        new = file.read()
            new = new[: new.rfind(b"\n") + 1]
            self._read += len(new)
            for line in new.splitlines():
                event = json.loads(line)
                running = event["stage"], event["case"]
                if event["event"] == "progress":
                    since = self._running.get(running, (event["time"], ""))[0]
                    self._running[running] = since, f"{event['fraction']:4.0%} {event['text']}"
                else:
                    self._running[running] = event["time"], ""
