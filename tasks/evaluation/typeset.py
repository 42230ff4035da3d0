"""Renders a table: Markdown, LaTeX (booktabs), HTML, and the terminal."""

from __future__ import annotations

from itertools import groupby
from typing import TYPE_CHECKING

from jinja2 import Environment
from markupsafe import Markup, escape

from tasks.evaluation.tables import Cell, Column, Table

if TYPE_CHECKING:
    import rich.console
    import rich.table


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
    """A pipe table whose first row says what data is behind each column."""
    footnotes = table.footnotes

    def show(column: Column, cell: Cell) -> str:
        main, rest = cell_text(column, cell)
        main = {1: f"**{main}**", 2: f"<ins>{main}</ins>"}.get(cell.rank, main)
        return main + rest + (f" <sup>{footnotes.index(cell.note) + 1}</sup>" if cell.note else "")

    lines = [["method", *(f"{c.group}<br>{c.label}" for c in table.columns)]]
    lines.append(["---", *("---:" for _ in table.columns)])
    lines.append(["*data*", *(f"*{data_text(c)}*" for c in table.columns)])
    lines += [[label, *(show(c, c.cells[r]) for c in table.columns)] for r, label in enumerate(table.rows)]
    grid = "\n".join("| " + " | ".join(text.replace("|", "\\|") for text in line) + " |" for line in lines)
    marks = [f"<sup>{i}</sup> {note}." for i, note in enumerate(footnotes, start=1)]
    return "\n\n".join([f"**{table.title}**", grid, *table.remarks, *marks]) + "\n"


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

    spans, rules, at = [], [], 2
    for group, columns in groupby(table.columns, key=lambda c: c.group):
        width = len(list(columns))
        spans.append(rf"\multicolumn{{{width}}}{{c}}{{{text(group)}}}")
        rules.append(rf"\cmidrule(lr){{{at}-{at + width - 1}}}")
        at += width
    lines = [["", *spans], ["method", *(text(c.label) for c in table.columns)]]
    lines.append(["", *(rf"\textit{{{text(data_text(c))}}}" for c in table.columns)])
    body = [[text(label), *(show(c, c.cells[r]) for c in table.columns)] for r, label in enumerate(table.rows)]
    head, names, data, *rest = (" & ".join(line) + r" \\" for line in [*lines, *body])
    marks = [rf"\textsuperscript{{{i}}} {text(note)}." for i, note in enumerate(footnotes, start=1)]
    parts = [r"\begin{table}", r"\centering", r"\small", rf"\caption{{{text(table.title)}}}"]
    parts += [rf"\begin{{tabular}}{{l{'r' * len(table.columns)}}}", r"\toprule", head, " ".join(rules), names, data]
    parts += [r"\midrule", *rest, r"\bottomrule", r"\end{tabular}", "", r"\smallskip", r"\footnotesize"]
    notes = [*(text(note) for note in table.remarks), *marks]
    return "\n".join([*parts, r" \\ ".join(notes), r"\end{table}"]) + "\n"


_HTML = Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True).from_string(
    """\
<figure class="table">
<figcaption>{{ table.title }}</figcaption>
<div class="scroll">
<table>
<thead>
<tr><th></th>{% for group, columns in groups %}<th class="group" colspan="{{ columns | length }}">{{ group }}</th>\
{% endfor %}</tr>
<tr><th>method</th>{% for c in table.columns %}<th>{{ c.label }}</th>{% endfor %}</tr>
<tr><th></th>{% for c in table.columns %}<th><span class="badge {{ c.kind }} {{ c.status | replace("'s data", "") }}">\
{{ data_text(c) }}</span></th>{% endfor %}</tr>
</thead>
<tbody>
{% for label in table.rows %}
{% set r = loop.index0 %}
<tr><th>{{ label }}</th>{% for c in table.columns %}<td class="{{ c.kind }}">{{ show(c, c.cells[r]) }}</td>{% endfor %}\
</tr>
{% endfor %}
</tbody>
</table>
</div>
<div class="notes">
{% for note in table.remarks %}
<p>{{ note }}</p>
{% endfor %}
{% for note in footnotes %}
<p><sup>{{ loop.index }}</sup> {{ note }}.</p>
{% endfor %}
</div>
</figure>
"""
)


def html(table: Table) -> str:
    """A <figure> with the table; its looks come from the page's style sheet (tasks/evaluation/page.py)."""
    footnotes = table.footnotes

    def show(column: Column, cell: Cell) -> Markup:
        main, rest = cell_text(column, cell)
        tag = {1: "<b>{}</b>", 2: "<u>{}</u>"}.get(cell.rank, "{}")
        mark = Markup("<sup>{}</sup>").format(footnotes.index(cell.note) + 1) if cell.note else ""
        after = Markup("<small>{}</small>").format(rest) if rest else ""
        return Markup(tag).format(escape(main)) + after + mark

    groups = [(group, list(columns)) for group, columns in groupby(table.columns, key=lambda c: c.group)]
    return _HTML.render(table=table, groups=groups, show=show, data_text=data_text, footnotes=footnotes)


def terminal(table: Table) -> rich.console.Group:
    """The table for the terminal: one grid a subject, and one for what is only printed in the paper. The best is bold
    and green, the second best underlined; a grid leaves out rows that say nothing in it."""
    from rich.console import Group
    from rich.text import Text

    footnotes = table.footnotes
    notes = [*table.remarks, *(f"[{i}] {note}." for i, note in enumerate(footnotes, start=1))]
    measured = {column.group for column in table.columns if column.kind == "ours"}
    grids: dict[str, list[Column]] = {}
    for column in table.columns:
        grids.setdefault(column.group if column.group in measured else "printed in the paper, not run", []).append(
            column
        )
    shown = [_grid(title, table.rows, columns, footnotes) for title, columns in grids.items()]
    return Group(Text(table.title, "bold"), *shown, Text("\n".join(notes), "dim"))


def _grid(title: str, rows: tuple[str, ...], columns: list[Column], footnotes: list[str]) -> rich.table.Table:
    from rich.table import Table as Grid
    from rich.text import Text

    kinds = {data_text(column) for column in columns}
    same = f" ({kinds.pop()})" if len(kinds) == 1 else ""
    grid = Grid(title=Text(title + same, "italic"), title_justify="left")
    grid.add_column("method", no_wrap=True)
    for column in columns:
        heading = [column.group] if column.group != title else []
        data = [] if same else [data_text(column)]
        grid.add_column(Text("\n".join([*heading, column.label, *data])), justify="right")
    for r, label in enumerate(rows):
        cells = [column.cells[r] for column in columns]
        if all(cell.value is None and not cell.note for cell in cells):
            continue
        line = [Text(label)]
        for column, cell in zip(columns, cells, strict=True):
            main, rest = cell_text(column, cell)
            rest = rest.replace("\u00a0", "")  # rich breaks lines at it
            mark = f" [{footnotes.index(cell.note) + 1}]" if cell.note else ""
            line.append(Text(main, {1: "bold green", 2: "underline"}.get(cell.rank, "")).append(rest + mark, "dim"))
        grid.add_row(*line)
    return grid
