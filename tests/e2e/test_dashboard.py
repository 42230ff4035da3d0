"""The dashboard in a real browser: the page of a run, its graph, its table and figures, and what it says of a failure.

The screenshots stay in tests/output.
"""

from __future__ import annotations

import json
import os
import re
import shlex
import signal
import subprocess
import sys
import urllib.request
from collections.abc import Iterator

import numpy as np
import pytest

from flows.source import ROOT
from tests.e2e.browser import Page, browser, executable
from tests.e2e.conftest import Run

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(executable() is None, reason="no Chromium on this machine (Debian's package is chromium)"),
]
SHOTS = ROOT / "tests" / "output"
STARTED = re.compile(r"dashboard\s+(http://127\.0\.0\.1:\d+)$", re.M)


class Dashboard:
    """A dashboard that runs, and its API."""

    def __init__(self, home, child: subprocess.Popen) -> None:
        self.home, self.child = home, child
        self.said = ""
        for line in child.stdout:
            self.said += line
            if line.startswith("stop"):
                break
        self.pages = STARTED.search(self.said).group(1)

    def ask(self, path: str, **body: object):
        data = json.dumps(body).encode() if body else None
        request = urllib.request.Request(f"{self.pages}/api{path}", data, {"Content-Type": "application/json"})
        with urllib.request.urlopen(request, timeout=30) as answer:
            return json.load(answer)

    def last_run(self) -> dict:
        return self.ask("/flow_runs/filter", sort="START_TIME_DESC", limit=1)[0]

    def artifacts(self, run: dict) -> dict[str, dict]:
        of_run = {"artifacts": {"flow_run_id": {"any_": [run["id"]]}}}
        return {a["key"]: a for a in self.ask("/artifacts/filter", **of_run) if a["key"]}


def start(home) -> subprocess.Popen:
    environment = os.environ | {"PREFECT_HOME": str(home), "PYTHONPATH": str(ROOT)}
    environment.pop("PREFECT_API_URL", None)
    return subprocess.Popen(
        [sys.executable, "-m", "flows.dashboard"],
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def user_of(folder, dashboard: Dashboard) -> Run:
    """A user who exports nothing: runs find the dashboard by themselves."""
    folder.mkdir()
    user = Run(folder, None)
    user.environment.pop("PREFECT_API_URL", None)
    user.environment["PREFECT_HOME"] = str(dashboard.home)
    return user


@pytest.fixture(scope="module")
def dashboard(tmp_path_factory) -> Iterator[Dashboard]:
    home = tmp_path_factory.mktemp("home")
    child = start(home)
    try:
        yield Dashboard(home, child)
    finally:
        child.terminate()
        child.wait(30)


@pytest.fixture(scope="module")
def page(tmp_path_factory) -> Iterator[Page]:
    with browser(tmp_path_factory.mktemp("profile")) as opened:
        yield opened


def show(page: Page, name: str, address: str, *texts: str) -> None:
    """Opens a page, waits for what it should say, and keeps a picture of it."""
    page.open(address)
    page.wait_for_text(*texts)
    page.evaluate("new Promise(done => setTimeout(done, 3000))")  # the graph finds its place, pictures fade in
    page.screenshot(SHOTS / f"{name}.png")


def small_lbs(file) -> tuple[str, ...]:
    data = ("dataset=mesh_sequence", f"dataset.path={file}")
    return ("+experiment=table3", *data, "sweep.methods=[lbs]", "bones.max_bones=4")


def test_a_run_on_its_page(dashboard, page, tmp_path_factory, small_file):
    user = user_of(tmp_path_factory.mktemp("u") / "user", dashboard)
    user(*small_lbs(small_file))
    run = dashboard.last_run()
    assert run["state_type"] == "COMPLETED"
    address = f"{dashboard.pages}/v2/runs/flow-run/{run['id']}"
    show(page, "run", address, "table3", "Completed", "Finished in state Completed()")

    nodes = dict(dashboard.ask(f"/flow_runs/{run['id']}/graph-v2")["nodes"])
    names = {node["label"]: node for node in nodes.values()}
    assert {"curve: mesh_sequence small lbs", "poses, unseen: mesh_sequence small lbs"} <= names.keys()
    parents = {nodes[p["id"]]["label"].split(":")[0] for p in names["bones: mesh_sequence small lbs"]["parents"]}
    assert parents == {"split", "canonical", "clusters"}
    assert page.evaluate("document.querySelector('canvas').width > 300")

    show(
        page,
        "tasks",
        f"{address}?tab=TaskRuns",
        "skeleton: mesh_sequence small lbs",
        "evaluate: mesh_sequence small lbs",
    )
    found = dashboard.artifacts(run)
    assert found["table3-progress"]["data"] == found["table3-progress-evaluate"]["data"] == 100.0
    assert re.fullmatch(r"evaluate, \d to do", found["table3-progress-evaluate"]["description"])
    show(page, "artifacts", f"{address}?tab=Artifacts", "all stages", "tables of table3")

    rows = (user.folder / "reports" / "table3" / "table.md").read_text()
    error = next(line.split("|")[2].strip(" *") for line in rows.splitlines() if line.startswith("| LBS"))
    table = f"{dashboard.pages}/v2/artifacts/artifact/{found['table3-table']['id']}"
    show(page, "table", table, "Table 3, unseen clips", "FullMM", "PartMM", error)

    figure = found["table3-mesh-sequence-small-errors"]
    show(page, "figure", f"{dashboard.pages}/v2/artifacts/artifact/{figure['id']}", "mesh sequence small errors")
    page.wait("[...document.images].some(i => i.src.startsWith('data:image/png') && i.naturalWidth > 500)")

    user(*small_lbs(small_file), "evaluate.turn=6")
    again = dashboard.last_run()
    address = f"{dashboard.pages}/v2/runs/flow-run/{again['id']}"
    show(page, "cached", f"{address}?tab=TaskRuns", "Cached")  # which are, the server tells below
    tasks = dashboard.ask("/task_runs/filter", task_runs={"flow_run_id": {"any_": [again["id"]]}})
    assert {t["state_name"] for t in tasks if t["name"].startswith("bones:")} == {"Cached"}
    assert {t["state_name"] for t in tasks if t["name"].startswith("evaluate rig")} == {"Completed"}


def test_a_failure_says_what_for_which_case_and_how_to_run_it_again(dashboard, page, tmp_path):
    still = tmp_path / "still one.npz"
    np.savez(still, vertices=np.ones((5, 4, 3), np.float32), faces=np.array([[0, 1, 2]]))
    user = user_of(tmp_path / "user", dashboard)
    done = user("+experiment=table3", "dataset=mesh_sequence", f"dataset.path='{still}'", "seed=3", status=2)
    run = dashboard.last_run()
    assert run["state_type"] == "FAILED"
    (failure,) = (a for k, a in dashboard.artifacts(run).items() if "failed" in k)
    command = re.search(r"```\n(python -m flows.run .*)\n```", failure["data"]).group(1)
    why = done.stderr.strip().removeprefix("error: ")
    address = f"{dashboard.pages}/v2/runs/flow-run/{run['id']}"
    show(
        page, "failed", address, "Failed", "run it alone: python -m flows.run", "seed=3", "mesh_sequence still one lbs"
    )
    show(page, "failure", f"{dashboard.pages}/v2/artifacts/artifact/{failure['id']}", "dataset failed", why, command)

    again = user(*shlex.split(command)[3:], status=2)
    assert again.stderr == done.stderr
    assert not (user.folder / "reports" / "table3").exists()


def test_pages_talk_to_nobody_else(dashboard, page):
    """Prefect's pages ask for the settings of a tracker, unless they are kept from it."""
    page.call("Network.enable")
    page.sent.clear()
    page.open(dashboard.pages)
    page.wait_for_text("Flow Runs")
    page.evaluate("new Promise(done => setTimeout(done, 2000))")
    elsewhere = {number for number, url in page.sent.items() if "127.0.0.1" not in url and url.startswith("http")}
    assert page.sent
    assert elsewhere <= page.blocked


def test_a_run_outlives_the_dashboard(tmp_path, small_file):
    home = tmp_path / "home"
    dashboard = Dashboard(home, start(home))
    user = user_of(tmp_path / "user", dashboard)
    run = user.start(*small_lbs(small_file))
    for line in run.stdout:
        if " split " in line:
            break
    dashboard.child.send_signal(signal.SIGKILL)
    dashboard.child.wait()
    rest = run.communicate(timeout=150)[0]
    assert run.returncode == 0, rest
    assert "does not answer" in rest
    assert (user.folder / "reports" / "table3" / "metrics.csv").exists()
    done = user(*small_lbs(small_file))  # the note is still there and points nowhere
    assert "nothing was computed" in done.stdout


def test_a_second_dashboard_shows_the_first(dashboard):
    child = start(dashboard.home)
    said = child.communicate(timeout=60)[0]
    assert said.strip() == f"a dashboard runs already: {dashboard.pages}"
