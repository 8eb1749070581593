"""A table: its rows once, as text, Markdown, HTML and CSV."""

import csv
import io
import math
import shutil
import sys
import textwrap
from collections.abc import Sequence
from functools import partial
from html import escape
from itertools import groupby, zip_longest
from typing import Literal, NamedTuple, TypeAlias

_NARROWEST = 24
"""Least width of a cell that is wrapped; on a terminal too narrow for it the lines break."""


class Cell(NamedTuple):
    """A cell of which more is known than its text."""

    text: str
    values: Sequence[float] = ()
    """numbers in place of the text in CSV, in the order of `ends` of `csv_of`"""
    title: str = ""
    """what a page shows where the pointer is"""
    html: str = ""
    """HTML in place of the text"""


MaybeCell: TypeAlias = Cell | str | None
"""None where a row has no cell: "-" in text, empty in CSV."""


class Row(NamedTuple):
    """A row of a table."""

    label: str
    """a label that starts with a space belongs to the row above"""
    cells: Sequence[MaybeCell]
    unit: str = ""
    note: str = ""
    """a remark, in a last column"""
    group: str = ""
    """a heading above the rows that share it, on a page"""


class Table(NamedTuple):
    """Rows, and the heads of their columns."""

    heads: Sequence[str]
    """of the labels and of the cells; () for none"""
    rows: Sequence[Row]
    fixed: int = 0
    """number of columns after the labels that say something of the row, as an honest value: where
    the others wrap they are repeated"""


def text_of(
    table: Table, *, align: Literal["<", ">"] = ">", rule: bool = False, most: int | None = None
) -> str:
    """The table as text: labels and notes flush left, cells by `align`.

    Columns that do not fit on the terminal follow below, with the labels again, and without the
    rows that have no cell in them. Cells that are flush left are wrapped, too.

    Args:
        table: a table.
        align: flush left or right.
        rule: whether a line separates the heads from the rows.
        most: largest number of columns beside each other where there is no terminal.
    """
    lines = _lines(table)
    texts = [[_cell(cell).text for cell in line] for line in lines]
    sides = ["<", *[align] * (len(lines[0]) - 1)]
    if any(row.note for row in table.rows):
        sides[-1] = "<"
    terminal = terminal_width()
    if terminal is not None and align == "<":
        room = max(terminal - 2 - max(len(label) for label, *_ in texts), _NARROWEST)
        fill = partial(textwrap.fill, width=room, break_long_words=False, break_on_hyphens=False)
        texts = [
            [label, *("\n".join(map(fill, cell.split("\n"))) for cell in cells)]
            for label, *cells in texts
        ]
    widths = _widths(texts)
    first = 1 + table.fixed
    parts: list[list[int]] = []
    for column in range(first, len(widths)):
        part = [*(parts[-1] if parts else ()), column]
        width = sum(widths[i] + 2 for i in [*range(first), *part]) - 2
        fits = len(part) <= (most or len(widths)) if terminal is None else width <= terminal
        if parts and fits:
            parts[-1] = part
        else:
            parts.append([column])
    shown = []
    for part in parts:
        columns = [*range(first), *part]
        kept = [
            [text[i] for i in columns]
            for line, text in zip(lines, texts, strict=True)
            if any(line[i] is not None for i in part)
        ]
        widths = _widths(kept)
        rows = [
            "  ".join(
                f"{cell:{sides[i]}{width}}"
                for i, cell, width in zip(columns, cells, widths, strict=True)
            ).rstrip()
            for text in kept
            for cells in zip_longest(*(cell.split("\n") for cell in text), fillvalue="")
        ]
        if rule:
            rows.insert(1, "-" * (sum(widths) + 2 * len(widths) - 2))
        shown.append("\n".join(rows))
    return "\n\n".join(shown)


def markdown_of(table: Table) -> str:
    """The table as Markdown, pipes escaped."""
    heads, *rows = (
        " | ".join(
            _cell(cell).text.strip().replace("|", r"\|").replace("\n", "<br>") for cell in line
        )
        for line in _lines(table)
    )
    rule = "|" + "---|" * len(_lines(table)[0])
    return "\n".join([f"| {heads} |", rule, *(f"| {row} |" for row in rows)])


def html_of(table: Table, label: str) -> str:
    """The table as HTML, in a region of that label that scrolls where the table is too wide."""
    heads, *lines = _lines(table)
    head = "".join(f'<th scope="col">{with_word_breaks(_cell(name).text)}</th>' for name in heads)
    bodies = []
    for group, rows in groupby(zip(table.rows, lines, strict=True), lambda pair: pair[0].group):
        body = []
        if group:
            title = f'<th colspan="{len(heads)}" scope="rowgroup">{escape(group)}</th>'
            body.append(f'<tr class="group">{title}</tr>')
        for row, (_, *cells) in rows:
            kind = ' class="sub"' if row.label.startswith(" ") else ""
            data = [f'<th scope="row"{kind}>{escape(_label(row).strip())}</th>']
            for i, cell in enumerate(map(_cell, cells)):
                named = ' class="fixed"' if i < table.fixed else ""
                named += f' title="{escape(unbroken(cell.title))}"' if cell.title else ""
                data.append(f"<td{named}>{cell.html or escape(unbroken(cell.text))}</td>")
            body.append(f"<tr>{''.join(data)}</tr>")
        bodies.append("<tbody>" + "\n".join(body) + "</tbody>")
    content = "\n".join([f"<thead><tr>{head}</tr></thead>", *bodies])
    return (
        f'<div class="scroll" tabindex="0" role="region" aria-label="{escape(label)}">'
        f"<table>{content}</table></div>"
    )


def csv_of(table: Table, ends: Sequence[str] = ("",)) -> str:
    """The table as CSV; cells without a number or a text are empty.

    ends: of the heads of the columns that a column has there, one for each number of a cell.
    """
    heads, *rows = _lines(table)
    first = 1 + table.fixed
    last = len(heads) - any(row.note for row in table.rows)
    columns = [_cell(head).text for head in heads]
    header = columns[:first] + [f"{head}{end}" for head in columns[first:last] for end in ends]
    lines = []
    for label, *cells in rows:
        line = [_cell(label).text.strip()]
        for i, cell in enumerate(cells, 1):
            text, values, *_ = _cell(cell) if cell is not None else Cell("")
            texts = [csv_number(value) for value in values] or [text]
            line += texts + [""] * (len(ends) - len(texts)) * (first <= i < last)
        lines.append(line)
    return csv_text(header + columns[last:], lines)


def csv_text(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Comma-separated text with a header line."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(rows)
    return out.getvalue()


def csv_number(value: float) -> str:
    """A number as a cell of CSV, empty if it is not finite."""
    return f"{value:.9g}" if math.isfinite(value) else ""


def terminal_width() -> int | None:
    """The number of columns of the terminal; None where standard output is a file or a pipe."""
    out = sys.stdout
    return shutil.get_terminal_size().columns if out is not None and out.isatty() else None


def with_word_breaks(name: str) -> str:
    """A name escaped for HTML, with places where it may break."""
    return escape(name).replace("_", "_<wbr>")


def unbroken(text: str) -> str:
    """A text with no line break before a percent sign."""
    return text.replace(" %", "\N{NO-BREAK SPACE}%")


def _label(row: Row) -> str:
    return f"{row.label} [{row.unit}]" if row.unit else row.label


def _lines(table: Table) -> list[list[MaybeCell]]:
    """The heads, if there are some, and the rows: label, cells and, if any row has one, note."""
    notes = [row.note for row in table.rows]
    lines: list[list[MaybeCell]] = [[_label(row), *row.cells] for row in table.rows]
    if table.heads:
        notes, lines = ["", *notes], [[*table.heads], *lines]
    return [[*line, note] for line, note in zip(lines, notes, strict=True)] if any(notes) else lines


def _cell(cell: MaybeCell) -> Cell:
    return cell if isinstance(cell, Cell) else Cell("-" if cell is None else cell)


def _widths(texts: Sequence[Sequence[str]]) -> list[int]:
    """The width of each column, of the longest line of a cell."""
    return [
        max(len(line) for cell in column for line in cell.split("\n"))
        for column in zip(*texts, strict=True)
    ]
