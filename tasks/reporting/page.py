"""The report as one self-contained HTML page: readable on a phone, in light and dark, with nothing to load."""

from __future__ import annotations

import base64
import struct
from collections.abc import Mapping, Sequence
from typing import Any

from jinja2 import Environment
from markupsafe import Markup

from tasks.reporting import typeset
from tasks.reporting.tables import Table
from tasks.values import Picture

STYLE = """
:root { color-scheme: light dark; --ink: #1d2026; --soft: #5b6270; --line: #dfe3e8; --page: #fff; --card: #f6f7f9;
  --ours: #2f6fd0; --real: #23855b; --subst: #a8650c }
@media (prefers-color-scheme: dark) { :root { --ink: #e8eaee; --soft: #9aa3b2; --line: #2c313a; --page: #121418;
  --card: #1a1d23; --ours: #7fb0ff; --real: #5ecf9c; --subst: #e9aa55 } }
* { box-sizing: border-box }
body { margin: 0 auto; padding: 1.2rem 1rem 3rem; max-width: 76rem; background: var(--page); color: var(--ink);
  font: 16px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, sans-serif }
h1 { font-size: 1.5rem; line-height: 1.25; margin: .4rem 0 1rem }
h2 { font-size: 1.1rem; margin: 2.2rem 0 .6rem }
figure { margin: 1.2rem 0 2rem }
figcaption { font-weight: 600; margin: 0 0 .5rem }
p.grid { margin: 1rem 0 .4rem; font-size: .92rem }
.scroll { overflow-x: auto; border: 1px solid var(--line); border-radius: 8px; -webkit-overflow-scrolling: touch }
table { border-collapse: collapse; width: 100%; font-size: .92rem; font-variant-numeric: tabular-nums }
th, td { padding: .42rem .8rem; text-align: right; white-space: nowrap; border-bottom: 1px solid var(--line) }
thead th { font-weight: 500; color: var(--soft); border-bottom: 0; padding-bottom: .1rem }
thead th.group { text-align: left; color: var(--ink); font-weight: 600; border-left: 1px solid var(--line) }
thead tr:last-child th { border-bottom: 1px solid var(--line); padding-bottom: .45rem }
tbody tr:last-child > * { border-bottom: 0 }
th:first-child { position: sticky; left: 0; text-align: left; background: var(--page); font-weight: 500;
  box-shadow: 1px 0 0 var(--line) }
td small { color: var(--soft) }
td b { font-weight: 700 }
td u { text-underline-offset: 3px; text-decoration-thickness: 1.5px }
td.paper { color: var(--soft) }
.badge { display: inline-block; font-size: .72rem; padding: .02rem .5rem; border-radius: 99px;
  border: 1px solid currentColor }
.badge.substitute { color: var(--subst) }
.badge.paper { color: var(--real) }
.badge.printed { color: var(--soft) }
.notes { color: var(--soft); font-size: .84rem; margin-top: .6rem }
.notes p { margin: .15rem 0 }
.picture { background: var(--card); border-radius: 10px; padding: .8rem }
.picture img { display: block; max-width: 100%; height: auto; border-radius: 6px; margin: 0 auto }
.picture svg { display: block; margin: 0 auto }
.facts { display: grid; grid-template-columns: max-content 1fr; gap: .2rem 1rem; font-size: .88rem }
.facts dt { color: var(--soft) }
.facts dd { margin: 0; overflow-wrap: anywhere }
details { margin: 1rem 0; font-size: .88rem }
summary { cursor: pointer; color: var(--soft); margin-bottom: .5rem }
td.cases { white-space: normal; text-align: left }
code { font: .88em ui-monospace, Menlo, Consolas, monospace }
"""

_PAGE = Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True).from_string(
    """\
<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{{ title }}</title>
<style>{{ style }}</style>
</head>
<body>
<h1>{{ title }}</h1>
{% for table in tables %}
{{ table }}
{% endfor %}
{% if pictures %}
<h2>Figures</h2>
{% endif %}
{% for caption, picture in pictures %}
<figure class="picture">
<figcaption>{{ caption }}</figcaption>
{{ picture }}
</figure>
{% endfor %}
{% if facts %}
<h2>Where these numbers come from</h2>
<dl class="facts">
{% for name, value in facts.items() %}
<dt>{{ name }}</dt><dd>{{ value }}</dd>
{% endfor %}
</dl>
{% endif %}
{% if stages %}
<details>
<summary>Every stage: seconds and memory when it was computed</summary>
<div class="scroll">
<table>
<thead><tr><th>stage</th><th>for</th><th>seconds</th><th>peak MB</th><th>this run</th></tr></thead>
<tbody>
{% for s in stages %}
<tr><th>{{ s.stage }}</th><td class="cases">{{ s.cases | join(", ") }}</td><td>{{ "%.2f" | format(s.seconds) }}</td>\
<td>{{ "%.0f" | format(s.peak_mb) }}</td><td>{{ s.how }}</td></tr>
{% endfor %}
</tbody>
</table>
</div>
</details>
{% endif %}
</body>
</html>
"""
)


def html(title: str, tables: Sequence[Table], pictures: Sequence[Picture], provenance: Mapping[str, Any]) -> str:
    """The page. provenance: what it knows of command, git, machine, versions, seeds, inputs and stages is shown."""
    shown = [(picture.caption, inline(picture)) for picture in pictures]
    made = [Markup(typeset.html(table)) for table in tables]
    facts, stages = facts_of(provenance), provenance.get("stages", [])
    return _PAGE.render(title=title, style=Markup(STYLE), tables=made, pictures=shown, facts=facts, stages=stages)


def facts_of(provenance: Mapping[str, Any]) -> dict[str, str]:
    """What a reader asks first: by name, what the provenance says of it."""
    git, machine, stages = (provenance.get(name) or {} for name in ("git", "machine", "stages"))
    computed = [stage for stage in stages if stage["how"] == "computed"]
    found = {
        "command": " ".join(provenance.get("command", [])),
        "commit": git.get("commit", "") + (" with local changes" if git.get("changed") else ""),
        "machine": ", ".join(str(value) for value in machine.values()),
        "versions": ", ".join(f"{name} {version}" for name, version in provenance.get("versions", {}).items()),
        "seeds": ", ".join(str(seed) for seed in provenance.get("seeds", [])),
        "inputs": ", ".join(f"{name} (sha256 {_short(sums)})" for name, sums in provenance.get("inputs", {}).items()),
        "stages": f"{len(computed)} computed, {len(stages) - len(computed)} cached" if stages else "",
    }
    return {name: text for name, text in found.items() if text}


def _short(checksum: object) -> str:
    """The first letters of one checksum, or how many there are."""
    return f"{checksum[:12]}…" if isinstance(checksum, str) else f"of {len(checksum)} files"


def inline(picture: Picture) -> Markup:
    """The picture inside the page: a drawing as it is, pixels as a data URI."""
    if picture.suffix == "svg":
        return Markup(picture.svg)
    width, height = size_of(picture)
    data = base64.b64encode(picture.data).decode()
    tag = Markup('<img src="data:image/{};base64,{}" width="{}" height="{}" alt="{}">')
    return tag.format(picture.suffix, data, width, height, picture.caption)


def size_of(picture: Picture) -> tuple[int, int]:
    """Width and height of a picture of pixels, as its file begins with them: a PNG, or a WebP of several frames."""
    content = picture.data
    if picture.suffix == "png":
        return struct.unpack(">II", content[16:24])
    return tuple(1 + int.from_bytes(content[at : at + 3], "little") for at in (24, 27))
