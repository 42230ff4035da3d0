"""What a setting may be beyond its type, written beside it: the interval that a number lies in, and what must hold
between it and other settings of its group: ``Annotated[float, "[0, 1)", "low < high: below high"]``."""

from __future__ import annotations

import re
import typing
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from types import CodeType
from typing import Annotated

END = r"-?inf|-?\d+(?:\.\d*)?(?:e-?\d+)?"
INTERVAL = re.compile(rf"([\[(])({END}), ({END})([\])])")


@dataclass(frozen=True)
class Interval:
    """From low to high; a round bracket leaves that end out."""

    low: float
    high: float
    with_low: bool
    with_high: bool

    @staticmethod
    @cache
    def of(text: str) -> Interval:
        """An interval as mathematics writes it. Raises ValueError for another text, or an empty interval."""
        found = INTERVAL.fullmatch(text)
        if not found:
            raise ValueError(f"{text!r} is no interval such as '[0, 1)' or '(0, inf)'")
        opens, low, high, closes = found.groups()
        if not float(low) < float(high):
            raise ValueError(f"the interval {text!r} is empty")
        return Interval(float(low), float(high), opens == "[", closes == "]")

    def __contains__(self, number: float) -> bool:
        above = number >= self.low if self.with_low else number > self.low
        return above and (number <= self.high if self.with_high else number < self.high)

    def __str__(self) -> str:
        """In words, for an error."""
        low, high = f"{self.low:.10g}", f"{self.high:.10g}"
        if self.with_low and self.with_high:
            return f"{low} to {high}"
        above = f"{low} or more" if self.with_low else f"above {low}"
        below = f"at most {high}" if self.with_high else f"below {high}"
        ends = [above] * (self.low != float("-inf")) + [below] * (self.high != float("inf"))
        return " and ".join(ends)


@dataclass(frozen=True)
class Relation:
    """A condition on the settings of a group, as Python writes it, and what it says in words for an error."""

    holds: CodeType
    words: str

    @staticmethod
    @cache
    def of(text: str) -> Relation:
        """From ``"condition: words"``. Raises ValueError for another text."""
        condition, colon, words = text.partition(": ")
        try:
            return Relation(compile(condition, "<relation>", "eval"), words if colon else "")
        except SyntaxError as error:
            raise ValueError(f"{text!r} is no condition on settings: {error.msg}") from error

    def __call__(self, settings: dict[str, object]) -> bool:
        """Whether it holds for the settings, by their names."""
        return bool(eval(self.holds, {"__builtins__": {}, "len": len, "set": set}, settings))

    def others(self, name: str) -> list[str]:
        """The settings that it is about, beside one."""
        return [other for other in self.holds.co_names if other not in (name, "len", "set")]


def interval(kind: object) -> Interval | None:
    """The interval in the annotation of a number."""
    return next((Interval.of(text) for text in kind.__metadata__ if not _is_relation(text)), None)


def relations(kind: object) -> Iterator[Relation]:
    """The relations in a type, at any depth."""
    if typing.get_origin(kind) is Annotated:
        yield from (Relation.of(text) for text in kind.__metadata__ if _is_relation(text))
        yield from relations(kind.__origin__)
    else:
        for member in typing.get_args(kind):
            yield from relations(member)


def _is_relation(text: str) -> bool:
    return ": " in text
