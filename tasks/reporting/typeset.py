"""Renders a table: Markdown, LaTeX (booktabs), HTML, and the terminal."""

from __future__ import annotations

from itertools import groupby
from typing import TYPE_CHECKING

from jinja2 import Environment
from markupsafe import Markup, escape

from tasks.reporting.tables import Cell, Column, Grid, Table

if TYPE_CHECKING:
    import rich.console
    import rich.table

NARROW = 4  # columns side by side in a terminal


def number(value: float, digits: int, *, signed: bool = False) -> str:
    """A number with a true minus sign, and a plus where it is a difference; no sign on what rounds to nothing."""
    text = f"{value:+.{digits}f}" if signed else f"{value:.{digits}f}"
    if float(text) == 0.0:
        text = f"{0.0:.{digits}f}"
    return text.replace("-", "−")


def cell_text(column: Column, cell: Cell) -> tuple[str, str]:
    """What a cell says: the number, which is marked when ranked, and what follows it."""
    if cell.value is None:
        return ("?" if cell.note else "–"), ""
    main = number(cell.value, column.digits, signed=column.kind == "difference")
    spread = "" if cell.spread is None else f" ± {number(cell.spread, column.digits)}"
    gain = "" if cell.gain is None else f" ({number(cell.gain, 1, signed=True)}\u00a0%)"
    return main, spread + gain


def data_text(column: Column) -> str:
    """Whose number a column holds and on what data: paper | ours | difference, the paper's data or a substitute."""
    return {"paper": "paper", "ours": f"ours, {column.status}", "difference": f"difference, {column.status}"}[
        column.kind
    ]


def markdown(table: Table) -> str:
    """Pipe tables, their first rows say what data is behind each column."""
    footnotes = table.footnotes

    def show(column: Column, cell: Cell) -> str:
        main, rest = cell_text(column, cell)
        main = {1: f"**{main}**", 2: f"<ins>{main}</ins>"}.get(cell.rank, main)
        return main + rest + (f" <sup>{footnotes.index(cell.note) + 1}</sup>" if cell.note else "")

    def grid(part: Grid) -> str:
        names = [part.groups or part.labels, part.labels if part.groups else []]
        heads = ["<br>".join(words) for words in zip(*filter(None, names), strict=True)]
        lines = [["method", *heads], ["---", *("---:" for _ in heads)]]
        lines.append(["*data*", *(f"*{data_text(c)}*" for c in part.columns)])
        lines += [[table.rows[r], *(show(c, c.cells[r]) for c in part.columns)] for r in part.rows]
        text = "\n".join("| " + " | ".join(text.replace("|", "\\|") for text in line) + " |" for line in lines)
        return f"*{part.title}*\n\n{text}" if part.title else text

    grids = [grid(part) for part in table.grids()]
    marks = [f"<sup>{i}</sup> {note}." for i, note in enumerate(footnotes, start=1)]
    whole = [f"**{table.title}**", *grids, *table.remarks, *marks]
    if table.folded:
        whole = ["<details>", f"<summary>{escape(table.title)}</summary>", *whole[1:], "</details>"]
    return "\n\n".join(whole) + "\n"


_LATEX = {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}
_LATEX |= {c: "\\" + c for c in "&%$#_{}"}
_LATEX |= {"−": "$-$", "±": r"$\pm$", "↓": r"$\downarrow$", "↑": r"$\uparrow$", "→": r"$\to$", "–": "--", "\u00a0": "~"}


def latex(table: Table) -> str:
    """A booktabs table: \\usepackage{booktabs} is all it needs."""
    footnotes = table.footnotes

    def text(plain: str) -> str:
        return "".join(_LATEX.get(c, c) for c in plain)

    def show(column: Column, cell: Cell) -> str:
        main, rest = (text(part) for part in cell_text(column, cell))
        main = {1: rf"\textbf{{{main}}}", 2: rf"\underline{{{main}}}"}.get(cell.rank, main)
        return main + rest + (f"\\textsuperscript{{{footnotes.index(cell.note) + 1}}}" if cell.note else "")

    def tabular(part: Grid) -> list[str]:
        lines = [["", *(text(data_text(c)).join((r"\textit{", "}")) for c in part.columns)]]
        lines += [[text(table.rows[r]), *(show(c, c.cells[r]) for c in part.columns)] for r in part.rows]
        data, *body = (" & ".join(line) + r" \\" for line in lines)
        head, at = [], 2
        if part.groups:
            spans, rules = [""], []
            for group, columns in groupby(part.groups):
                width = len(list(columns))
                spans.append(rf"\multicolumn{{{width}}}{{c}}{{{text(group)}}}")
                rules.append(rf"\cmidrule(lr){{{at}-{at + width - 1}}}")
                at += width
            head = [" & ".join(spans) + r" \\", " ".join(rules)]
        if part.labels:
            head.append(" & ".join(["method", *map(text, part.labels)]) + r" \\")
        title = [rf"\textit{{{text(part.title)}}}", ""] if part.title else []
        start = rf"\begin{{tabular}}{{l{'r' * len(part.columns)}}}"
        return [*title, start, r"\toprule", *head, data, r"\midrule", *body, r"\bottomrule", r"\end{tabular}", ""]

    marks = [rf"\textsuperscript{{{i}}} {text(note)}." for i, note in enumerate(footnotes, start=1)]
    parts = [r"\begin{table}", r"\centering", r"\small", rf"\caption{{{text(table.title)}}}"]
    for part in table.grids():
        parts += [*tabular(part), r"\smallskip"]
    notes = [*(text(note) for note in table.remarks), *marks]
    return "\n".join([*parts, r"\footnotesize", r" \\ ".join(notes), r"\end{table}"]) + "\n"


_HTML = Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True).from_string(
    """\
<figure class="table">
{% if table.folded %}
<details>
<summary>{{ table.title }}</summary>
{% else %}
<figcaption>{{ table.title }}</figcaption>
{% endif %}
{% for grid in table.grids() %}
{% if grid.title %}
<p class="grid">{{ grid.title }}</p>
{% endif %}
<div class="scroll">
<table>
<thead>
{% if grid.groups %}
<tr><th></th>{% for group, width in spans(grid.groups) %}<th class="group" colspan="{{ width }}">{{ group }}</th>\
{% endfor %}</tr>
{% endif %}
{% if grid.labels %}
<tr><th>method</th>{% for label in grid.labels %}<th>{{ label }}</th>{% endfor %}</tr>
{% endif %}
<tr><th></th>{% for c in grid.columns %}<th><span class="badge {{ c.kind }} {{ c.status | replace("'s data", "") }}">\
{{ data_text(c) }}</span></th>{% endfor %}</tr>
</thead>
<tbody>
{% for r in grid.rows %}
<tr><th>{{ table.rows[r] }}</th>{% for c in grid.columns %}<td class="{{ c.kind }}">{{ show(c, c.cells[r]) }}</td>\
{% endfor %}</tr>
{% endfor %}
</tbody>
</table>
</div>
{% endfor %}
<div class="notes">
{% for note in table.remarks %}
<p>{{ note }}</p>
{% endfor %}
{% for note in footnotes %}
<p><sup>{{ loop.index }}</sup> {{ note }}.</p>
{% endfor %}
</div>
{% if table.folded %}
</details>
{% endif %}
</figure>
"""
)


def html(table: Table) -> str:
    """A <figure> with the table's grids; its looks come from the page's style sheet (tasks/reporting/page.py)."""
    footnotes = table.footnotes

    def show(column: Column, cell: Cell) -> Markup:
        main, rest = cell_text(column, cell)
        tag = {1: "<b>{}</b>", 2: "<u>{}</u>"}.get(cell.rank, "{}")
        mark = Markup("<sup>{}</sup>").format(footnotes.index(cell.note) + 1) if cell.note else ""
        after = Markup("<small>{}</small>").format(rest) if rest else ""
        return Markup(tag).format(escape(main)) + after + mark

    def spans(groups: list[str]) -> list[tuple[str, int]]:
        return [(group, len(list(same))) for group, same in groupby(groups)]

    return _HTML.render(table=table, spans=spans, show=show, data_text=data_text, footnotes=footnotes)


def terminal(table: Table) -> rich.console.Group:
    """The table for the terminal, in narrower grids than on a page. The best is bold and green, the second best
    underlined."""
    from rich.console import Group
    from rich.text import Text

    footnotes = table.footnotes
    notes = [*table.remarks, *(f"[{i}] {note}." for i, note in enumerate(footnotes, start=1))]
    shown = [_grid(table, part, footnotes) for part in table.grids(NARROW)]
    return Group(Text(table.title, "bold"), *shown, Text("\n".join(notes), "dim"))


def _grid(table: Table, part: Grid, footnotes: list[str]) -> rich.table.Table:
    from rich.table import Table as Drawn
    from rich.text import Text

    kinds = {data_text(column) for column in part.columns}
    same = f"({kinds.pop()})" if len(kinds) == 1 else ""
    grid = Drawn(title=Text(f"{part.title} {same}".strip(), "italic"), title_justify="left")
    grid.add_column("method", no_wrap=True)
    for i, column in enumerate(part.columns):
        heading = [names[i] for names in (part.groups, part.labels) if names]
        grid.add_column(Text("\n".join(heading + ([] if same else [data_text(column)]))), justify="right")
    for r in part.rows:
        line = [Text(table.rows[r])]
        for column in part.columns:
            cell = column.cells[r]
            main, rest = cell_text(column, cell)
            rest = rest.replace("\u00a0", "")  # rich breaks lines at it
            mark = f" [{footnotes.index(cell.note) + 1}]" if cell.note else ""
            line.append(Text(main, {1: "bold green", 2: "underline"}.get(cell.rank, "")).append(rest + mark, "dim"))
        grid.add_row(*line)
    return grid
