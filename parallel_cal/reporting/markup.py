"""Pieces of HTML; whatever comes from a file is escaped."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

from parallel_cal.reporting.readable import known

Plot = Callable[[Mapping[str, Any]], str]  # keeps a figure for the page, returns its place in it


@dataclass(frozen=True)
class Cell:
    """A cell's text, a smaller line under it, and the number that it is sorted by."""

    text: str
    under: str = ""
    key: float | None = None
    mark: str = ""

    def html(self) -> str:
        key = f' data-key="{self.key:.9g}"' if known(self.key) else ""
        mark = f' class="{escape(self.mark)}"' if self.mark else ""
        under = f"<small>{escape(self.under)}</small>" if self.under else ""
        return f"<td{key}{mark}>{escape(self.text)}{under}</td>"


def table(header: Sequence[str], rows: Iterable[Sequence[Cell | str]], kind: str = "") -> str:
    """A table in a box that scrolls by itself."""
    head = "".join(f'<th scope="col">{escape(name)}</th>' for name in header)
    body = "".join(
        "<tr>" + "".join((c if isinstance(c, Cell) else Cell(c)).html() for c in row) + "</tr>"
        for row in rows
    )
    return (
        f'<div class="box {kind}" tabindex="0"><table><thead><tr>{head}</tr></thead>'
        f"<tbody>{body}</tbody></table></div>"
    )


def section(title: str, content: str) -> str:
    name = "-".join(title.lower().replace(",", "").split())
    return f'<section id="{name}"><h2>{escape(title)}</h2>{content}</section>'


def paragraph(text: str, kind: str = "") -> str:
    mark = f' class="{kind}"' if kind else ""
    return f"<p{mark}>{escape(text)}</p>"


def items(texts: Iterable[str]) -> str:
    """A list; nothing where there are no texts."""
    listed = "".join(f"<li>{escape(text)}</li>" for text in texts)
    return f"<ul>{listed}</ul>" if listed else ""


def facts(rows: Mapping[str, str]) -> str:
    listed = "".join(f"<dt>{escape(k)}</dt><dd>{escape(v)}</dd>" for k, v in rows.items())
    return f'<dl class="facts">{listed}</dl>'


def micro(text: str) -> str:
    """A sentence of the library's, in ASCII, with its um as µm and a full stop."""
    return re.sub(r"(?<=\d) um\b", " µm", text.rstrip(".")) + "."


def sentence(text: str) -> str:
    return text[:1].upper() + micro(text[1:])
