"""What is missing: the diagnosis for people and programs."""

from __future__ import annotations

from typing import Any

from parallel_cal.cli.arguments import (
    Also,
    Bags,
    Data,
    Json,
    ModelFile,
    Tested,
    with_options,
)
from parallel_cal.cli.calibration import model_and_data, show_errors
from parallel_cal.identification.options import FitOptions
from parallel_cal.reporting import console

SHOWN = 8  # candidates that a person reads


@with_options
def diagnose(
    model: ModelFile,
    bags: Bags,
    *,
    effect: Tested = None,
    also: Also = None,
    options: FitOptions,
    data: Data = None,
    as_json: Json = False,
) -> None:
    """Say which physical effect the model lacks, how sure that is, and what to measure next."""
    from parallel_cal.diagnosis import diagnose as diagnosis

    judged, dataset = model_and_data(model, bags, data)
    document = diagnosis.diagnose(
        judged, dataset, effects=effect or (), also=also or (), options=options,
        progress=console.progress,
    ).document()  # fmt: skip
    console.progress("", 1.0)
    console.warn(document["warnings"])
    if as_json:
        return console.emit(document)
    console.say(f"{document['verdict']}: {document['summary']}")
    columns = {
        "left out, as it is": document["baseline"],
        "left out, with it": document["best"],
    }
    show_errors(columns, document["noise"]["floor"], judged)
    _show_candidates(document["candidates"])
    _show_odd(document["odd_samples"])
    _show_next(document["measure_next"])


def _show_candidates(candidates: list[dict[str, Any]]) -> None:
    tested = [c for c in candidates if c["p_adjusted"] is not None][:SHOWN]
    header = ("effect", "p", "left out", "explains", "first pick", "not geometry", "confused with")
    console.table(
        header,
        [
            (
                c["effect"],
                _probability(c["p_adjusted"]),
                console.number(c.get("holdout_ratio"), 100, 1) + " %",
                console.number(c["share_explained"], 100, 0) + " %",
                console.number(c["first_picks"], 100, 0) + " %",
                console.number(c["remaining_after_geometry"], 100, 0) + " %",
                ", ".join(c["confused_with"]),
            )
            for c in tested
        ],
    )
    for c in candidates:
        if c["missing_conditions"] or (c["reason"] and (c in tested or c["p_value"] is not None)):
            console.say(f"{c['effect']}: {c['reason']}")


def _probability(p: float) -> str:
    return f"{p:.2g}" if p > 1e-99 else "0"


def _show_odd(odd: list[dict[str, Any]]) -> None:
    for row in odd[:SHOWN]:
        what, number = "outlier" if row["outlier"] else "influential", row["sample"]
        console.say(
            f"{what}: sample {number} at {row['time']:.1f} s, {row['sigmas']:.1f} sigmas, Cook's "
            f"distance {row['cooks_distance']:.2f} (--data exclude={number} leaves it out)"
        )


def _show_next(following: dict[str, Any]) -> None:
    for advice in following["advice"]:
        console.say(f"measure next: {advice}")
    if plan := following["plan"]:
        now, then = (plan["sigmas"][key] for key in ("now", "then"))
        console.say(
            f"{len(plan['poses'])} planned poses (--json) would tell "
            f"{' from '.join(plan['separates'])} by {then:.1f} sigmas; now {now:.1f}"
        )
