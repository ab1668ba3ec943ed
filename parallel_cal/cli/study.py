"""Commands that predict the accuracy of a design and the power of a measurement plan."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from parallel_cal.cli.arguments import (
    Also,
    Data,
    Fitting,
    Json,
    ModelFile,
    Scheduler,
    Workers,
    with_options,
)
from parallel_cal.cli.kinematics import At
from parallel_cal.cli.recordings import data_options
from parallel_cal.reporting import console

if TYPE_CHECKING:
    from parallel_cal.model.model import Model

app = typer.Typer(
    no_args_is_help=True,
    rich_markup_mode=None,
    help="Predict results by simulation. `tolerance` predicts the accuracy of a design, `power` "
    "what a measurement plan can detect.",
)
Seed = Annotated[int, typer.Option(min=0, help="seed of all random numbers")]


@app.command()
def tolerance(
    model: ModelFile,
    robots: Annotated[int, typer.Option(min=2, help="number of random robots")] = 200,
    poses: Annotated[int, typer.Option(min=1, help="number of poses per robot")] = 200,
    at: At = None,
    plan: Annotated[
        Path | None,
        typer.Option(
            metavar="PLAN.csv", help="also predict the error after calibration at its poses"
        ),
    ] = None,
    seed: Seed = 0,
    scheduler: Scheduler = None,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="folder for the page and the numbers")
    ] = None,
    as_json: Json = False,
) -> None:
    """Predict the accuracy of a design. Find the tolerance that contributes most."""
    from parallel_cal.kinematics.answers import parse_conditions
    from parallel_cal.model.file.modelfile import read_model
    from parallel_cal.reporting.studies import format_tolerances, tolerances_page
    from parallel_cal.study.planned_session import planned_joints
    from parallel_cal.study.tolerance import tolerances

    known = _with_noise(model) if plan else read_model(model)
    found = tolerances(
        known,
        robots,
        poses,
        seed=seed,
        at=parse_conditions(known, at or []),
        planned=None if plan is None else planned_joints(plan, known),
        scheduler=scheduler,
        progress=console.progress,
    )
    if output is not None:
        _write(output, "tolerance", found.document(), tolerances_page(found))
    if as_json:
        return console.emit(found.document())
    console.write(format_tolerances(found, console.width(sys.stdout)))
    if output is not None:
        console.say(f"written: {output / 'tolerance.html'}")


@app.command()
@with_options
def power(
    plan: Annotated[
        Path,
        typer.Argument(metavar="PLAN", help="poses written by 'plan' (.csv), or a recording"),
    ],
    model: ModelFile,
    *,
    effect: Annotated[
        list[str] | None, typer.Option(help="simulate only this effect (repeat for several)")
    ] = None,
    also: Also = None,
    pace: Annotated[
        float, typer.Option(min=0.1, help="time between two poses of a plan (s)")
    ] = 1.5,
    sessions: Annotated[
        int, typer.Option(min=2, help="number of simulated sessions for each size")
    ] = 10,
    seed: Seed = 0,
    scheduler: Scheduler = None,
    workers: Workers = None,
    options: Fitting,
    data: Data = None,
    output: Annotated[
        Path,
        typer.Option(
            "-o", "--output", help="folder for the simulated sessions, the page and the numbers"
        ),
    ] = Path("power"),
    as_json: Json = False,
) -> None:
    """Predict which effects a measuring session can detect. Find their smallest detectable size.
    An interrupted command can be resumed."""
    from parallel_cal.model.file.modelfile import dump_model
    from parallel_cal.reporting.studies import format_power, power_page
    from parallel_cal.study import power as studies
    from parallel_cal.study.planned_session import planned_session
    from parallel_cal.study.session import Question

    known = _with_noise(model)
    planned = planned_session(plan, known, data_options(data), pace)
    question = Question(dump_model(known), planned, options, tuple(also or ()), seed)
    with console.bar() as progress:
        try:
            found = studies.power(
                question,
                effect or (),
                sessions,
                folder=output,
                scheduler=scheduler,
                workers=workers,
                progress=progress,
            )
        except KeyboardInterrupt:
            console.note(console.STOPPED)
            raise typer.Exit(130) from None
    _write(output, "power", found.document(), power_page(found))
    if as_json:
        return console.emit(found.document())
    console.write(format_power(found, console.width(sys.stdout)))
    console.say(f"written: {output / 'power.html'}")


def _with_noise(path: Path) -> Model:
    """Read the model; if it states no noise, assume typical values and print a note."""
    from parallel_cal.model.file.modelfile import read_model
    from parallel_cal.recordings.simulate import with_noise

    own = read_model(path)
    known = with_noise(own)
    if known.noise != own.noise:
        console.note(
            f"{path} states no noise of the joints or the device: typical values are assumed"
        )
    return known


def _write(folder: Path, name: str, document: dict[str, Any], page: str) -> None:
    import json

    from parallel_cal.base.documents import to_json_value
    from parallel_cal.base.files import write_atomically

    folder.mkdir(parents=True, exist_ok=True)
    write_atomically(folder / f"{name}.json", json.dumps(to_json_value(document), allow_nan=False))
    write_atomically(folder / f"{name}.html", page)
