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

import numpy as np
import pandas as pd

from tasks.errors import InputError
from tasks.reporting import page, typeset
from tasks.reporting.rows import to_csv
from tasks.reporting.tables import Table
from tasks.values import Files, Picture

PROVENANCE = "provenance.json"
_STAGING = ".new-"


def write_report(
    folder: Path,
    rows: pd.DataFrame,
    tables: Sequence[Table],
    figures: Sequence[tuple[str, Picture]],
    provenance: Mapping[str, Any],
    brought: Sequence[Files] = (),
) -> None:
    """Writes a report, over an earlier one if there is any; files that only the earlier one had are removed.

    rows: as in metrics.csv; figures: (subject, picture), drawn into figures/<subject>_<name>; provenance: plain JSON
    values, to which "figures", their captions, and "files", each file's sha256, are added; brought: files
    that stages made. Raises InputError where the folder cannot be written.
    """
    drawn = named(figures)
    files = contents(folder.name, rows, tables, drawn, provenance)
    files |= {name: data for some in brought for name, data in some.items()}
    sums = {name: hashlib.sha256(data).hexdigest() for name, data in files.items()}
    captions = {name: picture.caption for name, picture in drawn.items()}
    text = json.dumps({**provenance, "figures": captions, "files": sums}, indent=2, allow_nan=False) + "\n"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with _only_writer(folder):
            _replace(folder, {**files, PROVENANCE: text.encode()})
    except OSError as error:
        found = error.strerror or str(error)
        do = "choose another report.path"
        raise InputError(str(folder), expected="a folder that can be written", found=found, do=do) from error


def contents(
    name: str,
    rows: pd.DataFrame,
    tables: Sequence[Table],
    figures: Mapping[str, Picture],
    provenance: Mapping[str, Any],
) -> dict[str, bytes]:
    """The files of the report ``name`` but its provenance, by their names inside the folder."""
    title = f"Skelebones: {name}"
    links = [f"![{picture.caption}]({file})\n\n*{picture.caption}*\n" for file, picture in figures.items()]
    texts = {
        "metrics.csv": to_csv(rows),
        "table.md": "\n".join([f"# {title}\n", *(typeset.markdown(table) for table in tables), *links]),
        "table.tex": "\n".join(typeset.latex(table) for table in tables),
        "table.html": page.html(title, tables, list(figures.values()), provenance),
    }
    return {file: text.encode() for file, text in texts.items()} | {f: p.data for f, p in figures.items()}


def named(figures: Sequence[tuple[str, Picture]]) -> dict[str, Picture]:
    """Pictures by the names of their files. Raises ValueError where two share one."""
    files: dict[str, Picture] = {}
    for subject, picture in figures:
        stem = re.sub(r"[^A-Za-z0-9_.-]+", "_", f"{subject}_{picture.name}")
        name = f"figures/{stem}.{picture.suffix}"
        if name in files:
            raise ValueError(f"two figures are called {name}")
        files[name] = picture
    return files


def read_provenance(folder: Path) -> dict[str, Any]:
    """A report's provenance. Raises InputError where the folder holds no report."""
    file = folder / PROVENANCE
    try:
        found = json.loads(file.read_text("utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(str(file), expected="the provenance of a report", found=str(error)) from error
    if not isinstance(found, dict):
        raise InputError(str(file), expected="the provenance of a report", found=type(found).__name__)
    return found


def read_figures(folder: Path, provenance: Mapping[str, Any]) -> dict[str, Picture]:
    """A report's figures by the names of their files."""
    found = {}
    for name, caption in provenance["figures"].items():
        data = (folder / name).read_bytes()
        if name.endswith(".svg"):
            found[name] = Picture(name, caption, svg=data.decode())
        else:
            suffix = name.rpartition(".")[2]
            found[name] = Picture(name, caption, **{suffix: np.frombuffer(data, np.uint8)})
    return found


def replace_files(folder: Path, files: Mapping[str, bytes]) -> int:
    """Writes some files of a report over those it has and their checksums into its provenance; returns how many
    changed."""
    origin = read_provenance(folder)
    there = {name: (folder / name).read_bytes() for name in files if (folder / name).is_file()}
    changed = {name: data for name, data in files.items() if there.get(name) != data}
    sums = {name: hashlib.sha256(data).hexdigest() for name, data in changed.items()}
    text = json.dumps({**origin, "files": origin["files"] | sums}, indent=2, allow_nan=False) + "\n"
    for name, data in {**changed, PROVENANCE: text.encode()}.items() if changed else ():
        draft = folder / f"{_STAGING}{Path(name).name}"
        draft.write_bytes(data)
        os.replace(draft, folder / name)
    return len(changed)


def write_page(path: Path, text: str) -> None:
    """Writes one page, whole or not at all. Raises InputError where it cannot be written."""
    draft = path.with_name(f".{path.name}.new")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        draft.write_text(text, "utf-8")
        os.replace(draft, path)
    except OSError as error:
        found = error.strerror or str(error)
        raise InputError(str(path), expected="a page that can be written", found=found) from error


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
