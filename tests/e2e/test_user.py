"""The whole thing as a user: the command line on a small real file, twice, interrupted, in parallel, with bad input."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import time

import numpy as np
import pandas as pd
import pytest

from flows.source import ROOT
from tasks.reporting.rows import COLUMNS
from tests.e2e.conftest import Run

pytestmark = pytest.mark.slow


def table3(file, *more: str) -> tuple[str, ...]:
    methods = "sweep.methods=[lbs,fullmm,partmm]"
    return ("+experiment=table3", "dataset=mesh_sequence", f"dataset.path={file}", methods, "bones.max_bones=6", *more)


def stages(done: subprocess.CompletedProcess, how: str) -> set[str]:
    """Names of the stages that the output says were computed, cached or failed."""
    lines = [line.split("]", 1)[1].split() for line in done.stdout.splitlines() if line.startswith("[")]
    return {words[1] for words in lines if words[0] == how}


def test_table_files_cache_and_change_of_one_setting(user, worm_file):
    first = user(*table3(worm_file))
    report = user.folder / "reports" / "table3"
    assert "36 of 36 stages computed" in first.stdout
    assert stages(first, "cached") == set()
    for name in ("metrics.csv", "table.md", "table.tex", "table.html", "provenance.json"):
        assert (report / name).stat().st_size > 0
    assert "substitute" in (report / "table.md").read_text()
    assert len(list((report / "figures").iterdir())) == 8

    rows = pd.read_csv(report / "metrics.csv", keep_default_na=False)
    assert tuple(rows) == COLUMNS
    assert set(rows["method"]) == {"lbs", "fullmm", "partmm"}
    values = rows.set_index(["method", "metric"])["value"]
    for method in ("lbs", "fullmm", "partmm"):
        assert 0 < values[method, "rmse_pct"] < 10
        assert values[method, "rmse"] == pytest.approx(values[method, "rmse_coordinate"] * np.sqrt(3))
        assert values[method, "bones_rmse_pct"] < 1

    origin = json.loads((report / "provenance.json").read_text())
    assert origin["inputs"].keys() == {"worm.npz"}
    assert {s["how"] for s in origin["stages"]} == {"computed"}
    assert all(s["seconds"] >= 0 and s["peak_mb"] > 0 for s in origin["stages"])
    assert str(user.folder) not in (report / "provenance.json").read_text()

    before = (report / "metrics.csv").read_bytes()
    second = user(*table3(worm_file))
    assert "nothing was computed" in second.stdout
    assert stages(second, "computed") == set()
    assert (report / "metrics.csv").read_bytes() == before

    third = user(*table3(worm_file, "animate.k=3"))
    assert stages(third, "computed") == {"animate", "evaluate", "figures", "video"}


def test_bad_input_is_one_line_and_overwrites_nothing(user, worm_file):
    report = user.folder / "reports" / "table3"
    report.mkdir(parents=True)
    (report / "metrics.csv").write_text("the earlier report")
    broken = user.folder / "broken.npz"
    broken.write_bytes(worm_file.read_bytes()[:1000])
    still = user.folder / "still.npz"
    np.savez(still, vertices=np.ones((5, 4, 3), np.float32), faces=np.array([[0, 1, 2]]))
    for file in (user.folder / "absent.npz", broken, still):
        done = user(*table3(file), status=2)
        said = done.stderr.strip().splitlines()
        assert len(said) == 1, done.stderr
        assert said[0].startswith("error: ")
        assert file.stem in said[0]
        assert "expected" in said[0]
    assert (report / "metrics.csv").read_text() == "the earlier report"


def test_too_few_frames_for_a_patch(user):
    rng = np.random.default_rng(0)
    points = rng.normal(size=(3, 30, 3)).astype(np.float32)
    file = user.folder / "short.npz"
    np.savez(file, vertices=points, faces=np.array([[0, 1, 2]]))
    done = user(*table3(file), status=2)
    assert len(done.stderr.strip().splitlines()) == 1, done.stderr


def test_killed_in_mid_stage_and_resumed(user, worm_file):
    undisturbed = Run(user.folder / "calm", user.environment["PREFECT_API_URL"])
    undisturbed.folder.mkdir()
    undisturbed(*table3(worm_file))
    for wait in ("split", "clusters", "curve"):
        run = user.start(*table3(worm_file))
        for line in run.stdout:
            if f" {wait} " in line:
                break
        time.sleep(0.3)
        run.send_signal(signal.SIGKILL)
        run.wait()
    done = user(*table3(worm_file))
    assert {"dataset", "split"} <= stages(done, "cached")
    assert user.leftovers() == []
    calm, resumed = (r.folder / "reports" / "table3" / "metrics.csv" for r in (undisturbed, user))
    assert resumed.read_bytes() == calm.read_bytes()


def test_four_sweeps_at_once_in_one_store(user, worm_file):
    runs = [user.start(*table3(worm_file, f"report.name=run{i}")) for i in range(4)]
    outputs = [run.communicate(timeout=600)[0] for run in runs]
    assert [run.returncode for run in runs] == [0, 0, 0, 0], outputs
    metrics = [(user.folder / "reports" / f"run{i}" / "metrics.csv").read_text() for i in range(4)]
    assert len({text.replace(f"run{i}", "run") for i, text in enumerate(metrics)}) == 1
    computed = [int(n) for text in outputs for n in re.findall(r"^(\d+) of \d+ stages computed", text, re.M)]
    assert sum(computed) == len(_metas(user))  # every stage once, whoever got there first


def _metas(user: Run) -> list[str]:
    return [p.read_text() for p in (user.folder / "store").rglob("meta.json")]


@pytest.mark.skipif(os.name != "posix" or os.geteuid() != 0, reason="mounting a small disk needs root")
@pytest.mark.parametrize(("options", "words"), [("size=200k", "full"), ("size=10m,ro", "read-only")])
def test_a_full_or_read_only_store(user, worm_file, options, words):
    disk = user.folder / "disk"
    disk.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", options, "tmpfs", str(disk)], check=False).returncode:
        pytest.skip("no mounting here")
    try:
        done = user(*table3(worm_file, f"store.path={disk}/store"), status=2)
    finally:
        subprocess.run(["umount", str(disk)], check=True)
    said = done.stderr.strip().splitlines()
    assert len(said) == 1
    assert words in said[0]


def test_without_a_server_one_is_started_and_ends_with_the_run(tmp_path, worm_file):
    alone = Run(tmp_path, None)
    alone.environment.pop("PREFECT_API_URL", None)
    alone.environment["PREFECT_HOME"] = str(tmp_path / "prefect")
    run = alone.start(*table3(worm_file, "report.figures=false"))
    for line in run.stdout:
        if " split " in line:
            break
    children = _children(run.pid)
    assert any("flows.server" in command for command in children.values())
    run.send_signal(signal.SIGKILL)
    run.wait()
    for _ in range(50):
        alive = [pid for pid in children if _alive(pid)]
        if not alive:
            return
        time.sleep(0.2)
    pytest.fail(f"still running after the run was killed: {[children[pid] for pid in alive]}")


def test_a_run_outlives_its_own_server(tmp_path, small_file):
    alone = Run(tmp_path, None)
    alone.environment.pop("PREFECT_API_URL", None)
    alone.environment["PREFECT_HOME"] = str(tmp_path / "prefect")
    run = alone.start(*table3(small_file, "report.figures=false", "sweep.methods=[lbs]"))
    for line in run.stdout:
        if " split " in line:
            break
    (server,) = (pid for pid, command in _children(run.pid).items() if "flows.server" in command)
    os.kill(server, signal.SIGKILL)
    rest = run.communicate(timeout=150)[0]
    assert run.returncode == 0, rest
    assert "does not answer" in rest
    assert (tmp_path / "reports" / "table3" / "metrics.csv").exists()


def _children(pid: int) -> dict[int, str]:
    import psutil

    return {p.pid: " ".join(p.cmdline()) for p in psutil.Process(pid).children(recursive=True)}


def _alive(pid: int) -> bool:
    import psutil

    return psutil.pid_exists(pid) and psutil.Process(pid).status() != psutil.STATUS_ZOMBIE


def test_the_readmes_lines_for_a_notebook_give_the_numbers_of_a_run(user, small_file):
    one = ["dataset=mesh_sequence", f"dataset.path={small_file}", "method=partmm", "animate.k=5"]
    user(*one, "sweep.datasets=null", "sweep.methods=null", "report.figures=false")
    rows = pd.read_csv(user.folder / "reports" / "quick" / "metrics.csv").set_index("metric")["value"]
    (lines,) = re.findall(
        r"```python\n(from flows\.notebook.*?)```", (ROOT / "README.md").read_text("utf-8"), re.DOTALL
    )
    found: dict = {}
    exec(lines.replace("dataset.path=FILE.npz", f"dataset.path={small_file}"), found)
    scores = found["scores"]
    assert dict(zip(scores.names, scores.values, strict=True)) == {name: rows[name] for name in scores.names}
