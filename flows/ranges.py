"""The range of a number, written as an interval beside its type: ``Annotated[float, "(0, 1]"]``."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cache

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
