"""Whatever is typed, the command ends with status 0 or with 2 and one line: never with a traceback."""

from __future__ import annotations

import contextlib
import copy
import functools
import io
import math
import typing

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from flows import config, ranges, run, schema
from tasks.errors import InputError

HARDLY = {"deadline": None, "derandomize": True, "suppress_health_check": list(HealthCheck)}
WORDS = st.text(st.characters(codec="utf-8", exclude_categories=("Cs",)), max_size=12)
PLAIN = st.one_of(
    st.none(), st.booleans(), st.integers(-(10**12), 10**12), st.floats(), WORDS, st.sampled_from(["???", "nan", "-1"])
)
VALUES = st.recursive(PLAIN, lambda inner: st.lists(inner, max_size=3) | st.dictionaries(WORDS, inner, max_size=3))


@functools.cache
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
    if typing.get_origin(kind) is typing.Annotated:
        return st.one_of(odd(kind.__origin__), *[st.sampled_from(beyond) for beyond in [outside(kind)] if beyond])
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


def outside(kind: object) -> list[object]:
    """Values of the right type just beyond what a type allows; none where it allows all."""
    if typing.get_origin(kind) in schema.UNIONS:
        return [value for member in typing.get_args(kind) for value in outside(member)]
    if typing.get_origin(kind) is list:
        return [[value] for value in outside(typing.get_args(kind)[0])]
    if typing.get_origin(kind) is not typing.Annotated:
        return []
    span, step = ranges.interval(kind), 1 if kind.__origin__ is int else 1e-9
    if span is None:
        return outside(kind.__origin__)
    below = [] if span.low == -math.inf else [span.low - step if span.with_low else span.low]
    above = [] if span.high == math.inf else [span.high + step if span.with_high else span.high]
    return [kind.__origin__(value) for value in below + above]


COMPOSED = {
    "quick": ["sweep.datasets=null", "sweep.methods=null"],
    **{f"method {name}": ["sweep.datasets=null", f"method={name}"] for name in ("mlp", "part_kernel", "bone_response")},
    "images": ["sweep.datasets=null", "dataset=scene_figure", "method=gaussians", "reconstruction=cpu"],
    "garments": ["+experiment=make_garments", "sweep.datasets=[garments_dress]"],
    **{f"benchmark {name}": [f"+experiment={name}"] for name in ("benchmark_matching", "benchmark_rasterizer")},
}


@pytest.mark.parametrize("overrides", COMPOSED.values(), ids=COMPOSED)
def test_every_range_is_refused_before_anything_is_computed(overrides):
    whole = config.expand([*overrides, "sweep.methods=null"])[0].config
    expected, tried = schema.schema(whole, config.SWEEP), 0
    for path in (p for p in places(whole) if known(expected, p)):
        for value in outside(leaf(expected, path)):
            changed = copy.deepcopy(whole)
            *groups, name = path
            functools.reduce(dict.__getitem__, groups, changed)[name] = value
            with pytest.raises(InputError) as caught:
                schema.check(changed, expected)
            said = str(caught.value)
            assert said.startswith(".".join(path)), said
            assert "\n" not in said
            tried += 1
    assert tried > 10


def known(expected: object, path: tuple[str, ...]) -> bool:
    """Whether the schema has a type for this path (lists of a config have none for their entries)."""
    try:
        return leaf(expected, path) is not None
    except (KeyError, TypeError):
        return False


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
