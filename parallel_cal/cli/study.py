"""What a design, and a plan, are worth before anything is built or measured."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from parallel_cal.cli.arguments import (
    Also,
    Data,
    Json,
    ModelFile,
    Scheduler,
    Workers,
    with_options,
)
from parallel_cal.cli.kinematics import At
from parallel_cal.cli.recordings import data_options
from parallel_cal.identification.options import FitOptions
from parallel_cal.reporting import console

if TYPE_CHECKING:
    from parallel_cal.model.model import Model

app = typer.Typer(
    no_args_is_help=True,
    rich_markup_mode=None,
    help="What a design, and a plan of poses, are worth: by virtual robots.",
)
Seed = Annotated[int, typer.Option(min=0, help="of all that is drawn")]


@app.command()
def tolerance(
    model: ModelFile,
    robots: Annotated[int, typer.Option(min=2, help="how many are drawn")] = 200,
    poses: Annotated[int, typer.Option(min=1, help="in the workspace, each robot's")] = 200,
    at: At = None,
    plan: Annotated[
        Path | None,
        typer.Option(metavar="PLAN.csv", help="say what a calibration at its poses would leave"),
    ] = None,
    seed: Seed = 0,
    scheduler: Scheduler = None,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="folder for page and numbers")
    ] = None,
    as_json: Json = False,
) -> None:
    """Say what accuracy a design will have, and which tolerance costs most."""
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
    console.say(format_tolerances(found))
    if output is not None:
        console.say(f"written: {output / 'tolerance.html'}")


@app.command()
@with_options
def power(
    plan: Annotated[
        Path,
        typer.Argument(metavar="PLAN", help="poses that 'plan' wrote (.csv), or a recording's"),
    ],
    model: ModelFile,
    *,
    effect: Annotated[
        list[str] | None, typer.Option(help="plant only this effect (repeat for several)")
    ] = None,
    also: Also = None,
    pace: Annotated[
        float, typer.Option(min=0.1, help="s from one pose of a plan to the next")
    ] = 1.5,
    sessions: Annotated[int, typer.Option(min=2, help="with an effect of each size")] = 10,
    seed: Seed = 0,
    scheduler: Scheduler = None,
    workers: Workers = None,
    options: FitOptions,
    data: Data = None,
    output: Annotated[
        Path, typer.Option("-o", "--output", help="folder for sessions, page and numbers")
    ] = Path("power"),
    as_json: Json = False,
) -> None:
    """Say which effects of which size a session would find; a command that was ended goes on."""
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
    console.say(format_power(found))
    console.say(f"written: {output / 'power.html'}")


def _with_noise(path: Path) -> Model:
    """The model, with typical instruments' noise where it states none, which is said."""
    from parallel_cal.model.file.modelfile import read_model
    from parallel_cal.recordings.simulate import with_noise

    own = read_model(path)
    known = with_noise(own)
    if known.noise != own.noise:
        console.note(f"{path} states no noise of joints or device: typical instruments are taken")
    return known


def _write(folder: Path, name: str, document: dict[str, Any], page: str) -> None:
    import json

    from parallel_cal.base.documents import to_json_value
    from parallel_cal.base.files import write_atomically

    folder.mkdir(parents=True, exist_ok=True)
    write_atomically(folder / f"{name}.json", json.dumps(to_json_value(document), allow_nan=False))
    write_atomically(folder / f"{name}.html", page)
