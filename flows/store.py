"""``python -m flows.store ls|gc|verify``: what is cached, what no report needs, what is damaged.

Exit status: 0 done, 2 damaged artefacts were found or the command is wrong.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import shutil
import sys
import time
from pathlib import Path

from filelock import Timeout
from rich.console import Console
from rich.table import Table

from flows.cache import Artefact, Store
from tasks.errors import InputError

HOUR = 3600.0


def main(arguments: list[str] | None = None) -> int:
    """The command line. Returns the exit status."""
    known = _parser().parse_args(arguments)
    console = Console(highlight=False, soft_wrap=True)
    try:
        if not Path(known.store).is_dir():
            raise InputError(known.store, expected="a store", found="no folder", do="add --store FOLDER")
        return known.do(Store(known.store, create=False), known, console)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2


def listing(store: Store, known: argparse.Namespace, console: Console) -> int:
    """Prints what is cached: a line for every stage, or for every artefact of the stages asked for."""
    found = store.artefacts()
    if known.stage:
        _check_stages(known.stage, found)
        console.print(_artefacts([a for a in found if a.stage in known.stage]))
    else:
        console.print(_stages(found))
    console.print(f"{len(found)} artefacts, {_size(sum(a.size for a in found))} in {store.path}", markup=False)
    return 0


def collect(store: Store, known: argparse.Namespace, console: Console) -> int:
    """Frees what no report needs; without --yes it only says what that would be."""
    needed = needed_by_reports(Path(known.reports))
    found = store.artefacts()
    idle = [a for a in found if (a.stage, a.key) not in needed]
    young = [a for a in idle if time.time() - a.written < known.older * HOUR]
    idle = [a for a in idle if a not in young]
    drafts = [d for d in _drafts(store) if time.time() - d.stat().st_mtime >= known.older * HOUR]
    size = sum(a.size for a in idle) + sum(_tree_size(d) for d in drafts)
    console.print(_stages(idle))
    said = f"{len(idle)} artefacts that no report under {known.reports} needs"
    said += f" and {len(drafts)} drafts of runs that were stopped" if drafts else ""
    if known.yes:
        for artefact in idle:
            store.drop(artefact.stage, artefact.key)
        for draft in drafts:
            with contextlib.suppress(Timeout), store.lock(draft.parent.name, draft.stem, wait=0):
                shutil.rmtree(draft, ignore_errors=True)  # one whose lock is held belongs to a run that lives
        store.sweep_locks()
        console.print(f"removed {said}: {_size(size)} freed", markup=False)
    else:
        console.print(f"{said}: {_size(size)}; add --yes to remove them", markup=False)
    kept = [f"{len(found) - len(idle) - len(young)} artefacts are needed and kept"]
    if young:
        kept.append(
            f"{len(young)} are younger than {known.older:g} h and kept, a run may be using them (--older HOURS)"
        )
    console.print("; ".join(kept), markup=False)
    return 0


def verify(store: Store, known: argparse.Namespace, console: Console) -> int:
    """Reads every artefact and lists those whose bytes are not what was written; they end the command with status 2."""
    found = store.artefacts()
    damaged = 0
    for artefact in found:
        wrong = store.damage(artefact)
        if wrong:
            damaged += 1
            console.print(f"damaged: {artefact.stage}/{artefact.key} ({artefact.case}): {wrong}", markup=False)
    console.print(f"{len(found)} artefacts read, {damaged} damaged", markup=False)
    if damaged:
        console.print("A run that needs a damaged artefact computes it again.")
    return 2 if damaged else 0


def needed_by_reports(folder: Path) -> set[tuple[str, str]]:
    """(stage, key) of all that the reports under a folder were made of.

    Raises InputError where one cannot be read: what it needs is not known then.
    """
    if not folder.is_dir():
        raise InputError(str(folder), expected="a folder of reports", found="no folder", do="add --reports FOLDER")
    needed = set()
    for file in sorted(folder.rglob("provenance.json")):
        try:
            needed |= {(s["stage"], s["key"]) for s in json.loads(file.read_text("utf-8"))["stages"]}
        except (OSError, ValueError, KeyError, TypeError) as error:
            do = "mend or remove that report"
            raise InputError(str(file), expected="the stages of a report", found=repr(error), do=do) from None
    return needed


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m flows.store", description="Looks after the store of artefacts.")
    commands = parser.add_subparsers(required=True, metavar="ls|gc|verify")

    def command(name: str, do, text: str) -> argparse.ArgumentParser:
        one = commands.add_parser(name, help=text, description=text)
        one.add_argument("--store", default="store", metavar="FOLDER", help="the store (default: store)")
        one.set_defaults(do=do)
        return one

    ls = command("ls", listing, "what is cached")
    ls.add_argument("stage", nargs="*", help="list every artefact of these stages")
    gc = command("gc", collect, "free what no report needs")
    gc.add_argument("--yes", action="store_true", help="remove them; without it they are only listed")
    gc.add_argument("--reports", default="reports", metavar="FOLDER", help="the reports that count (default: reports)")
    gc.add_argument("--older", type=float, default=1.0, metavar="HOURS", help="spare younger artefacts (default: 1)")
    command("verify", verify, "check every digest; exit status 2 if one is wrong")
    return parser


def _check_stages(wanted: list[str], found: list[Artefact]) -> None:
    stages = sorted({a.stage for a in found})
    for stage in wanted:
        if stage not in stages:
            raise InputError("stage", expected=f"one of {', '.join(stages)}", found=repr(stage))


def _drafts(store: Store) -> list[Path]:
    """What writers that were killed left behind."""
    return [p for p in sorted(store.path.glob("*/*")) if p.is_dir() and p.suffix in (".tmp", ".part")]


def _tree_size(folder: Path) -> int:
    return sum(p.stat().st_size for p in folder.rglob("*") if p.is_file())


def _stages(found: list[Artefact]) -> Table:
    table = _table("stage", ["artefacts", "size", "computed in", "youngest", "oldest"])
    for stage in dict.fromkeys(a.stage for a in found):
        those = [a for a in found if a.stage == stage]
        times = [a.written for a in those]
        spent = f"{sum(a.seconds for a in those):.0f} s"
        size = _size(sum(a.size for a in those))
        table.add_row(stage, str(len(those)), size, spent, _age(max(times)), _age(min(times)))
    return table


def _artefacts(found: list[Artefact]) -> Table:
    table = _table("stage", ["size", "computed in", "age"])
    table.add_column("key")
    table.add_column("for")
    for a in sorted(found, key=lambda a: (a.stage, a.case, a.written)):
        table.add_row(a.stage, _size(a.size), f"{a.seconds:.1f} s", _age(a.written), a.key[:12], a.case)
    return table


def _table(first: str, numbers: list[str]) -> Table:
    table = Table()
    table.add_column(first)
    for name in numbers:
        table.add_column(name, justify="right")
    return table


def _size(count: float) -> str:
    """Bytes in words."""
    for unit in ("B", "kB", "MB"):
        if count < 1000:
            return f"{count:.0f} {unit}"
        count /= 1000
    return f"{count:.1f} GB"


def _age(written: float) -> str:
    seconds = max(time.time() - written, 0.0)
    for unit, size in (("d", 86400.0), ("h", HOUR), ("min", 60.0)):
        if seconds >= size:
            return f"{seconds / size:.0f} {unit}"
    return f"{seconds:.0f} s"


if __name__ == "__main__":
    raise SystemExit(main())
