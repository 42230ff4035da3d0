"""Scenes rendered as a user does it, and read again as images."""

from __future__ import annotations

import pytest

from tasks.captures import dnerf


@pytest.mark.slow
def test_a_scene_is_rendered_beside_its_report_and_read_again(user, worm_file):
    tiny = ["scene.size=40", "scene.views=8", "scene.test_views=3", "scene.samples=1"]
    run = ["+experiment=make_scenes", "dataset=mesh_sequence", f"dataset.path={worm_file}", *tiny]
    user(*run)
    report = user.folder / "reports" / "make_scenes"
    (folder,) = (p.parent for p in report.rglob("transforms_train.json"))
    train, test = dnerf.load(path=str(folder), size=None, background="none", up="z", fps=1.0, unit="unit")
    assert (train.images.shape, test.images.shape) == ((8, 40, 40, 4), (3, 40, 40, 4))
    assert "on_subject_pct" in (report / "metrics.csv").read_text()
    assert list((report / "figures").glob("*scene.png"))
    again = user(*run)
    assert "computed " not in again.stdout.replace("0 of", "")
    moved = user("+experiment=make_scenes", "dataset=dnerf", f"dataset.path={folder}", status=2)
    assert "dnerf holds images" in moved.stderr
