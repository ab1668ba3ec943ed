"""Pieces of HTML; all texts are escaped."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from html import escape
from itertools import compress
from typing import Any

from parallel_cal.reporting.blocks import (
    Block,
    Cell,
    Column,
    Judgement,
    Number,
    Row,
    Table,
    Tile,
    as_cell,
    uncover,
)
from parallel_cal.reporting.readable import is_known, write_micro

BLANK = ' class="blank"'
SORTED = ' aria-sort="descending"'
ON_SCREEN = ' class="on-screen"'  # not printed
Plot = Callable[[Mapping[str, Any]], str]  # keeps a figure for the page, returns its place in it


def as_html(blocks: Iterable[Block]) -> str:
    """Render blocks: a sentence is a paragraph, a table has a box that scrolls."""
    return "".join(
        paragraph(block) if isinstance(block, str) else _render_table(block)
        for block in uncover(blocks)
    )


def table(
    header: Sequence[Column | str],
    rows: Iterable[Row],
    kind: str = "",
    sorted_by: str = "",
) -> str:
    """Make a table that only pages show."""
    return _render_table(Table(header, [*rows], kind, sorted_by))


def _render_table(block: Table) -> str:
    shown = [one.in_html for one in block.headings()]
    columns = [one for one in block.headings() if one.in_html]
    head = "".join(
        f'<th scope="col"{SORTED if write_micro(one.name) == block.sorted_by else ""}'
        f"{'' if one.on_paper else ON_SCREEN}>{escape(write_micro(one.name))}</th>"
        for one in columns
    )
    body = "".join(
        "<tr>" + "".join(map(_render_cell, map(as_cell, compress(row, shown)), columns)) + "</tr>"
        for row in block.rows
    )
    return (
        f'<div class="box {block.kind}" tabindex="0"><table><thead><tr>{head}</tr></thead>'
        f"<tbody>{body}</tbody></table></div>"
    )


def _render_cell(cell: Cell, column: Column) -> str:
    """Render a cell, with the column's name for pages too narrow for columns."""
    label = write_micro(column.name)
    value = cell.content.value if isinstance(cell.content, Number) else cell.key
    key = f' data-key="{value:.9g}"' if is_known(value) else ""
    mark = f' class="{escape(cell.mark)}"' if cell.mark else "" if column.on_paper else ON_SCREEN
    bar = ""
    if is_known(cell.bar):
        wide = 50 * min(abs(cell.bar), 1.0)
        left = 50.0 if cell.bar > 0 else 50.0 - wide
        bar = f'<i class="bar"><i style="left:{left:.0f}%;width:{wide:.0f}%"></i></i>'
    # A notebook has no style sheet.
    under = (
        f'<small style="display:block">{escape(write_micro(cell.under))}</small>'
        if cell.under
        else ""
    )
    text = escape(cell.on_page())
    if isinstance(cell.content, Number) and cell.content.unit and is_known(cell.content.value):
        text = f"{text} {escape(cell.content.unit)}"
    text = f'<a href="{escape(cell.link)}">{text}</a>' if cell.link else text
    return f'<td data-label="{escape(label)}"{key}{mark}>{text}{bar}{under}</td>'


def chip(judgement: Judgement) -> str:
    """Render the word of a verdict on a colour of its own."""
    return f'<span class="badge {escape(judgement.word)}">{escape(judgement.label)}</span>'


def tiles(shown: Iterable[Tile]) -> str:
    """Render errors in large digits, side by side."""
    return f'<div class="tiles">{"".join(map(_render_tile, shown))}</div>'


def _render_tile(tile: Tile) -> str:
    values = "".join(
        f"<dd>{escape(value)}<span>{escape(unit)}</span><em>{escape(kind)}</em></dd>"
        for value, unit, kind in tile.values
    )
    return f'<dl class="{tile.mark}"><dt>{escape(tile.name)}</dt>{values}</dl>'


def section(title: str, content: str, about: str = "", closed: bool = False) -> str:
    """Make a part of the page that folds; `about` is a remark next to its title."""
    name = "-".join(title.lower().replace(",", "").split())
    remark = f"<span>{escape(about)}</span>" if about else ""
    head = f"<summary><h2>{escape(title)}</h2>{remark}</summary>"
    folded = f"<details{'' if closed else ' open'}>{head}{content}</details>"
    return f'<section id="{name}">{folded}</section>'


def tabs(pages: Mapping[str, str], titled: bool = False) -> str:
    """Make tabs from pages by title; a single page needs no tabs. On paper all pages are printed,
    each below its title, unless they are `titled` themselves."""
    if len(pages) < 2:
        return "".join(pages.values())
    buttons = "".join(
        f'<button type="button" role="tab" aria-selected="{str(not k).lower()}">'
        f"{escape(title)}</button>"
        for k, title in enumerate(pages)
    )
    heads = ["" if titled else f'<h4 class="more">{escape(title)}</h4>' for title in pages]
    shown = "".join(
        f'<div role="tabpanel"{" hidden" if k else ""}>{head}{content}</div>'
        for k, (head, content) in enumerate(zip(heads, pages.values(), strict=True))
    )
    return f'<div class="tabs"><p role="tablist">{buttons}</p>{shown}</div>'


def folded(title: str, content: str) -> str:
    """Make a closed part that a click opens."""
    return f"<details><summary>{escape(title)}</summary>{content}</details>"


def figure(drawn: str, title: str = "", caption: str = "") -> str:
    """Make a figure of what was drawn, with its title and caption above; a printed page does not
    separate them."""
    name = f"<b>{escape(title)}</b> " if title else ""
    above = f"<figcaption>{name}{escape(write_micro(caption))}</figcaption>"
    return f"<figure>{above if title or caption else ''}{drawn}</figure>"


def paragraph(text: str, kind: str = "") -> str:
    mark = f' class="{kind}"' if kind else ""
    return f"<p{mark}>{escape(write_micro(text))}</p>"


def items(texts: Iterable[str]) -> str:
    """Make a list; an empty string if there are no texts."""
    listed = "".join(f"<li>{escape(write_micro(text))}</li>" for text in texts)
    return f"<ul>{listed}</ul>" if listed else ""


def facts(rows: Mapping[str, str]) -> str:
    """Make a list of names and values; an empty value is a line to write on."""
    listed = "".join(
        f"<dt>{escape(k)}</dt><dd{'' if v else BLANK}>{escape(v)}</dd>" for k, v in rows.items()
    )
    return f'<dl class="facts">{listed}</dl>'


def micro(text: str) -> str:
    """Write um as µm, and end with a full stop."""
    return write_micro(text.rstrip(".")) + "."


def sentence(text: str) -> str:
    """Make a sentence of a message: capital letter, µm, full stop. A name that people type, such as
    `joint_compliance`, stays as it is."""
    is_typed = "_" in text.partition(" ")[0]
    return micro(text) if is_typed else text[:1].upper() + micro(text[1:])
