"""The command for the short-cut set-up: identify a Delta from loops of its own arms and rods."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from parallel_cal.base.units import ARCMIN
from parallel_cal.cli.arguments import (
    Bags,
    JointSigma,
    Json,
    ModelFile,
    OptionalOut,
    patterns,
)
from parallel_cal.cli.calibration import read_model_and_data
from parallel_cal.reporting import console
from parallel_cal.reporting.readable import format_fixed, in_unit


def short_cut(
    model: ModelFile,
    bags: Bags,
    output: OptionalOut = None,
    fix: Annotated[
        list[str] | None,
        typer.Option(
            "--fix", help="do not identify the parameters that match this wildcard (chain1.*)"
        ),
    ] = None,
    joint_sigma: JointSigma = None,
    data: Annotated[
        list[str] | None,
        typer.Option("--data", help="option for reading the recording, KEY=VALUE (exclude=3,17)"),
    ] = None,
    as_json: Json = False,
) -> None:
    """Identify a Delta without a measuring device.

    In this set-up, one rod joins two arms, so that they form a closed loop. The topic `constraint`
    names the loop as BALL:BALL:ROD. Each of the three is the number of a chain, then 1 or 2 for the
    first or second ball or rod of this chain. So 12:21:11 means: ball 2 on the arm of chain 1 and
    ball 1 on the arm of chain 2, joined by rod 1 of chain 1. Angles do not determine the size of
    the robot. Fix lengths that you measured: --fix chain1.Lb --fix chain1.dLb.
    """
    from parallel_cal.model.file.modelfile import model_hash, replace_model
    from parallel_cal.short_cut import identify
    from parallel_cal.short_cut.loop import split_by_loop

    robot, dataset = read_model_and_data(model, bags, data)
    loops = split_by_loop(dataset)
    found = identify.short_cut(robot, loops, fix=patterns(fix), joint_sigma=joint_sigma)
    document = found.document()
    if output is not None:
        replace_model(found.model, output)
        document |= {"output": str(output), "hash": model_hash(found.model)}
    console.progress("", 1.0)
    console.warn((*dataset.warnings, *found.warnings))
    if as_json:
        return console.emit(document)
    _show(document)


def _show(document: dict[str, Any]) -> None:
    console.say(
        f"{document['rank']} of {document['free']} free parameters identified, chi2/dof "
        f"{format_fixed(document['chi2_per_dof'])}; rms error of each loop's second arm:"
    )
    header = ("loop", "samples", "rank of 9", "before [arcmin]", "after [arcmin]")
    rows = [
        (
            k["loop"],
            str(k["samples"]),
            str(k["rank"]),
            *(format_fixed(k[when]["orientation_rms"], 1 / ARCMIN) for when in ("before", "after")),
        )
        for k in document["loops"]
    ]
    console.table(header, rows)
    rows = []
    for name, p in document["parameters"].items():
        if not p["fixed"]:
            value, unit = in_unit(p["value"], p["unit"])
            sigma, _ = in_unit(p["sigma"], p["unit"])
            rows.append((name, value, sigma, unit, format_fixed(p["moved_tolerances"])))
    console.table(("parameter", "value", "sigma", "unit", "moved [tolerances]"), rows)
    if "output" in document:
        console.say(f"written: {document['output']} (sha256 {document['hash'][:12]})")
