"""The page over all experiments of a run: what of the paper was reproduced, then every experiment with its tables,
figures and command. One file with nothing to load, made for a phone first."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any

import cv2
import numpy as np
from jinja2 import Environment
from markupsafe import Markup

from tasks.evaluation.metrics import metric_of
from tasks.reporting import page, typeset
from tasks.reporting.coverage import Claim, Covered
from tasks.reporting.tables import Table, digits_for, printed_digits
from tasks.values import Picture

WIDEST = 1280  # pixels of a picture on the page; the report's folder has it whole
QUALITY = 80  # of WebP

_STYLE = """
nav { display: flex; flex-wrap: wrap; gap: .4rem; margin: 0 0 1.2rem }
nav a { border: 1px solid var(--line); border-radius: 99px; padding: .15rem .7rem; font-size: .86rem;
  color: var(--ink); text-decoration: none }
section { border-top: 1px solid var(--line); margin-top: 2.6rem; padding-top: .4rem }
h2 { font-size: 1.25rem; margin: 1.4rem 0 .2rem }
pre { background: var(--card); border-radius: 8px; padding: .55rem .8rem; margin: .5rem 0 1rem; overflow-x: auto;
  font: .84rem/1.4 ui-monospace, Menlo, Consolas, monospace }
.lead { color: var(--soft); margin: .2rem 0 1rem }
.missing { border-left: 3px solid var(--subst); padding: .1rem .8rem; font-size: .9rem; overflow-wrap: anywhere }
.coverage td, .coverage th { padding: .3rem .5rem }
.coverage td { white-space: nowrap }
.coverage td:last-child, .coverage thead th:last-child { text-align: left }
.coverage tr.group th { text-align: left; padding-top: .8rem; font-weight: 600; position: static; box-shadow: none;
  white-space: normal }
.coverage tr.group small { display: block; color: var(--soft); font-weight: 400 }
.claims { list-style: none; margin: .3rem 0 .9rem; padding: 0; color: var(--ink) }
.claims li { padding: .12rem 0 }
.claims b { font-weight: 600; display: inline-block; min-width: 3.6rem }
.claims .holds b { color: var(--real) }
.claims .fails b { color: var(--subst) }
.badge.reproduced { color: var(--real) }
.badge.not { color: var(--soft) }
.gallery { display: grid; gap: 1rem; align-items: start;
  grid-template-columns: repeat(auto-fit, minmax(min(100%, 30rem), 1fr)) }
.gallery figure { margin: 0 }
.picture { min-width: 0 }
.picture .pan { overflow-x: auto }
.picture .pan img { width: 100%; max-width: none }
.picture svg { max-width: 100%; height: auto }
.wide { grid-column: 1 / -1 }
@media (max-width: 40rem) { .broad .pan img { width: 36rem } .coverage { font-size: .84rem }
  .coverage td, .coverage th { padding: .3rem .3rem } .coverage .badge { font-size: .64rem; padding: .02rem .35rem } }
"""

_PAGE = Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True).from_string(
    """\
<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>Skelebones: {{ title }}</title>
<style>{{ style }}</style>
</head>
<body>
<h1>{{ title }}</h1>
<nav>{% for s in sections %}<a href="#{{ s.name }}">{{ s.title }}</a>{% endfor %}</nav>
{% if coverage %}
<h2>The paper's tables, cell by cell</h2>
<p class="lead">{{ counts }}. Differences are ours − the paper's; on substitute data the rows compare, the numbers do \
not.</p>
{% for number, groups, open, said, claims, commands in coverage %}
<details{% if open %} open{% endif %}>
<summary>Table {{ number }}: {{ said }}</summary>
{% for command in commands %}
<pre>{{ command }}</pre>
{% endfor %}
{% if claims %}
<ul class="claims">
{% for c in claims %}
<li class="{{ c.verdict }}"><b>{{ c.verdict }}</b> {{ c.said }}</li>
{% endfor %}
</ul>
{% endif %}
<div class="scroll">
<table class="coverage">
<thead><tr><th>method</th><th>paper</th><th>ours</th><th>diff.</th><th>status</th></tr></thead>
<tbody>
{% for heading, whys, cells in groups %}
<tr class="group"><th colspan="5">{{ heading }}{% for why in whys %}<small>{{ why }}</small>{% endfor %}</th></tr>
{% for c in cells %}
<tr><th>{{ c.method }}</th><td class="paper">{{ c.paper }}</td><td>{{ c.ours }}</td><td>{{ c.difference }}</td>\
<td><span class="badge {{ c.badge }}">{{ c.status }}</span></td></tr>
{% endfor %}
{% endfor %}
</tbody>
</table>
</div>
</details>
{% endfor %}
{% endif %}
{% for s in sections %}
<section id="{{ s.name }}">
<h2>{{ s.title }}</h2>
<pre>{{ s.command }}</pre>
{% for remark in s.remarks %}
<p class="missing">{{ remark }}</p>
{% endfor %}
{% for what, why in s.missing %}
<p class="missing"><b>{{ what }}</b> not run: {{ why }}</p>
{% endfor %}
{% for table in s.tables %}
{{ table }}
{% endfor %}
{% if s.figures %}
<div class="gallery">
{% for caption, picture, kind in s.figures %}
<figure class="picture {{ kind }}"><figcaption>{{ caption }}</figcaption>\
<div class="pan">{{ picture }}</div></figure>
{% endfor %}
</div>
{% endif %}
{% if s.shown_before %}
<p class="notes">Figures of {{ s.shown_before | join(", ") }} that are the same stand further up.</p>
{% endif %}
</section>
{% endfor %}
<section>
<h2>Where these numbers come from</h2>
<dl class="facts">
{% for name, value in facts.items() %}
<dt>{{ name }}</dt><dd>{{ value }}</dd>
{% endfor %}
</dl>
</section>
</body>
</html>
"""
)


@dataclass(frozen=True)
class Section:
    """An experiment on the page. name: its folder beside the page; command: that makes its numbers; missing: (what was
    not run, why); paper_table: the paper's table that it stands beside; remarks: what else to know of its run."""

    name: str
    title: str
    command: str
    tables: Sequence[Table]
    figures: Sequence[Picture]
    missing: Sequence[tuple[str, str]]
    paper_table: int | None = None
    remarks: Sequence[str] = ()


def html(
    title: str,
    sections: Sequence[Section],
    coverage: Mapping[int, Sequence[Covered]],
    provenance: Mapping[str, Any],
    claims: Mapping[int, Sequence[Claim]] | None = None,
) -> str:
    """The page. coverage: every printed cell by the paper's table; provenance: of one of the reports, for what they
    share: commit, machine, versions; claims: what each table claims, and whether it holds here."""
    seen: set[bytes] = set()
    cells = [cell for table in coverage.values() for cell in table]
    facts = page.facts_of({n: provenance[n] for n in ("git", "machine", "versions") if n in provenance})
    commands: dict[int, list[str]] = {}
    for section in sections:
        if section.paper_table and section.tables:
            commands.setdefault(section.paper_table, []).append(section.command)
    return _PAGE.render(
        title=title,
        style=Markup(page.STYLE + _STYLE),
        sections=[_section(section, seen) for section in sections],
        coverage=[
            (*_table(number, table), [_claim(c) for c in (claims or {}).get(number, ())], commands.get(number, ()))
            for number, table in coverage.items()
        ],
        counts=_counts(cells),
        facts=facts,
    )


def _section(section: Section, seen: set[bytes]) -> dict[str, Any]:
    """What the page shows of an experiment; pictures that another one has shown are left out."""
    fresh, before = [], []
    for picture in section.figures:
        (before if picture.data in seen else fresh).append(picture)
        seen.add(picture.data)
    return {
        "name": section.name,
        "title": section.title,
        "command": section.command,
        "missing": section.missing,
        "remarks": section.remarks,
        "tables": [Markup(typeset.html(table)) for table in section.tables],
        "figures": [(picture.caption, *_shown(picture)) for picture in fresh],
        "shown_before": [picture.caption for picture in before],
    }


def _shown(picture: Picture) -> tuple[Markup, str]:
    """The picture for the page, pixels as WebP, and its class: broad where a phone shows a part of it, wide where it
    takes a whole row of the page."""
    if picture.suffix != "png":
        return page.inline(picture), ""
    pixels = cv2.imdecode(np.frombuffer(picture.data, np.uint8), cv2.IMREAD_COLOR)
    height, width = pixels.shape[:2]
    if width > WIDEST:
        pixels = cv2.resize(pixels, (WIDEST, round(height * WIDEST / width)), interpolation=cv2.INTER_AREA)
    _, data = cv2.imencode(".webp", pixels, [cv2.IMWRITE_WEBP_QUALITY, QUALITY])
    tag = Markup('<img loading="lazy" src="data:image/webp;base64,{}" width="{}" height="{}" alt="{}">')
    text = base64.b64encode(data.tobytes()).decode()
    shown = tag.format(text, pixels.shape[1], pixels.shape[0], picture.caption)
    return shown, ("broad wide" if width > WIDEST else "broad") if width > 1.6 * height else ""


def _table(number: int, cells: Sequence[Covered]) -> tuple[int, list, bool, str]:
    """A table of the paper by columns: its number; heading, reasons and cells as text of each; whether it is open; how
    much was run."""
    ordered = sorted(cells, key=lambda c: [(d.column, d.metric) for d in cells].index((c.column, c.metric)))
    groups = []
    for (column, metric), group in groupby(ordered, key=lambda c: (c.column, c.metric)):
        members = list(group)
        digits = digits_for([c.ours for c in members if c.ours is not None], metric)
        label, unit = metric_of(metric).label, members[0].unit
        heading = f"{column}, {label}" + ("" if unit in ("ratio", "count", "unit") else f" [{unit}]")
        printed = printed_digits([c.paper for c in members if c.paper is not None])
        groups.append((heading, _reasons(members), [_cell(c, digits, printed) for c in members]))
    return number, groups, any(c.ours is not None for c in cells), _counts(cells)


def _reasons(cells: Sequence[Covered]) -> list[str]:
    """What ours is the mean of, and why cells of a column were not run, a line for every reason."""
    whys: dict[str, list[str]] = {}
    for cell in cells:
        if cell.why:
            whys.setdefault(cell.why, []).append(cell.method)
    said = [f"{', '.join(names) if len(names) < len(cells) else 'not run'}: {why}" for why, names in whys.items()]
    means = dict.fromkeys(c.of for c in cells if c.of)
    remarks = dict.fromkeys(c.remark for c in cells if c.remark)
    return [f"ours: mean over {', '.join(of)}" for of in means] + list(remarks) + said


def _claim(claim: Claim) -> dict[str, str]:
    """A claim as a line: the paper's change, and ours."""
    metric = metric_of(claim.metric)
    change = f"{typeset.number(claim.printed, 1, signed=True)} % in the paper, "
    change += f"{typeset.number(claim.ours, 1, signed=True)} % here"
    said = f"{claim.lead} against {claim.other}, {claim.column}, {metric.label}: {change}"
    return {"verdict": "holds" if claim.holds else "fails", "said": said}


def _cell(cell: Covered, digits: int, printed: int) -> dict[str, str]:
    gap = None if cell.paper is None or cell.ours is None else cell.ours - cell.paper
    return {
        "method": cell.method,
        "paper": "?" if cell.paper is None else typeset.number(cell.paper, printed),
        "ours": "–" if cell.ours is None else typeset.number(cell.ours, digits),
        "difference": "–" if gap is None else typeset.number(gap, digits, signed=True),
        "status": cell.status,
        "badge": cell.status.split(" ", 1)[0],
    }


def _counts(cells: Sequence[Covered]) -> str:
    own, other, none = (sum(c.status == s for c in cells) for s in ("reproduced", "substitute data", "not run"))
    return f"{len(cells)} cells: {own} on the paper's data, {other} on substitute data, {none} not run"
