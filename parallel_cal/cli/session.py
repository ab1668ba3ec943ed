"""A calibration that is kept in a folder: options are given once, steps can be undone."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from parallel_cal.cli.arguments import (
    Bags,
    Data,
    EffectName,
    Fix,
    Force,
    Free,
    Json,
    Method,
    ModelFile,
    Out,
    patterns,
    with_options,
)
from parallel_cal.cli.recordings import data_options
from parallel_cal.identification.options import FitOptions
from parallel_cal.reporting import console

if TYPE_CHECKING:
    from parallel_cal.session.history import State
    from parallel_cal.session.session import Session

app = typer.Typer(
    no_args_is_help=True,
    rich_markup_mode=None,
    help="A calibration kept in a folder: steps, undo and redo, branches, samples left out.",
)
Folder = Annotated[Path, typer.Argument(metavar="FOLDER", help="the session's folder")]
Samples = Annotated[list[int], typer.Argument(metavar="SAMPLE...", help="their numbers")]


def _open(folder: Path) -> Session:
    from parallel_cal.session.session import Session

    return Session(folder)


def _print_state(session: Session, state: State, as_json: bool) -> None:
    console.progress("", 1.0)
    if state.against:
        console.warn([state.against])
    if as_json:
        return console.emit(session.document())
    console.say(_line(state))


def _line(state: State) -> str:
    from parallel_cal.session.history import format_first_error

    left_out = "" if not state.excluded else f"; {len(state.excluded)} samples left out"
    if not state.errors:
        return f"{state.step}{left_out}"
    before, after, noise = map(format_first_error, (state.before, state.errors, state.noise))
    return (
        f"{state.step}: error at poses left out {before} to {after}, noise alone {noise}{left_out}"
    )


@with_options
def new(
    folder: Folder,
    model: ModelFile,
    bags: Bags,
    *,
    method: Method = "implicit",
    options: FitOptions,
    data: Data = None,
    as_json: Json = False,
) -> None:
    """Begin a session with a model and recordings; the options hold for every step."""
    from dataclasses import replace

    from parallel_cal.model.file.modelfile import read_model
    from parallel_cal.session.session import Session

    asked = replace(options, method=method)
    reading = data_options(data)
    session = Session.new(folder, read_model(model), bags, reading=reading, fitting=asked)
    if as_json:
        return console.emit(session.document())
    console.say(f"{folder}: {len(session.samples)} samples; parallel-cal session fit {folder}")


def show(folder: Folder, as_json: Json = False) -> None:
    """The steps of the branch, and the branches beside it."""
    from parallel_cal.session.history import History, format_first_error

    session = History(folder)
    if as_json:
        return console.emit(session.document())
    for state in session.history():
        console.say(_line(state))
        if state.verdict:
            console.say(f"  {state.verdict}")
    if len(session.record.branches) > 1:
        here = session.record.branch
        rows = [
            (("* " if name == here else "  ") + name, state.step, format_first_error(state.errors))
            for name, state in session.compared().items()
        ]
        console.table(("branch", "last step", "left out"), rows)


def fit(folder: Folder, free: Free = None, fix: Fix = None, as_json: Json = False) -> None:
    """Identify the model's free parameters; what is freed or fixed here holds from here on."""
    session = _open(folder)
    asked = {"free": free, "fix": fix}
    changed = {key: patterns(given) for key, given in asked.items() if given is not None}
    if changed:
        return _print_state(session, session.choose(console.progress, **changed), as_json)
    _print_state(session, session.fit(console.progress), as_json)


def plan(
    folder: Folder,
    poses: Annotated[int, typer.Option(min=1, help="how many to measure")] = 20,
    as_json: Json = False,
) -> None:
    """Choose poses to measure next, as a CSV in the session's folder."""
    file = _open(folder).plan(poses, console.progress)
    console.progress("", 1.0)
    if as_json:
        return console.emit({"output": str(file)})
    console.say(f"{file}: {poses} poses")


def add(folder: Folder, effect: EffectName, force: Force = False, as_json: Json = False) -> None:
    """Add an effect; refused when the error at poses left out does not fall."""
    session = _open(folder)
    _print_state(session, session.add(effect, console.progress, force), as_json)


def remove(folder: Folder, effect: EffectName, force: Force = False, as_json: Json = False) -> None:
    """Remove an effect; refused when the error at poses left out rises."""
    session = _open(folder)
    _print_state(session, session.remove(effect, console.progress, force), as_json)


def diagnose(folder: Folder, as_json: Json = False) -> None:
    """What is missing in the model; the verdict is kept with the state."""
    session = _open(folder)
    found = session.diagnose(console.progress)
    console.progress("", 1.0)
    if as_json:
        return console.emit(found.document())
    from parallel_cal.reporting import text

    console.say(text.show(found))


def exclude(
    folder: Folder,
    samples: Samples,
    reason: Annotated[str, typer.Option(help="why they do not count")] = "",
    as_json: Json = False,
) -> None:
    """Leave samples out, with a reason, and identify anew."""
    session = _open(folder)
    _print_state(
        session, session.exclude(dict.fromkeys(samples, reason), console.progress), as_json
    )


def include(folder: Folder, samples: Samples, as_json: Json = False) -> None:
    """Take back samples that were left out, and identify anew."""
    session = _open(folder)
    _print_state(session, session.include(samples, console.progress), as_json)


def undo(folder: Folder, as_json: Json = False) -> None:
    """One step back."""
    session = _open(folder)
    _print_state(session, session.undo(), as_json)


def redo(folder: Folder, as_json: Json = False) -> None:
    """Take the step again that was undone last."""
    session = _open(folder)
    _print_state(session, session.redo(), as_json)


def branch(
    folder: Folder,
    name: Annotated[str, typer.Argument(help="of the new branch")],
    as_json: Json = False,
) -> None:
    """Begin a branch here, to try something beside."""
    session = _open(folder)
    _print_state(session, session.start_branch(name), as_json)


def switch(
    folder: Folder,
    name: Annotated[str, typer.Argument(help="of the branch to go on with")],
    as_json: Json = False,
) -> None:
    """Go on with another branch."""
    session = _open(folder)
    _print_state(session, session.switch(name), as_json)


def save(folder: Folder, output: Out, force: Force = False, as_json: Json = False) -> None:
    """Write the model of the last step for the robot, unless the model in the file is better or
    something speaks against this one."""
    from parallel_cal.base.errors import ParallelCalError
    from parallel_cal.model.file.modelfile import model_hash
    from parallel_cal.session.saving import SaveRefused

    session = _open(folder)
    try:
        found = session.save(output, lambda _: force, console.progress)
    except SaveRefused as refused:
        raise ParallelCalError(f"{refused}; --force to write it all the same") from None
    console.progress("", 1.0)
    console.warn(found.objections)
    sha256 = model_hash(session.model)
    if as_json:
        written = {"output": str(output), "hash": sha256}
        return console.emit(written | found.document())
    words = f"{output} holds this model already" if found.is_in_use else f"written: {output}"
    console.say(f"{words} (sha256 {sha256[:12]})")
    if found.comparison:
        console.say(found.comparison)


for command in (
    new,
    show,
    fit,
    add,
    remove,
    diagnose,
    exclude,
    include,
    plan,
    undo,
    redo,
    branch,
    switch,
    save,
):
    app.command()(command)
