"""Where the model fails: in space, along everything recorded, in the samples, in a picture."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

from parallel_cal.reporting import spaces
from parallel_cal.reporting.markup import Cell, Document, Plot, paragraph, table
from parallel_cal.reporting.multiples import colour, multiples
from parallel_cal.reporting.readable import (
    number,
    percent,
    probability,
    shown_kinds,
    small,
    unit_of,
    vector,
    with_unit,
)

SHOWN = 400  # samples of a table, worst first
ALONG = (
    "Residuals of the model as it is, in sigmas of the noise: grey every one, coloured their "
    "rolling mean, the band where 99 % of such means lie if nothing depends on it. Of many windows "
    "a few leave the band by chance. Most striking first."
)
SWITCH = (
    '<p class="switch"><button type="button" value="0" aria-pressed="true">as it is</button>'
    '<button type="button" value="1" aria-pressed="false">with the effects found</button></p>'
)
COLOURS = "Colour is direction: red +x, green-yellow +y, cyan -x, violet -y; light up, dark down."


def in_space(document: Document, plot: Plot) -> str:
    """Residual arrows, and errors by octant of the workspace."""
    kind = document["residuals"]["kind"]
    drawn = spaces.residual_arrows(document["residuals"])
    if drawn is None:
        return paragraph("No pose was measured: there are no residuals in space.", "none")
    figure, scale = drawn
    switch = SWITCH if document["residuals"]["found"] else ""
    return (
        _legend(kind, scale, len(document["samples"]))
        + switch
        + plot(figure)
        + _regions(document["regions"])
    )


def _legend(kind: str, scale: float, count: int) -> str:
    """What the arrows are, their scale, and the wheel of directions."""
    what = (
        f"Measured minus predicted position, drawn {scale:g} times as long as it is."
        if kind == "position"
        else "Rotation from predicted to measured orientation (a vector about the base's axes), at "
        f"the platform's z axis on the unit sphere; 1 rad is drawn {scale:g} long."
    )
    if count > spaces.ARROWS:
        what += f" {spaces.ARROWS} of {count} samples are drawn."
    wheel = '<span class="wheel" aria-hidden="true"></span>'
    return f'<p class="note legend">{wheel}<span>{escape(f"{what} {COLOURS}")}</span></p>'


def _regions(rows: Sequence[Mapping[str, Any]]) -> str:
    """RMS errors of the workspace's octants, worst first."""
    if not rows:
        return ""
    listed = table(
        ("octant", "samples", "position rms", "orientation rms"),
        [
            (r["region"], str(r["samples"]), with_unit(r["position_rms"], "m"),
             with_unit(r["orientation_rms"], "rad"))
            for r in rows
        ],
    )  # fmt: skip
    title = f"By octant of the workspace about ({vector(rows[0]['middle'], 'm', 0)}) mm"
    return f"<details><summary>{title}</summary>{listed}</details>"


def along_everything(document: Document, plot: Plot) -> str:
    """Small multiples: joints, place, time, and every condition."""
    panels = "".join(
        f"<figure><figcaption><b>{escape(name)}</b> largest mean {strength:.1f} σ</figcaption>"
        f"{plot(figure)}</figure>"
        for name, strength, figure in multiples(document)
    )
    if not panels:
        return paragraph("Nothing varied that residuals could depend on.", "none")
    key = "".join(_key(name) for name in document["residuals"]["components"])
    return paragraph(ALONG, "note") + f'<p class="note">{key}</p><div class="grid">{panels}</div>'


def _key(name: str) -> str:
    return f'<span class="key"><i style="background:{colour(name)}"></i>{escape(name)}</span>'


def structure(document: Document, plot: Plot) -> str:
    """Tests of what is left, and the smooth map, labelled as what it is."""
    found = document["diagnosis"]["structure"]
    p = probability(found["p_value"])
    known = paragraph(
        f"Neighbours err alike, or signs change too seldom (p = {p})."
        if found["found"]
        else f"No structure is left that neighbours or runs would show (p = {p})."
    )
    drawn = spaces.smooth_map(document["map"])
    if drawn is None:
        return known + paragraph("There is no smooth map that predicts poses left out.", "none")
    figure, scale = drawn
    return known + paragraph(_caption(found, scale), "caution") + plot(figure)


def _caption(found: Mapping[str, Any], scale: float) -> str:
    position = found["kind"] == "position"
    over = f"{found['length_scale'] * 1e3:.3g} mm" if position else "the joints"
    return (
        "A picture, not physics: the smooth part of what is left, "
        f"{with_unit(found['size'], 'm' if position else 'rad')} rms over {over}; it predicts "
        f"{percent(found['share_predicted'])} of the variance at poses left out. Arrows are drawn "
        f"{scale:g} times as long as they are."
    )


def samples(document: Document) -> str:
    """Samples, worst first; sorted anew by a click on a column's head."""
    rows = document["samples"]
    note = f"{len(rows)} samples, worst first; errors at a fit that left the pose out."
    if len(rows) > SHOWN:
        note += f" The worst {SHOWN} are shown, all are in the JSON document."
    odd = [f"{row['sample']} ({row['odd']})" for row in rows if row["odd"]]
    note += f" Odd: {', '.join(odd)}." if odd else " No sample is odd."
    return paragraph(note, "note") + _samples(document)


def _samples(document: Document) -> str:
    units = document["provenance"]["joint_units"]
    of = {kind: unit_of(kind, units) for kind in shown_kinds(document["errors"])}
    names = {"now": "", "found": ", with effect"} if document["errors"]["found"] else {"now": ""}
    header = [
        "sample", "time [s]", "joints", "position [mm]",
        *(f"{k} [{small(u)[0]}]{name}" for name in names.values() for k, u in of.items()),
        *(f"sigmas{name}" for name in names.values()), "odd",
    ]  # fmt: skip
    rows = [_sample(row, of, list(names), units) for row in document["samples"][:SHOWN]]
    return table(header, rows, kind="sortable")


def _sample(
    row: Mapping[str, Any], of: Mapping[str, str], sides: Sequence[str], units: Mapping[str, str]
) -> list[Cell]:
    joints = [vector([q], u) for q, u in zip(row["joints"], units.values(), strict=True)]
    return [
        Cell(str(row["sample"]), key=row["sample"], mark="odd" if row["odd"] else ""),
        Cell(number(row["time"], 1.0, 4), key=row["time"]),
        Cell(" ".join(joints)),
        Cell(vector(row["position"], "m")),
        *(_error(row[side][kind], unit) for side in sides for kind, unit in of.items()),
        *(Cell(number(row[side]["sigmas"], 1.0, 2), key=row[side]["sigmas"]) for side in sides),
        Cell(row["odd"]),
    ]


def _error(value: float | None, unit: str) -> Cell:
    return Cell(number(value, small(unit)[1]), key=value)
