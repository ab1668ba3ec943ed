"""Pieces of HTML; all texts are escaped."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

from parallel_cal.reporting.readable import is_known

SORTED = ' aria-sort="descending"'
Plot = Callable[[Mapping[str, Any]], str]  # keeps a figure for the page, returns its place in it


@dataclass(frozen=True)
class Cell:
    """A cell's text, a smaller line under it, its sort key, and its link."""

    text: str
    under: str = ""
    key: float | None = None
    mark: str = ""
    bar: float | None = None  # -1 to 1, drawn beside the text
    link: str = ""

    def html(self, label: str = "") -> str:
        """As HTML; `label` is the column's name for pages too narrow for columns."""
        label = f' data-label="{escape(label)}"' if label else ""
        key = f' data-key="{self.key:.9g}"' if is_known(self.key) else ""
        mark = f' class="{escape(self.mark)}"' if self.mark else ""
        bar = ""
        if is_known(self.bar):
            wide = 50 * min(abs(self.bar), 1.0)
            left = 50.0 if self.bar > 0 else 50.0 - wide
            bar = f'<i class="bar"><i style="left:{left:.0f}%;width:{wide:.0f}%"></i></i>'
        under = f"<small>{escape(write_micro(self.under))}</small>" if self.under else ""
        text = escape(self.text)
        text = f'<a href="{escape(self.link)}">{text}</a>' if self.link else text
        return f"<td{label}{key}{mark}>{text}{bar}{under}</td>"


def table(
    header: Sequence[str],
    rows: Iterable[Sequence[Cell | str]],
    kind: str = "",
    sorted_by: str = "",
) -> str:
    """Make a table in a box that scrolls; `sorted_by` is the column with descending values."""
    head = "".join(
        f'<th scope="col"{SORTED if name == sorted_by else ""}>{escape(name)}</th>'
        for name in header
    )
    cells = ([c if isinstance(c, Cell) else Cell(c) for c in row] for row in rows)
    body = "".join(
        "<tr>" + "".join(c.html(name) for c, name in zip(row, header, strict=True)) + "</tr>"
        for row in cells
    )
    return (
        f'<div class="box {kind}" tabindex="0"><table><thead><tr>{head}</tr></thead>'
        f"<tbody>{body}</tbody></table></div>"
    )


def section(title: str, content: str, about: str = "", closed: bool = False) -> str:
    """Make a part of the page that folds; `about` is a remark next to its title."""
    name = "-".join(title.lower().replace(",", "").split())
    remark = f"<span>{escape(about)}</span>" if about else ""
    head = f"<summary><h2>{escape(title)}</h2>{remark}</summary>"
    folded = f"<details{'' if closed else ' open'}>{head}{content}</details>"
    return f'<section id="{name}">{folded}</section>'


def tabs(pages: Mapping[str, str]) -> str:
    """Make tabs from pages by title; a single page needs no tabs."""
    if len(pages) < 2:
        return "".join(pages.values())
    buttons = "".join(
        f'<button type="button" role="tab" aria-selected="{str(not k).lower()}">'
        f"{escape(title)}</button>"
        for k, title in enumerate(pages)
    )
    shown = "".join(
        f'<div role="tabpanel"{" hidden" if k else ""}>{content}</div>'
        for k, content in enumerate(pages.values())
    )
    return f'<div class="tabs"><p role="tablist">{buttons}</p>{shown}</div>'


def folded(title: str, content: str) -> str:
    """Make a closed part that a click opens."""
    return f"<details><summary>{escape(title)}</summary>{content}</details>"


def paragraph(text: str, kind: str = "") -> str:
    mark = f' class="{kind}"' if kind else ""
    return f"<p{mark}>{escape(write_micro(text))}</p>"


def items(texts: Iterable[str]) -> str:
    """Make a list; an empty string if there are no texts."""
    listed = "".join(f"<li>{escape(write_micro(text))}</li>" for text in texts)
    return f"<ul>{listed}</ul>" if listed else ""


def facts(rows: Mapping[str, str]) -> str:
    listed = "".join(f"<dt>{escape(k)}</dt><dd>{escape(v)}</dd>" for k, v in rows.items())
    return f'<dl class="facts">{listed}</dl>'


def write_micro(text: str) -> str:
    """Write um as µm: the library's messages are ASCII, a page is not."""
    return re.sub(r"(?<=\d) um\b", " µm", text)


def micro(text: str) -> str:
    """Write um as µm, and end with a full stop."""
    return write_micro(text.rstrip(".")) + "."


def sentence(text: str) -> str:
    """Make a sentence of a message: capital letter, µm, full stop."""
    return text[:1].upper() + micro(text[1:])
