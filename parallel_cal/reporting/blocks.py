"""Blocks: what a result shows, described once for the terminal, the report and the workbench.

`results.py` and `studies.py` have one function for each kind of result. It describes the result
as blocks: tables, sentences (`str`), a judgement and tiles. Three renderers show them:

- `as_text` for the command line: ASCII, fixed decimals, no columns that are for pages only;
- `markup.as_html` for reports and notebooks: significant digits, sortable, with small lines;
- `as_rows` for the workbench, whose page gets plain data from another process.

The report and the page render the judgement and the tiles with `markup` and `blocks.css`.

A `Number` keeps its value until it is rendered, because a terminal and a page show different
digits. Texts are ASCII; a page writes um as µm.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from parallel_cal.reporting.readable import (
    MISSING,
    Paint,
    columns,
    format_fixed,
    is_known,
    number,
    plain,
    probability,
    round_to_sigma,
    short_probability,
    wrap,
    write_micro,
)


@dataclass(frozen=True)
class Number:
    """A value in SI units; `factor` converts it to the unit of its column or its row.

    A terminal shows `decimals`; a page shows the decimals of the second digit of `sigma`, or
    `significant` digits if the sigma is not known. `unit` follows the number in HTML.
    """

    value: float | None
    factor: float = 1.0
    decimals: int = 2
    significant: int = 3
    sigma: float | None = None
    unit: str = ""

    def fixed(self) -> str:
        """Format the number for a terminal: as on a page where the decimals would show no digit of
        the sigma, as of a coefficient in m/N^2."""
        if is_known(self.sigma) and 0 < self.sigma * self.factor < 0.5 * 10**-self.decimals:
            return self.on_page()
        return format_fixed(self.value, self.factor, self.decimals)

    def on_page(self) -> str:
        """Format the number for a page."""
        if is_known(self.value) and is_known(self.sigma) and self.sigma > 0:
            return round_to_sigma(self.value, self.sigma, self.factor)[0]
        return number(self.value, self.factor, self.significant)


@dataclass(frozen=True)
class PValue:
    """A p-value: a terminal shows `< 0.001`, a page its exponent."""

    value: float | None

    def fixed(self) -> str:
        return short_probability(self.value)

    def on_page(self) -> str:
        return probability(self.value)


@dataclass(frozen=True)
class Cell:
    """A cell with what only a page shows: a smaller line under it, a mark, a bar, a link."""

    content: str | Number | PValue
    under: str = ""
    key: float | None = None  # orders the rows; by default the value of a number
    mark: str = ""
    bar: float | None = None  # -1 to 1, drawn next to the text
    link: str = ""

    def on_page(self) -> str:
        """Write the content for a page."""
        if not isinstance(self.content, str):
            return self.content.on_page()
        return MISSING if self.content == "-" else write_micro(self.content)


Row = Sequence[Cell | Number | PValue | str]
DIGITS = " digits"  # of a key in the rows of the workbench: how its number is written


@dataclass(frozen=True)
class Column:
    """A column's heading, its key in the rows of the workbench, and whether a terminal, HTML and
    printed HTML show it."""

    name: str
    key: str = ""
    on_terminal: bool = True
    in_html: bool = True
    on_paper: bool = True


@dataclass(frozen=True)
class Table:
    """Columns and rows; `kind` is a style of the page, `sorted_by` a column in descending order."""

    columns: Sequence[Column | str]
    rows: Sequence[Row]
    kind: str = ""
    sorted_by: str = ""

    def headings(self) -> list[Column]:
        return [one if isinstance(one, Column) else Column(one) for one in self.columns]


@dataclass(frozen=True)
class Detail:
    """A table or a sentence that a terminal shows only with this option; pages always show it."""

    block: Table | str
    option: str = "details"


Block = Table | Detail | str
MAX_REMARKS = 3  # about a verdict, before the details


@dataclass(frozen=True)
class Judgement:
    """A verdict: its `word` is a style of the page, its `label` is for people, the `summary` are at
    most two sentences. Each of the `remarks` is a sentence of its own."""

    word: str
    label: str
    summary: str
    remarks: Sequence[str] = ()

    def blocks(self) -> Iterator[Block]:
        """Yield a line for the verdict and one for each remark; after the third, as details."""
        yield f"{self.word}: {self.summary}"
        lines = [f"- {words}" for words in self.remarks]
        yield from lines[:MAX_REMARKS]
        yield from map(Detail, lines[MAX_REMARKS:])


@dataclass(frozen=True)
class Tile:
    """The rms errors of one model in large digits: (value, unit, kind) of each kind of error."""

    name: str
    values: Sequence[tuple[str, str, str]]
    about: str = "validation error"
    mark: str = ""


def as_cell(cell: Cell | Number | PValue | str) -> Cell:
    return cell if isinstance(cell, Cell) else Cell(cell)


def uncover(
    blocks: Iterable[Block], options: Collection[str] | None = None
) -> Iterator[Table | str]:
    """Yield tables and sentences, with the details of these options; None: with all details."""
    for block in blocks:
        if not isinstance(block, Detail):
            yield block
        elif options is None or block.option in options:
            yield block.block


def as_text(
    blocks: Iterable[Block],
    options: Collection[str] = (),
    width: int | None = None,
    paint: Paint = plain,
) -> str:
    """Render blocks for a terminal, with the details of `options`.

    With a width, lines are broken between words; without one, a sentence is one line.
    """
    return "\n".join(
        _as_columns(block, width, paint)
        if isinstance(block, Table)
        else block
        if width is None
        else "\n".join(wrap(block, width, "  "))
        for block in uncover(blocks, options)
    )


def _as_columns(table: Table, width: int | None, paint: Paint) -> str:
    headings = table.headings()
    rows = [
        [as_cell(cell) for heading, cell in zip(headings, row, strict=True) if heading.on_terminal]
        for row in table.rows
    ]
    texts = [
        [c.content if isinstance(c.content, str) else c.content.fixed() for c in row]
        for row in rows
    ]
    marks = [[cell.mark for cell in row] for row in rows]
    names = [heading.name for heading in headings if heading.on_terminal]
    return columns(names, texts, width, paint, marks)


def as_rows(table: Table) -> dict[str, Any]:
    """Render a table as JSON: `columns` of (key, heading), and `rows` that are dictionaries.

    Numbers and sort keys stay numbers, so that the page can sort them. Where that loses zeros (39
    of 39.0), the text has the key of its cell with ` digits`. The key of a small line is the key of
    its cell with ` details`.
    """
    headings = table.headings()
    keys = [heading.key or heading.name for heading in headings]
    rows = []
    for cells in table.rows:
        row: dict[str, Any] = {}
        for key, one in zip(keys, cells, strict=True):
            cell = as_cell(one)
            row[key] = cell.on_page() if cell.key is None else cell.key
            if isinstance(cell.content, Number):
                text = row[key]
                row[key] = None if text == MISSING else float(text)
                if text.endswith("0") and "." in text:
                    row[f"{key}{DIGITS}"] = text
            if isinstance(one, Cell):
                row[f"{key} details"] = write_micro(cell.under)
        rows.append(row)
    shown = [(k, write_micro(one.name)) for k, one in zip(keys, headings, strict=True)]
    return {"columns": shown, "rows": rows}
