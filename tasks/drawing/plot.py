"""Line charts as SVG text that reads on light and dark pages; no plotting library."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np

WIDTH, HEIGHT = 560, 340
LEFT, RIGHT, TOP, BOTTOM = 66, 18, 22, 48
COLOURS = ("#3b7dd8", "#e0772b", "#2f9e6e", "#c2456b", "#8a63c9", "#a98f1f", "#2ba6ba", "#8d5a3b")

_STYLE = """
.chart { font: 13px system-ui, sans-serif; color: #22252b; background: #fff; max-width: 100%;
  height: auto; border-radius: 6px }
.chart text { fill: currentColor }
.chart .grid { stroke: currentColor; stroke-opacity: .14 }
.chart .axis { stroke: currentColor; stroke-opacity: .6 }
.chart .mark { stroke: currentColor; stroke-opacity: .55; stroke-dasharray: 4 4 }
@media (prefers-color-scheme: dark) { .chart { color: #e6e8ec; background: #14171c } }
"""


@dataclass(frozen=True)
class Series:
    """One line. x, y: (n,) values; spread: (n,) half height of the band around it, or None."""

    name: str
    x: np.ndarray
    y: np.ndarray
    spread: np.ndarray | None = None


@dataclass(frozen=True)
class _Axis:
    """Takes values to pixels. start, stop: of the axis in pixels; logarithmic where ``log``."""

    low: float
    high: float
    start: float
    stop: float
    log: bool

    def __call__(self, value: float) -> float:
        low, high = (math.log10(v) if self.log else v for v in (self.low, self.high))
        at = math.log10(max(value, self.low)) if self.log else value
        return self.start + (at - low) / (high - low) * (self.stop - self.start)

    def ticks(self) -> list[float]:
        if self.log:
            decades = range(math.floor(math.log10(self.low)), math.ceil(math.log10(self.high)) + 1)
            steps = (1, 2, 5) if self.high / self.low < 1e3 else (1,)
            marks = [s * 10.0**d for d in decades for s in steps]
        else:
            step = round_up((self.high - self.low) / 6)
            marks = [
                i * step for i in range(math.ceil(self.low / step - 1e-9), math.floor(self.high / step + 1e-9) + 1)
            ]
        return [m for m in marks if self.low * (1 - 1e-9) <= m <= self.high * (1 + 1e-9)]


def round_up(value: float, steps: tuple[float, ...] = (1, 2, 2.5, 5, 10)) -> float:
    """The next of these steps times a power of ten; 1 for nothing."""
    if not value > 0:
        return 1.0
    power = 10.0 ** math.floor(math.log10(value))
    return next(step * power for step in steps if step * power >= value * (1 - 1e-9))


def lines(
    series: list[Series],
    *,
    x: str,
    y: str,
    log_x: bool = False,
    log_y: bool = False,
    marks: Sequence[tuple[float, str]] = (),
) -> str:
    """A chart of lines with points and bands. x, y: the axes' labels with units; log_x, log_y: logarithmic axes, which
    need positive values; marks: (value, words) of upright dashed lines. -> the text of an SVG."""
    xs, ys = (np.concatenate([np.asarray(v, float) for v in vs]) for vs in (_all_x(series), _all_y(series)))
    across = _axis(xs, LEFT, WIDTH - RIGHT, log_x, from_zero=False)
    up = _axis(ys, HEIGHT - BOTTOM, TOP, log_y, from_zero=True)
    parts = [*_frame(across, up, x, y)]
    parts += _marks([(across(value), words) for value, words in marks])
    for i, one in enumerate(series):
        parts += _line(one, across, up, *_look(i))
    width = WIDTH
    if len(series) > 1:
        parts += _names(series)
        width += 44 + int(7.2 * max(len(one.name) for one in series))
    return _svg(parts, HEIGHT, f"{y} against {x}", width)


def _marks(marks: list[tuple[float, str]]) -> list[str]:
    """Upright lines at these pixels with words beside them, a line lower where they would meet those before."""
    parts, free, level = [], 0.0, 0
    for at, words in marks:
        wide = 8 * len(words) + 6
        left = at + wide > WIDTH - RIGHT
        start = at - wide if left else at
        level = level + 1 if start < free else 0
        free = start + wide
        anchor, shift = ("end", -6) if left else ("start", 6)
        parts.append(f'<line class="mark" x1="{at:.1f}" x2="{at:.1f}" y1="{TOP}" y2="{HEIGHT - BOTTOM}"/>')
        y = TOP + 12 + 16 * level
        parts.append(f'<text x="{at + shift:.1f}" y="{y}" text-anchor="{anchor}">{escape(words)}</text>')
    return parts


def dots(rows: list[str], series: list[Series], *, x: str, zero: str = "") -> str:
    """A chart with one line of dots a row. rows: labels, top first; series: one colour each, ``x`` their values in the
    order of the rows (NaN where a row has none) and ``spread`` half widths of whiskers (``y`` is not used); x: the
    axis' label with unit; zero: words at an upright dashed line at nought, none for no line. -> the text of an SVG."""
    left = 24 + int(7.2 * max((len(row) for row in rows), default=0))
    head = TOP + 22 * (len(series) > 1)
    floor = head + 12 + 26 * len(rows)
    height = floor + BOTTOM
    values = [np.asarray(one.x, float) for one in series]
    reach = [
        v + side * one.spread
        for v, one in zip(values, series, strict=True)
        if one.spread is not None
        for side in (-1, 1)
    ]
    every = np.concatenate([*values, *reach, [0.0] if zero else []])
    across = _axis(every[np.isfinite(every)], left, WIDTH - RIGHT, False, from_zero=not zero)
    parts = _ruler(across, head, floor, (left + WIDTH - RIGHT) / 2, height, x)
    if zero:
        at = across(0.0)
        parts.append(f'<line class="mark" x1="{at:.1f}" x2="{at:.1f}" y1="{head}" y2="{floor}"/>')
        parts.append(f'<text x="{at + 6:.1f}" y="{floor - 6}" fill-opacity=".7">{escape(zero)}</text>')
    for r, row in enumerate(rows):
        y = head + 18 + 26 * r
        parts.append(f'<text x="{left - 12}" y="{y + 4}" text-anchor="end">{escape(row)}</text>')
        for i, one in enumerate(series):
            if np.isfinite(values[i][r]):
                half = 0.0 if one.spread is None else float(one.spread[r])
                shift = 5 * (i - (len(series) - 1) / 2)  # whiskers side by side
                parts += _dot(across, values[i][r], half, y + shift, COLOURS[i % len(COLOURS)])
    if len(series) > 1:
        parts += _names_above([one.name for one in series], left)
    return _svg(parts, height, f"{x} of {', '.join(rows)}")


def _all_x(series: list[Series]) -> list:
    return [one.x for one in series]


def _all_y(series: list[Series]) -> list:
    bands = [np.asarray(one.y) + side * one.spread for one in series if one.spread is not None for side in (-1, 1)]
    return [*(one.y for one in series), *bands]


def _axis(values: np.ndarray, start: float, stop: float, log: bool, from_zero: bool) -> _Axis:
    low, high = float(values.min()), float(values.max())
    if log:
        if low <= 0:
            raise ValueError(f"a logarithmic axis needs positive values, got {low}")
        return _Axis(low / 1.08, high * 1.08, start, stop, log)
    if from_zero and low >= 0:
        low = 0.0
    pad = 0.05 * (high - low) or 0.5 * abs(high) or 1.0
    return _Axis(low if from_zero and low == 0 else low - pad, high + pad, start, stop, log)


def _frame(across: _Axis, up: _Axis, x: str, y: str) -> list[str]:
    right, floor = WIDTH - RIGHT, HEIGHT - BOTTOM
    parts = []
    for value in up.ticks():
        at = up(value)
        parts.append(f'<line class="grid" x1="{LEFT}" x2="{right}" y1="{at:.1f}" y2="{at:.1f}"/>')
        parts.append(f'<text x="{LEFT - 8}" y="{at + 4:.1f}" text-anchor="end">{_tick(value)}</text>')
    for value in across.ticks():
        at = across(value)
        parts.append(f'<line class="axis" x1="{at:.1f}" x2="{at:.1f}" y1="{floor}" y2="{floor + 5}"/>')
        parts.append(f'<text x="{at:.1f}" y="{floor + 20}" text-anchor="middle">{_tick(value)}</text>')
    parts.append(f'<line class="axis" x1="{LEFT}" x2="{right}" y1="{floor}" y2="{floor}"/>')
    parts.append(f'<text x="{(LEFT + right) / 2}" y="{HEIGHT - 8}" text-anchor="middle">{escape(x)}</text>')
    middle = (TOP + floor) / 2
    parts.append(f'<text transform="translate(16 {middle}) rotate(-90)" text-anchor="middle">{escape(y)}</text>')
    return parts


def _look(index: int) -> tuple[str, str]:
    """Colour and dashes: when the colours are used up, dashed lines begin with them again."""
    return COLOURS[index % len(COLOURS)], ' stroke-dasharray="6 3"' if index >= len(COLOURS) else ""


def _line(one: Series, across: _Axis, up: _Axis, colour: str, dashes: str) -> list[str]:
    order = np.argsort(one.x, kind="stable")
    xs, ys = np.asarray(one.x, float)[order], np.asarray(one.y, float)[order]
    dots = [(across(a), up(b)) for a, b in zip(xs, ys, strict=True)]
    parts = []
    if one.spread is not None:
        half = np.asarray(one.spread, float)[order]
        above = [(across(a), up(b)) for a, b in zip(xs, ys + half, strict=True)]
        below = [(across(a), up(b)) for a, b in zip(xs, ys - half, strict=True)]
        parts.append(f'<polygon points="{_points([*above, *below[::-1]])}" fill="{colour}" fill-opacity=".18"/>')
    parts.append(f'<polyline points="{_points(dots)}" fill="none" stroke="{colour}" stroke-width="2"{dashes}/>')
    if len(dots) <= 60:
        parts += [f'<circle cx="{a:.1f}" cy="{b:.1f}" r="3" fill="{colour}"/>' for a, b in dots]
    return parts


def _points(dots: list[tuple[float, float]]) -> str:
    return " ".join(f"{a:.1f},{b:.1f}" for a, b in dots)


def _names(series: list[Series]) -> list[str]:
    """The legend: beside the chart, one line a series, the highest at its right end first."""
    parts, left = [], WIDTH - RIGHT + 14
    order = sorted(range(len(series)), key=lambda i: -float(series[i].y[np.argmax(series[i].x)]))
    for row, i in enumerate(order):
        y, (colour, dashes) = TOP + 6 + 18 * row, _look(i)
        parts.append(
            f'<line x1="{left}" x2="{left + 24}" y1="{y}" y2="{y}" stroke="{colour}" stroke-width="3"{dashes}/>'
        )
        parts.append(f'<text x="{left + 30}" y="{y + 4}">{escape(series[i].name)}</text>')
    return parts


def _ruler(across: _Axis, top: float, floor: float, middle: float, height: float, x: str) -> list[str]:
    """Upright grid lines with their numbers, and the label under them."""
    parts = []
    for value in across.ticks():
        at = across(value)
        parts.append(f'<line class="grid" x1="{at:.1f}" x2="{at:.1f}" y1="{top}" y2="{floor}"/>')
        parts.append(f'<text x="{at:.1f}" y="{floor + 18}" text-anchor="middle">{_tick(value)}</text>')
    parts.append(f'<text x="{middle:.1f}" y="{height - 8}" text-anchor="middle">{escape(x)}</text>')
    return parts


def _dot(across: _Axis, value: float, half: float, y: float, colour: str) -> list[str]:
    parts = []
    if half > 0:
        a, b = across(value - half), across(value + half)
        parts.append(f'<line x1="{a:.1f}" x2="{b:.1f}" y1="{y}" y2="{y}" stroke="{colour}" stroke-width="2"/>')
    return [*parts, f'<circle cx="{across(value):.1f}" cy="{y}" r="4.5" fill="{colour}" fill-opacity=".85"/>']


def _names_above(names: list[str], left: float) -> list[str]:
    """The legend in one line over the chart."""
    parts, at = [], left
    for i, name in enumerate(names):
        parts.append(f'<circle cx="{at + 5}" cy="{TOP}" r="5" fill="{COLOURS[i % len(COLOURS)]}"/>')
        parts.append(f'<text x="{at + 15}" y="{TOP + 4}">{escape(name)}</text>')
        at += 34 + 7.2 * len(name)
    return parts


def _svg(parts: list[str], height: float, label: str, width: float = WIDTH) -> str:
    size = f'viewBox="0 0 {width} {height}" width="{width}"'
    head = f'<svg xmlns="http://www.w3.org/2000/svg" class="chart" {size} role="img"'
    body = "\n".join(parts)
    return f'{head} aria-label="{escape(label, quote=True)}"><style>{_STYLE}</style>{body}</svg>\n'


def _tick(value: float) -> str:
    return f"{value:g}".replace("-", "−")
