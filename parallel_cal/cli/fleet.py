"""The command that judges every recording of a fleet, on this machine or on a cluster."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from parallel_cal.cli.arguments import (
    Also,
    Data,
    Fitting,
    Json,
    Scheduler,
    Tested,
    Workers,
    with_options,
)
from parallel_cal.cli.recordings import data_options
from parallel_cal.reporting import console

if TYPE_CHECKING:
    from parallel_cal.fleet.judging import Row


@with_options
def fleet(
    robots: Annotated[
        Path,
        typer.Argument(
            metavar="FOLDER|LIST.csv",
            help="a folder with one folder per robot (model and recordings), or a CSV file with "
            "the columns robot, model and recording; add the column time if the recordings have "
            "no time",
        ),
    ],
    *,
    output: Annotated[Path, typer.Option("-o", "--output", help="folder to write")] = Path("fleet"),
    scheduler: Scheduler = None,
    workers: Workers = None,
    effect: Tested = None,
    also: Also = None,
    options: Fitting,
    data: Data = None,
    as_json: Json = False,
) -> None:
    """Fit and diagnose every recording of every robot. An interrupted command can be resumed."""
    from parallel_cal.fleet.fleet import judge
    from parallel_cal.fleet.jobs import FleetOptions
    from parallel_cal.reporting.fleet_page import robot_page, write_fleet_page

    asked = FleetOptions(options, tuple(effect or ()), tuple(also or ()), data_options(data))
    with console.bar() as progress:

        def warn_of_failure(row: Row) -> None:
            if row["reason"]:
                console.warn([f"{row['robot']} {row['recording']}: {row['reason']}"])

        try:
            found = judge(
                robots,
                output,
                asked,
                scheduler=scheduler,
                workers=workers,
                page=robot_page,
                progress=progress,
                on_row=warn_of_failure,
            )
        except KeyboardInterrupt:
            console.note(console.STOPPED)
            raise typer.Exit(130) from None
    write_fleet_page(found, output)
    if as_json:
        return console.emit(found.document() | {"output": str(output)})
    from parallel_cal.reporting.fleets import format_fleet

    console.say(format_fleet(found))
    console.say(f"written: {output / 'fleet.html'}")
