"""A report's folder: metrics.csv, table.md, table.tex, table.html, figures/ and provenance.json.

Everything is made before anything is written, and every file is renamed into place whole: a run that fails leaves the
earlier report as it was. provenance.json comes last and holds every file's checksum.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import re
import shutil
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from tasks.errors import InputError
from tasks.evaluation import page, typeset
from tasks.evaluation.rows import to_csv
from tasks.evaluation.tables import Table
from tasks.values import File, Picture

PROVENANCE = "provenance.json"
_STAGING = ".new-"


def write_report(
    folder: Path,
    rows: pd.DataFrame,
    tables: Sequence[Table],
    figures: Sequence[tuple[str, Picture]],
    provenance: Mapping[str, Any],
    brought: Sequence[File] = (),
) -> None:
    """Writes a report, over an earlier one if there is any; files that only the earlier one had are removed.

    rows: as in metrics.csv; figures: (subject, picture), drawn into figures/<subject>_<name>; provenance: plain JSON
    values, to which "files" is added, each file's sha256; brought: files that stages made.
    Raises InputError where the folder cannot be written.
    """
    files = contents(f"Skelebones: {folder.name}", rows, tables, figures, provenance)
    files |= {file.path: file.content.tobytes() for file in brought}
    sums = {name: hashlib.sha256(data).hexdigest() for name, data in files.items()}
    text = json.dumps({**provenance, "files": sums}, indent=2, allow_nan=False) + "\n"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with _only_writer(folder):
            _replace(folder, {**files, PROVENANCE: text.encode()})
    except OSError as error:
        found = error.strerror or str(error)
        do = "choose another report.path"
        raise InputError(str(folder), expected="a folder that can be written", found=found, do=do) from error


def contents(
    title: str,
    rows: pd.DataFrame,
    tables: Sequence[Table],
    figures: Sequence[tuple[str, Picture]],
    provenance: Mapping[str, Any],
) -> dict[str, bytes]:
    """The files of a report but its provenance, by their names inside the folder. Raises ValueError where two figures
    share a name."""
    drawn: dict[str, bytes] = {}
    links = []
    for subject, picture in figures:
        stem = re.sub(r"[^A-Za-z0-9_.-]+", "_", f"{subject}_{picture.name}")
        name = f"figures/{stem}.{'svg' if picture.png is None else 'png'}"
        if name in drawn:
            raise ValueError(f"two figures are called {name}")
        drawn[name] = picture.svg.encode() if picture.png is None else picture.png.tobytes()
        links.append(f"![{picture.caption}]({name})\n\n*{picture.caption}*\n")
    texts = {
        "metrics.csv": to_csv(rows),
        "table.md": "\n".join([f"# {title}\n", *(typeset.markdown(table) for table in tables), *links]),
        "table.tex": "\n".join(typeset.latex(table) for table in tables),
        "table.html": page.html(title, tables, [picture for _, picture in figures], provenance),
    }
    return {name: text.encode() for name, text in texts.items()} | drawn


def _replace(folder: Path, files: Mapping[str, bytes]) -> None:
    """Writes all files aside, then renames them into place in order; the last one is the provenance."""
    for left in folder.glob(f"{_STAGING}*"):  # of a run that was killed
        shutil.rmtree(left)
    earlier = _files_of(folder)
    staging = Path(tempfile.mkdtemp(prefix=_STAGING, dir=folder))
    try:
        for name, data in files.items():
            path = staging / name
            path.parent.mkdir(parents=True, exist_ok=True)
            with path.open("wb") as out:
                out.write(data)
                out.flush()
                os.fsync(out.fileno())
        for name in files:
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            os.replace(staging / name, folder / name)
        for name in earlier - set(files):
            (folder / name).unlink(missing_ok=True)
    finally:
        shutil.rmtree(staging, ignore_errors=True)


def _files_of(folder: Path) -> set[str]:
    """The files that an earlier report says it is made of, as far as they lie in its folder."""
    try:
        listed = json.loads((folder / PROVENANCE).read_text())["files"]
        return {name for name in listed if (folder / name).resolve().is_relative_to(folder.resolve())}
    except (OSError, ValueError, KeyError, TypeError):
        return set()


@contextlib.contextmanager
def _only_writer(folder: Path) -> Iterator[None]:
    """Holds other processes off the folder; the system lets go of the lock when the process dies."""
    try:
        import fcntl
    except ImportError:  # Windows: two runs of one report at once are the user's to avoid
        yield
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX)
        yield
    finally:
        os.close(handle)
