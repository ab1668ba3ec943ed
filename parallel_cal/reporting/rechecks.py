"""What a recheck decided, whether the robot has drifted since its calibration, for the page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from parallel_cal.base.confidence import format_percent
from parallel_cal.reporting.blocks import Judgement, Table

MIN_SHARE = 0.01  # of a part that is listed
# The style of the page for a verdict, and its words.
VERDICTS = {
    "unchanged": ("at_noise", "unchanged"),
    "device_moved": ("partly_explained", "device moved"),
    "drifted": ("partly_explained", "drifted"),
    "changed": ("unexplained", "robot or device"),
    "undecided": ("unexplained", "undecided"),
}


def describe_recheck(document: Mapping[str, Any], words: str) -> Judgement:
    """Describe what was decided, after how many samples, by the document of a `Recheck` and the
    sentence that it says."""
    style, label = VERDICTS[document["verdict"]]
    seen, first = document["looks"][-1]["samples"], document["decision"]
    when = f"Not decided by {seen} samples"
    if document["verdict"] not in ("changed", "undecided"):
        when = f"By {seen} samples"
        if first["verdict"] == document["verdict"]:
            when = f"Decided after {first['samples']} of {seen} samples"
    when = f"{when}, at a certainty of {format_percent(document['certainty'])}."
    return Judgement(style, label, f"{words[:1].upper()}{words[1:]}.", (when,))


def tabulate_parts(document: Mapping[str, Any]) -> Table:
    """Tabulate the probabilities of all that may have changed: nothing, and each part. No rows if
    it is decided that nothing has: that excludes the changes that count, not the smaller ones."""
    if document["verdict"] == "unchanged":
        return Table(("what changed", "probability"), ())
    nothing = float(document["probability"]["unchanged"])
    rows: list[Sequence[str]] = [("nothing", format_percent(nothing))]
    for part, share in document["parts"].items():
        if (p := float(share) * (1 - nothing)) >= MIN_SHARE:
            rows.append((part, format_percent(p)))
    return Table(("what changed", "probability"), rows)
