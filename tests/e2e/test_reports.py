"""Reports as a user meets them: made twice with equal bytes, compared, collected on one page, planned, cleaned up."""

from __future__ import annotations

import re
import subprocess
import sys

import pytest

from flows.shelf import made_again
from tests.e2e.conftest import Run
from tests.e2e.test_user import table3

pytestmark = pytest.mark.slow

METHODS = "sweep.methods=[lbs,partmm]"


def python(run: Run, *arguments: str, status: int = 0) -> str:
    """The output of ``python -m …`` in the user's folder."""
    command = [sys.executable, "-m", *arguments]
    done = subprocess.run(
        command, cwd=run.folder, env=run.environment, capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == status, done.stdout[-3000:] + done.stderr[-3000:]
    return done.stdout


def test_equal_bytes_one_page_a_plan_and_an_empty_store(user, worm_file):
    other = Run(user.folder / "other", user.environment["PREFECT_API_URL"])
    other.folder.mkdir()
    user(*table3(worm_file, METHODS))
    data = ("dataset=mesh_sequence", f"dataset.path={worm_file}", METHODS, "bones.max_bones=6")
    collected = ("+experiment=paper", "sweep.experiments=[table3,quick]", *data)
    planned = python(other, "flows.run", *collected, "plan=true")
    assert "2 reports" in planned
    assert not (other.folder / "store").exists()
    first = other(*collected)
    reports = other.folder / "reports"

    one, two = user.folder / "reports" / "table3", reports / "table3"
    assert (one / "metrics.csv").read_bytes() == (two / "metrics.csv").read_bytes()
    said = python(user, "flows.report", str(one), str(two))
    assert " 0 moved within a relative 0, 0 further" in said
    assert "configs, code, data and machine are the same" in said
    for name, content in made_again(two).items():
        assert (two / name).read_bytes() == content, name

    page = (reports / "index.html").read_text()
    assert str(reports / "index.html").endswith(re.findall(r"report in (\S+)", first.stdout)[-1])
    assert not re.findall(r'(?:src|href)="(?!data:|#)', page)  # nothing to load
    assert "python -m flows.run +experiment=table3 dataset=mesh_sequence dataset.path=worm.npz" in page
    assert "data:image/webp" in page  # the video and the pictures
    assert page.count("<section") == 3
    assert list((two / "figures").glob("*_video.webp"))

    assert "all" in python(other, "flows.run", *collected, "plan=true").splitlines()[-1]
    assert "0 damaged" in python(other, "flows.store", "verify")
    assert "0 artefacts that no report" in python(other, "flows.store", "gc", "--older", "0")
    (reports / "table3" / "provenance.json").unlink()
    (reports / "quick" / "provenance.json").unlink()
    python(other, "flows.store", "gc", "--older", "0", "--yes")
    assert not list((other.folder / "store").glob("*/*/meta.json"))
