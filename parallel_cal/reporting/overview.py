"""What is read first: the verdict, the big numbers, how the error fell."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

from parallel_cal.reporting import figures
from parallel_cal.reporting.markup import Document, Plot, micro, paragraph
from parallel_cal.reporting.readable import number, shown_kinds, small, unit_of

LABELS = {
    "at_noise": "at the noise",
    "explained": "explained",
    "partly_explained": "partly explained",
    "unexplained": "unexplained",
    "cannot_know": "cannot know",
}


def verdict(document: Document) -> str:
    """The badge and the sentence."""
    found = document["diagnosis"]
    word = found["verdict"]
    badge = f'<span class="badge {escape(word)}">{escape(LABELS[word])}</span>'
    words = f'<p class="verdict">{badge} {escape(micro(found["summary"]))}</p>'
    return f'<section id="verdict">{words}</section>'


def numbers(document: Document) -> str:
    """Error before, now, with the effects found, and of noise alone: big, with units."""
    errors, units = document["errors"], document["provenance"]["joint_units"]
    kinds = shown_kinds(errors)
    tiles = [
        _tile("before calibration", errors["before"], kinds, units),
        _tile("now", errors["now"], kinds, units),
    ]
    if errors["found"]:
        effects = " and ".join(document["diagnosis"]["effects"])
        tiles.append(_tile(f"with {effects}", errors["found"], kinds, units, "found"))
    if any(v is not None for v in errors["noise"].values()):  # else nobody knows it
        tiles.append(_tile("noise alone", errors["noise"], kinds, units))
    note = paragraph("RMS of the error's norm at poses left out of the fit.", "note")
    return f'<section id="numbers"><div class="tiles">{"".join(tiles)}</div>{note}</section>'


def _tile(
    name: str, e: Mapping[str, Any], kinds: Sequence[str], units: Mapping[str, str], mark: str = ""
) -> str:
    values = "".join(_value(e, kind, unit_of(kind, units)) for kind in kinds)
    return f'<dl class="{mark}"><dt>{escape(name)}</dt>{values}</dl>'


def _value(e: Mapping[str, Any], kind: str, si: str) -> str:
    unit, factor = small(si)
    value = number(e.get(f"{kind}_rms"), factor)
    return f"<dd>{value}<span>{escape(unit)}</span><em>{escape(kind)}</em></dd>"


def history(document: Document, plot: Plot) -> str:
    """The falling error, a chart for each kind."""
    floor, units = document["errors"]["noise"], document["provenance"]["joint_units"]
    charts = [
        figures.history(document["history"], floor, kind, "noise alone", unit_of(kind, units))
        for kind in shown_kinds(document["errors"])
    ]
    if not charts:
        return paragraph("No error can be given: nothing was measured that tells.", "none")
    note = "Error at poses left out, step by step; on average it cannot fall below the noise."
    if len({row["sha256"] for row in document["history"]}) > 1:
        note += " The steps were judged on different data: point at one to see which."
    drawn = "".join(f"<div>{plot(chart)}</div>" for chart in charts)
    return paragraph(note, "note") + f'<div class="pair">{drawn}</div>'
