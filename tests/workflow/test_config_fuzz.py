"""Whatever is typed, the command ends with status 0 or with 2 and one line: never with a traceback."""

from __future__ import annotations

import contextlib
import copy
import io
import typing
from functools import cache

from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from flows import config, run, schema
from tasks.errors import InputError

HARDLY = {"deadline": None, "derandomize": True, "suppress_health_check": list(HealthCheck)}
WORDS = st.text(st.characters(codec="utf-8", exclude_categories=("Cs",)), max_size=12)
PLAIN = st.one_of(
    st.none(), st.booleans(), st.integers(-(10**12), 10**12), st.floats(), WORDS, st.sampled_from(["???", "nan", "-1"])
)
VALUES = st.recursive(PLAIN, lambda inner: st.lists(inner, max_size=3) | st.dictionaries(WORDS, inner, max_size=3))


@cache
def composed() -> dict:
    """The default config of one case."""
    return config.expand(["sweep.datasets=null", "sweep.methods=null"])[0].config


def places(node: dict, before: tuple[str, ...] = ()) -> list[tuple[str, ...]]:
    """The path of every key, groups included."""
    found = []
    for name, value in node.items():
        found.append((*before, name))
        if isinstance(value, dict):
            found += places(value, (*before, name))
    return found


@settings(max_examples=200, **HARDLY)
@given(data=st.data())
def test_the_schema_takes_or_names_any_value_anywhere(data):
    changed = copy.deepcopy(composed())
    *groups, name = data.draw(st.sampled_from(places(changed)), label="key")
    node = changed
    for group in groups:
        node = node[group]
    if data.draw(st.booleans(), label="another key"):
        name = data.draw(WORDS, label="name")
    node[name] = data.draw(VALUES, label="value")
    said = ""
    try:
        schema.check(changed, schema.schema(changed, config.SWEEP))
    except InputError as error:
        said = str(error)
    assert "\n" not in said


def odd(kind: object) -> st.SearchStrategy:
    """Values at the edge of a type and beyond it."""
    if typing.get_origin(kind) in schema.UNIONS:
        return st.one_of(*(odd(member) for member in typing.get_args(kind)))
    if typing.get_origin(kind) is typing.Literal:
        return st.one_of(st.sampled_from(typing.get_args(kind)), WORDS)
    if typing.get_origin(kind) is list:
        return st.lists(odd(typing.get_args(kind)[0]), max_size=2)
    numbers = st.sampled_from([0, -1, 1, 2**63, -(2**64), 10**30, 10**400, 0.0, -0.5, 1e-320, 1e31, -1e308])
    beyond = st.sampled_from([float("nan"), float("inf"), float("-inf")])
    return {int: numbers | beyond, float: numbers | beyond, str: WORDS, bool: st.booleans()}.get(kind, st.none())


def finite(value: object) -> bool:
    """Whether every number is one that a stage can reckon with."""
    if isinstance(value, dict | list):
        return all(map(finite, value.values() if isinstance(value, dict) else value))
    if isinstance(value, float):
        return abs(value) <= schema.LARGEST
    return not isinstance(value, int) or abs(value) < 2**63


@settings(max_examples=200, **HARDLY)
@given(data=st.data())
def test_no_stage_is_given_a_number_that_is_none(data):
    changed = copy.deepcopy(composed())
    expected = schema.schema(changed, config.SWEEP)
    *groups, name = data.draw(st.sampled_from([p for p in places(changed) if leaf(expected, p)]), label="key")
    node = changed
    for group in groups:
        node = node[group]
    node[name] = data.draw(odd(leaf(expected, (*groups, name))), label="value")
    taken: dict = {}
    with contextlib.suppress(InputError):
        taken = schema.check(changed, schema.schema(changed, config.SWEEP))
    assert finite(taken)


def leaf(expected: object, path: tuple[str, ...]) -> object:
    """The type at a path; None for a group."""
    for name in path:
        expected = expected[name]
    return None if isinstance(expected, dict) else expected


KEYS = st.sampled_from(
    [
        *("bones.max_bones", "animate.k", "seed", "dataset", "method", "sweep.methods", "split.test", "report.name"),
        *("runner.workers", "runner", "store.path", "pipeline", "nothing", "bones", "sweep", "", "a.b.c", "+ablation"),
    ]
)
TYPED = st.one_of(
    st.builds("{}={}".format, KEYS, PLAIN),
    st.builds(
        "{}={}".format, KEYS, st.sampled_from(["[1,2]", "{a:1}", "${seed}", "1,2", "'", "[", "lbs", "null", "9" * 5000])
    ),
    WORDS.filter(lambda text: not text.startswith("-")),
)


@settings(max_examples=25, **HARDLY)
@given(overrides=st.lists(TYPED, min_size=1, max_size=2), multirun=st.booleans())
def test_any_command_line_ends_in_order(overrides, multirun):
    one = ["sweep.datasets=null"] if not any("sweep" in text for text in overrides) else []
    said = io.StringIO()
    with contextlib.redirect_stderr(said), contextlib.redirect_stdout(io.StringIO()):
        status = run.main([*(["-m"] if multirun else []), "--cfg", *one, *overrides])
    assert status in (0, 2)
    assert len(said.getvalue().strip().split("\n")) == 1
    assert bool(said.getvalue()) == (status == 2)
