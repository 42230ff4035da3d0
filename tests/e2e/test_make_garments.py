"""The garments made again as a user does it: a coarse, short run, killed and taken up again."""

from __future__ import annotations

import importlib.util
import signal
import time
from pathlib import Path

import pytest

from tasks.datasets import garments
from tasks.garments import body


@pytest.mark.slow
@pytest.mark.skipif(
    any(importlib.util.find_spec(m) is None for m in body.EXTRA) or not Path("~/.cache/anny").expanduser().is_dir(),
    reason="needs the extra `garments`, and Anny started once before, which takes minutes",
)
def test_a_tiny_run_killed_and_resumed(user):
    """The whole experiment, coarse and short."""
    tiny = ["make.only=[walk]", "make.frames=3", "make.cut.tshirt.edge=0.07", "make.simulate.substeps=4"]
    tiny += ["make.dressing.frames=4", "make.dressing.hold=2", "sweep.datasets=[garments_tshirt]"]
    run = user.start("+experiment=make_garments", *tiny)
    while run.poll() is None and len(list(user.folder.glob("store/simulate/*.part/0000[3-9].npy"))) == 0:
        time.sleep(0.05)
    run.send_signal(signal.SIGKILL)
    run.wait()
    assert list(user.folder.glob("store/simulate/*.part/*.npy"))
    user("+experiment=make_garments", *tiny)
    assert not list(user.folder.glob("store/simulate/*.part"))
    made = user.folder / "reports" / "make_garments" / "garments"
    assert {p.name for p in made.iterdir()} == {"body.npz", "tshirt.npz", "manifest.json"}
    assert garments.load(garment="tshirt", path=str(made), weights="robust").frames == 3
