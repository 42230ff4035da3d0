"""Faults: killed workers, clocks that go back, flipped bits, and pickles planted where files are read."""

from __future__ import annotations

import ast
import contextlib
import hashlib
import json
import os
import pickle
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from flows.cache import CorruptArtefact, Store
from flows.source import ROOT
from flows.stage import SPENT, run
from tasks.errors import InputError
from tasks.values import Animation, same
from tests.workflow.killed import CHAINS, KILLS
from tests.workflow.test_sweep import World, job


def contents(store: Path) -> dict[str, str]:
    """Digest of every file of a store; of a meta.json only what does not say how long something took."""
    found = {}
    for path in sorted(p for p in store.rglob("*") if p.is_file()):
        data = path.read_bytes()
        if path.name == "meta.json":
            meta = json.loads(data)
            data = json.dumps({k: v for k, v in meta.items() if k not in ("seconds", "peak_mb")}).encode()
        found[str(path.relative_to(store))] = hashlib.sha256(data).hexdigest()
    return found


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="kill -9 is POSIX's")
def test_fifty_kills_leave_what_an_undisturbed_run_leaves(tmp_path):
    def killed(name: str, times: int) -> list[int]:
        command = [sys.executable, "-m", "tests.workflow.killed", str(tmp_path / name), str(times)]
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300, check=True)
        return [int(word) for word in done.stdout.split()]

    assert killed("calm", 0)[0] == 0
    hit, states, leftovers = killed("killed", KILLS)
    assert hit == KILLS  # every worker was still at work
    assert states > KILLS / 4  # and they were killed all along the way
    assert leftovers <= 1  # what one leaves, the next wipes
    calm = contents(tmp_path / "calm")
    assert len([name for name in calm if name.endswith("meta.json")]) == 3 * CHAINS
    assert contents(tmp_path / "killed") == calm


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="kill -9 is POSIX's")
def test_a_killed_fit_goes_on_and_ends_with_the_same_bits(tmp_path):
    """Killed twice in the middle of its steps, wherever it is some time after it has kept its state."""

    def start(name: str) -> subprocess.Popen:
        return subprocess.Popen([sys.executable, "-m", "tests.workflow.killed_fit", str(tmp_path / name)], cwd=ROOT)

    def kept() -> list[int]:
        """When the killed fit has last kept its state, if ever."""
        return [path.stat().st_mtime_ns for path in (tmp_path / "killed").rglob("fit.safetensors")]

    assert start("calm").wait(300) == 0
    shutil.copytree(tmp_path / "calm", tmp_path / "killed", ignore=shutil.ignore_patterns("gaussians"))
    moment, last, spent = random.Random(0), [], []
    for _ in range(2):
        worker = start("killed")
        while kept() == last:  # until it has gone on from where the one before was killed
            assert worker.poll() is None
            time.sleep(0.01)
        time.sleep(moment.uniform(0.0, 0.5))
        worker.kill()
        assert worker.wait() == -signal.SIGKILL
        last = kept()
        (file,) = (tmp_path / "killed").rglob(SPENT)
        spent.append(float(file.read_text("utf-8")))
    assert start("killed").wait(300) == 0
    assert contents(tmp_path / "killed") == contents(tmp_path / "calm")
    (meta,) = (tmp_path / "killed" / "gaussians").rglob("meta.json")
    spent.append(json.loads(meta.read_text("utf-8"))["seconds"])
    assert 0.0 < spent[0] < spent[1] < spent[2]  # every part goes on counting where the one before was killed


@pytest.mark.parametrize("shift", [-1e9, 1e9], ids=["back", "forward"])
def test_a_clock_that_jumps_changes_nothing(tmp_path, monkeypatch, shift):
    first = run(job(tmp_path))
    now = time.time()
    for path in (tmp_path / "store").rglob("*"):
        os.utime(path, (now - shift, now - shift))
    monkeypatch.setattr(time, "time", lambda: now + shift)
    again = run(job(tmp_path))
    assert again.cached
    assert again.outputs == first.outputs
    stale = tmp_path / "store" / "make" / f"{first.key}.tmp"
    stale.mkdir()
    Store(tmp_path / "store").drop("make", first.key)
    assert run(job(tmp_path)).outputs == first.outputs
    assert not stale.exists()


def test_any_flipped_bit_is_noticed_or_harmless(tmp_path):
    store = Store(tmp_path)
    value = Animation(np.arange(60, dtype=np.float32).reshape(2, 10, 3))
    with store.lock("stage", "k"):
        ref = store.put("stage", "k", {"out": value}, {"seconds": 1.0, "peak_mb": 2.0})
    rng = np.random.default_rng(0)
    for name in ("out.safetensors", "meta.json"):
        file = tmp_path / "stage" / "k" / name
        whole = file.read_bytes()
        for place in rng.integers(8 * len(whole), size=200):
            data = bytearray(whole)
            data[place // 8] ^= 1 << (place % 8)
            file.write_bytes(bytes(data))
            if name == "out.safetensors":
                with pytest.raises(CorruptArtefact):
                    store.load(ref, "out")
            elif (found := store.find("stage", "k")) is not None:
                with contextlib.suppress(CorruptArtefact):
                    assert same(store.load(found, "out"), value)  # the flip was in a number that nothing hangs on
        file.write_bytes(whole)


# No pickle from a file. What may unpickle is one reader with an allow-list of its own.

ALLOWED = {"tasks/datasets/unpickle.py"}


def unsafe(tree: ast.AST) -> list[str]:
    """Calls and imports of a source that can run code out of a file."""
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import | ast.ImportFrom):
            names = [a.name for a in node.names] + [getattr(node, "module", "") or ""]
            found += [n for n in names if n.split(".")[0] in ("pickle", "joblib", "dill", "cloudpickle", "shelve")]
        if isinstance(node, ast.Call):
            name = ast.unparse(node.func)
            keywords = {k.arg: ast.unparse(k.value) for k in node.keywords}
            if keywords.get("allow_pickle", "False") != "False" or name == "pandas.read_pickle":
                found.append(name)
            if name in ("torch.load", "torch.jit.load") and keywords.get("weights_only") != "True":
                found.append(name)
    return found


def test_no_source_reads_a_pickle():
    sources = [p for folder in ("flows", "tasks") for p in (ROOT / folder).rglob("*.py")]
    found = {str(p.relative_to(ROOT)): unsafe(ast.parse(p.read_text("utf-8"))) for p in sources}
    assert {name for name, calls in found.items() if calls} == ALLOWED
    for wrong in ("import pickle", "from joblib import load", "np.load(f, allow_pickle=True)", "torch.load(f)"):
        assert unsafe(ast.parse(wrong))


class Thief:
    """Makes a file when it is unpickled."""

    def __init__(self, mark: Path) -> None:
        self.mark = mark

    def __reduce__(self):
        return Path.touch, (self.mark,)


@pytest.fixture
def mark(tmp_path):
    """A file that exists once something planted was executed; it must not, though the plant works."""
    pickle.loads(pickle.dumps(Thief(tmp_path / "works")))
    assert (tmp_path / "works").exists()
    yield tmp_path / "stolen"
    assert not (tmp_path / "stolen").exists()


def test_a_pickle_for_an_artefact(tmp_path, mark):
    """Even one whose meta.json vouches for it."""
    ref = run(job(tmp_path))
    folder = Store(tmp_path / "store").folder("make", ref.key)
    planted = pickle.dumps(Thief(mark))
    (folder / "out.safetensors").write_bytes(planted)
    meta = json.loads((folder / "meta.json").read_text())
    meta["outputs"]["out"] |= {"bytes": len(planted), "digest": hashlib.sha256(planted).hexdigest()}
    (folder / "meta.json").write_text(json.dumps(meta))
    store = Store(tmp_path / "store")
    with pytest.raises(CorruptArtefact):
        store.load(store.find("make", ref.key), "out")


def planted_npz(path: Path, mark: Path, names: tuple[str, ...]) -> None:
    np.savez(path, **{name: np.array([Thief(mark)], dtype=object) for name in names})


def test_a_pickle_in_an_npz_of_a_dataset(tmp_path, mark):
    from tasks.datasets.mesh_sequence import load

    planted_npz(tmp_path / "a.npz", mark, ("vertices", "faces"))
    with pytest.raises(InputError, match="pickled Python objects"):
        load(path=str(tmp_path / "a.npz"), fps=24.0, faces=True, unit="m")
    (tmp_path / "b.npz").write_bytes(pickle.dumps(Thief(mark)))
    with pytest.raises(InputError):
        load(path=str(tmp_path / "b.npz"), fps=24.0, faces=True, unit="m")


def test_a_pickle_in_a_capture(tmp_path, mark):
    from tasks.captures.multiview import _arrays

    planted_npz(tmp_path / "skeleton.npz", mark, ("names", "parents", "joints", "rotations", "root"))
    with pytest.raises(InputError):
        _arrays(tmp_path / "skeleton.npz")


def test_a_pickle_for_a_checkpoint(tmp_path, mark):
    from tasks.reconstruction import checkpoint

    (tmp_path / checkpoint.FILE).write_bytes(pickle.dumps(Thief(mark)))
    assert checkpoint.load(tmp_path) is None  # the fit starts anew


def test_a_pickle_for_a_simulated_garment(tmp_path, mark):
    from tasks.datasets.unpickle import read_pickle

    for name, value in (("a", Thief(mark)), ("b", {"vertices": [np.ones(3), Thief(mark)]})):
        (tmp_path / name).write_bytes(pickle.dumps(value))
        with pytest.raises(InputError, match="never loaded"):
            read_pickle(tmp_path / name)


def test_prefect_keeps_no_results_that_could_be_planted(tmp_path, prefect_server, prefect_home, monkeypatch):
    world = World(tmp_path)
    before = {p for p in prefect_home.rglob("*") if "storage" in p.parts}
    world.run(world.graph(3.0))
    assert {p for p in prefect_home.rglob("*") if "storage" in p.parts} == before
    with monkeypatch.context() as patch:
        read: list[object] = []
        patch.setattr(pickle, "load", lambda file, **_: read.append(file))
        assert world.run(world.graph(3.0)).computed == set()
    assert read == []
