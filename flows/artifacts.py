"""What Prefect's dashboard shows of a run beside its graph: progress, tables and figures."""

from __future__ import annotations

import base64
import re
from pathlib import Path

STEP = 5  # per cent
LARGEST_FIGURE = 400_000  # bytes; larger pictures stay in the report's folder


def publish(folder: Path, tables: str) -> None:
    """Posts a report's tables and figures as artifacts of the flow run. tables: Markdown."""
    from prefect.artifacts import create_image_artifact, create_markdown_artifact

    name = key(folder.name)
    create_markdown_artifact(markdown=tables, key=f"{name}-table", description=f"tables of {folder.name}")
    for figure in sorted((folder / "figures").glob("*.png")):
        data = figure.read_bytes()
        if len(data) <= LARGEST_FIGURE:
            url = "data:image/png;base64," + base64.b64encode(data).decode()
            create_image_artifact(image_url=url, key=f"{name}-{key(figure.stem)}", description=figure.stem)


class ProgressArtifact:
    """The share of finished stages, as a bar on the run's page."""

    def __init__(self, name: str, total: int) -> None:
        from prefect.artifacts import create_progress_artifact

        self._total = max(total, 1)
        self._percent = 0
        self._id = create_progress_artifact(progress=0.0, key=f"{key(name)}-progress", description="stages finished")

    def update(self, finished: int) -> None:
        """Moves the bar, in steps that are worth a call to the server."""
        from prefect.artifacts import update_progress_artifact

        percent = 100 * finished // self._total
        if percent >= self._percent + STEP or finished == self._total:
            self._percent = percent
            update_progress_artifact(self._id, progress=float(percent))


def key(text: str) -> str:
    """A name as Prefect wants it: small letters, digits and dashes."""
    return re.sub(r"[^a-z0-9]+", "-", text.lower()).strip("-") or "report"
