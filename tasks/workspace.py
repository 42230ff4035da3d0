"""What a long stage may lean on besides its inputs: a folder to resume from, a way to say how far it is, a cap.

A stage that takes the keyword ``workspace`` gets one from whoever runs it. Nothing in it may change the result: it is
no setting and does not count in the cache key.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from tasks.errors import InputError


def _silent(text: str, fraction: float) -> None:
    """Says nothing: a stage that is called from a notebook."""


@dataclass(frozen=True)
class Workspace:
    """folder: belongs to this stage with these inputs and settings alone, outlives a kill, and is removed when the
    result is in the store; tell: takes a text and the share that is done, 0 to 1; max_gb: the process's cap on resident
    memory, or None."""

    folder: Path
    tell: Callable[[str, float], None] = _silent
    max_gb: float | None = None

    def say(self, text: str, fraction: float) -> None:
        """Tells how far the stage is, and checks the cap on the way. Raises InputError when it is passed."""
        self.check_memory()
        self.tell(text, fraction)

    def check_memory(self, wanted_gb: float = 0.0) -> None:
        """Raises InputError when the process with wanted_gb more would be over the cap."""
        if self.max_gb is None:
            return
        import psutil

        used = psutil.Process().memory_info().rss / 1e9 + wanted_gb
        if used > self.max_gb:
            raise InputError(
                "memory.max_gb",
                expected=f"at most {self.max_gb:g} GB in use",
                found=f"{used:.2f} GB",
                do="raise it, take smaller images or fewer points; finished stages and checkpoints are kept",
            )
