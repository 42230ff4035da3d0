"""README's tables are those that the committed reports make."""

from __future__ import annotations

import re
import shutil

import pytest

from flows import readme, schema, source
from flows.source import ROOT
from tasks.errors import InputError
from tests.analytic import planted

README = (ROOT / "README.md").read_text("utf-8")


def test_readme_says_what_the_reports_say():
    """After new reports: python -m flows.readme."""
    assert readme.filled(README, ROOT / "reports") == README


def test_a_wrong_number_is_put_right_and_the_prose_stays(tmp_path):
    line = next(line for line in README.splitlines() if line.startswith("| PartMM+ (residual"))
    value = line.split("|")[2].split()[0]
    wrong = README.replace(line, line.replace(value, "12.3", 1)).replace("## Licence", "## Terms")
    shutil.copytree(ROOT / "reports", tmp_path / "reports", ignore=shutil.ignore_patterns("figures", "export"))
    file = tmp_path / "README.md"
    file.write_text(wrong, "utf-8")
    assert readme.main([str(file)]) == 0
    assert file.read_text("utf-8") == README.replace("## Licence", "## Terms")


def test_the_readmes_method_is_found_and_answers_poses(tmp_path, monkeypatch):
    code = next(block for block in re.findall(r"```python\n(.*?)```", README, re.DOTALL) if "def animate(" in block)
    module = tmp_path / "tasks" / "methods" / "mine.py"
    module.parent.mkdir(parents=True)
    module.write_text(code)
    monkeypatch.setattr(source, "ROOT", tmp_path)
    for cached in (source.signature, source._source, source._tree):
        cached.cache_clear()
    assert schema.animate_function("mine") == "tasks.methods.mine:animate"
    assert list(schema.settings("tasks.methods.mine:animate")) == ["strength"]
    module.write_text("def other():\n    pass\n")
    source._source.cache_clear()
    with pytest.raises(InputError, match=r"tasks/methods/mine\.py without a function animate"):
        schema.animate_function("mine")
    for cached in (source.signature, source._source, source._tree):
        cached.cache_clear()
    made: dict = {}
    exec(code, made)
    training, query = planted.training([planted.gesture(30, 1)]), planted.poses([planted.gesture(12, 2)])
    assert made["animate"](training, query, strength=1.0).points.shape == (12, *training.canonical.points.shape)


def test_what_is_not_there_is_one_line(tmp_path, capsys):
    with pytest.raises(InputError, match=r"a table with the head 'RMSE \[mm\]'"):
        readme.filled("# Nothing\n", ROOT / "reports")
    file = tmp_path / "README.md"
    file.write_text(README, "utf-8")
    assert readme.main([str(file)]) == 2
    assert capsys.readouterr().err.count("\n") == 1
