"""The store's commands: what they list, what they free and what they spare, and that damage is told by the status."""

from __future__ import annotations

import json
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import pytest

from flows.cache import Store
from flows.stage import run
from flows.store import main
from tests.workflow.test_sweep import job


@pytest.fixture
def kept(tmp_path):
    """A store with two artefacts, one of which a report needs. -> (folder, needed, idle)."""
    needed, idle = run(job(tmp_path)), run(job(tmp_path, settings={"value": 2.0, "log": str(tmp_path / "log.txt")}))
    report = tmp_path / "reports" / "one"
    report.mkdir(parents=True)
    stages = [{"stage": needed.stage, "key": needed.key}]
    (report / "provenance.json").write_text(json.dumps({"stages": stages}))
    return tmp_path, needed, idle


def command(folder, *arguments: str) -> int:
    name, *rest = arguments
    reports = ["--reports", str(folder / "reports")] if name == "gc" else []
    return main([name, "--store", str(folder / "store"), *reports, *rest])


def there(folder) -> set[str]:
    return {a.key for a in Store(folder / "store").artefacts()}


def test_ls(kept, capsys):
    folder, needed, _ = kept
    assert command(folder, "ls") == 0
    assert "2 artefacts" in capsys.readouterr().out
    assert command(folder, "ls", "make") == 0
    assert needed.key[:12] in capsys.readouterr().out
    assert command(folder, "ls", "nope") == 2
    assert capsys.readouterr().err.strip() == "error: stage: expected one of make, found 'nope'"


def test_gc_spares_what_reports_need_and_what_is_young_and_asks_first(kept, capsys):
    folder, needed, idle = kept
    draft = folder / "store" / "make" / "abc.tmp"
    draft.mkdir()
    (draft / "out.safetensors").write_bytes(bytes(1000))
    assert command(folder, "gc", "--yes") == 0
    assert there(folder) == {needed.key, idle.key}  # both are younger than an hour
    assert "1 are younger than 1 h" in capsys.readouterr().out
    assert command(folder, "gc", "--older", "0") == 0
    assert there(folder) == {needed.key, idle.key}
    assert "add --yes" in capsys.readouterr().out
    assert command(folder, "gc", "--older", "0", "--yes") == 0
    assert there(folder) == {needed.key}
    assert not draft.exists()
    assert Store(folder / "store").find("make", needed.key)
    assert not list((folder / "store").rglob("*.lock"))
    assert command(folder, "verify") == 0


def test_gc_without_reports_frees_nothing(kept, capsys):
    folder, needed, idle = kept
    (folder / "reports" / "one" / "provenance.json").write_text("{")
    assert command(folder, "gc", "--older", "0", "--yes") == 2
    assert main(["gc", "--store", str(folder / "store"), "--reports", str(folder / "none"), "--yes"]) == 2
    assert there(folder) == {needed.key, idle.key}


def test_verify_finds_a_flipped_bit_a_missing_file_and_a_broken_description(kept, capsys):
    folder, needed, idle = kept
    assert command(folder, "verify") == 0
    assert "2 artefacts read, 0 damaged" in capsys.readouterr().out
    file = folder / "store" / "make" / needed.key / "out.safetensors"
    data = bytearray(file.read_bytes())
    data[-1] ^= 1
    file.write_bytes(bytes(data))
    assert command(folder, "verify") == 2
    said = capsys.readouterr().out
    assert f"damaged: make/{needed.key}" in said
    assert idle.key not in said
    file.unlink()
    (folder / "store" / "make" / idle.key / "meta.json").write_text("{")
    assert command(folder, "verify") == 2
    assert "2 artefacts read, 2 damaged" in capsys.readouterr().out


def test_without_a_store(tmp_path, capsys):
    assert main(["ls", "--store", str(tmp_path / "none")]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert not (tmp_path / "none").exists()


def test_gc_beside_runs_breaks_no_lock(tmp_path):
    """Four writers count in a file that only the lock guards, while lock files are removed all the time."""
    store, counter, ended = Store(tmp_path / "store"), tmp_path / "count", threading.Event()
    counter.write_text("0")

    def count() -> None:
        for _ in range(6):
            with Store(store.path).lock("stage", "k"):
                seen = int(counter.read_text())
                time.sleep(0.0005)
                counter.write_text(str(seen + 1))

    def sweep() -> None:
        while not ended.is_set():
            store.sweep_locks()
            time.sleep(0.002)

    with ThreadPoolExecutor(5) as pool:
        sweeping, writers = pool.submit(sweep), [pool.submit(count) for _ in range(4)]
        failures = [writer.exception(timeout=60) for writer in writers]
        ended.set()
        sweeping.result(timeout=60)
    assert failures == [None] * 4
    assert counter.read_text() == "24"
    store.sweep_locks()
    assert not list(store.path.rglob("*.lock"))
