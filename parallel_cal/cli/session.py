"""Commands of a workbench session: a calibration in a folder, whose steps can be undone."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from parallel_cal.cli.arguments import (
    AddedEffects,
    Bags,
    Data,
    EffectName,
    EffectsInModel,
    FittingByMethod,
    Fix,
    Free,
    Json,
    ModelFile,
    Out,
    patterns,
    with_options,
)
from parallel_cal.cli.recordings import data_options
from parallel_cal.cli.reporting import (
    CertificateField,
    CertificateFile,
    PdfFile,
    ReportFile,
    write_report,
)
from parallel_cal.reporting import console

if TYPE_CHECKING:
    from parallel_cal.reporting.certificate import CertificateFields
    from parallel_cal.reporting.report import Report
    from parallel_cal.session.history import State
    from parallel_cal.session.session import Session

app = typer.Typer(
    no_args_is_help=True,
    rich_markup_mode=None,
    help="Calibrate in steps, which can be undone. A folder keeps the steps, the branches and the "
    "excluded samples.",
)
Folder = Annotated[Path, typer.Argument(metavar="FOLDER", help="the session's folder")]
Reason = Annotated[
    str, typer.Option(help="why you force it; the history of session and model keeps it")
]
Samples = Annotated[list[int], typer.Argument(metavar="SAMPLE...", help="numbers of the samples")]


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
    if state.drift:
        console.say(f"  {state.drift}")


def _check_reason(reason: str, force: bool) -> None:
    if reason and not force:
        raise typer.BadParameter(f"--reason '{reason}' is the reason for --force: give both")


def _line(state: State) -> str:
    from parallel_cal.session.history import format_first_error

    n = len(state.excluded)
    excluded = f"; {n} excluded sample{'' if n == 1 else 's'}" if n else ""
    if not state.errors:
        return f"{state.step}{excluded}"
    before, after, noise = map(format_first_error, (state.before, state.errors, state.noise))
    change = f"{before} to {after}" if state.before else after
    count = "" if state.samples is None else f" ({state.samples} samples)"
    return f"{state.step}: validation error {change}{count}, noise floor {noise}{excluded}"


@with_options
def new(
    folder: Folder,
    model: ModelFile,
    bags: Bags,
    *,
    options: FittingByMethod,
    data: Data = None,
    as_json: Json = False,
) -> None:
    """Start a session with a model and recordings. The options apply to every step."""
    from parallel_cal.model.file.modelfile import read_model
    from parallel_cal.session.session import Session

    reading = data_options(data)
    session = Session.new(folder, read_model(model), bags, reading=reading, fitting=options)
    if as_json:
        return console.emit(session.document())
    console.say(
        f"{folder}: {len(session.samples)} samples; next: parallel-cal session fit {folder}"
    )


def show(folder: Folder, as_json: Json = False) -> None:
    """Show the steps of the current branch, and all branches."""
    from parallel_cal.session.history import History, format_first_error

    session = History(folder)
    if as_json:
        return console.emit(session.document())
    for state in session.history():
        console.say(_line(state))
        if state.drift:
            console.say(f"  {state.drift}")
        if state.verdict:
            console.say(f"  {state.verdict_text}")
        if state.reason:
            console.say(f"  reason: {state.reason}")
    if len(session.record.branches) > 1:
        here = session.record.branch
        rows = [
            (("* " if name == here else "  ") + name, state.step, format_first_error(state.errors))
            for name, state in session.compared().items()
        ]
        console.table(("branch", "last step", "validation error"), rows)


def fit(
    folder: Folder,
    effect: AddedEffects = None,
    free: Free = None,
    fix: Fix = None,
    as_json: Json = False,
) -> None:
    """Identify the free parameters. --free and --fix also apply to the steps that follow."""
    session = _open(folder)
    asked = {"free": free, "fix": fix}
    changed: dict[str, Any] = {
        key: patterns(given) for key, given in asked.items() if given is not None
    }
    if changed:
        state = session.choose(console.progress, effect or (), **changed)
        return _print_state(session, state, as_json)
    _print_state(session, session.fit(console.progress, effect or ()), as_json)


def plan(
    folder: Folder,
    poses: Annotated[int, typer.Option(min=1, help="number of poses to measure")] = 20,
    as_json: Json = False,
) -> None:
    """Choose the next poses and write a CSV file. It is written to the session's folder."""
    file = _open(folder).plan(poses, console.progress)
    console.progress("", 1.0)
    if as_json:
        return console.emit({"output": str(file)})
    console.say(f"{file}: {poses} poses")


def add(
    folder: Folder,
    effect: EffectName,
    force: Annotated[
        bool,
        typer.Option(
            "--force",
            help="add it even if the validation error does not fall, or the measuring device may "
            "cause the error that the effect explains",
        ),
    ] = False,
    reason: Reason = "",
    as_json: Json = False,
) -> None:
    """Add an effect and fit again. The step is refused unless the validation error falls."""
    _check_reason(reason, force)
    session = _open(folder)
    _print_state(session, session.add(effect, console.progress, force, reason), as_json)


def remove(
    folder: Folder,
    effect: EffectsInModel,
    force: Annotated[
        bool,
        typer.Option("--force", help="remove it even if the validation error rises by 1 % or more"),
    ] = False,
    reason: Reason = "",
    as_json: Json = False,
) -> None:
    """Remove an effect and fit again. The step is refused if the validation error rises by
    1 % or more."""
    _check_reason(reason, force)
    session = _open(folder)
    _print_state(session, session.remove(effect, console.progress, force, reason), as_json)


def diagnose(folder: Folder, as_json: Json = False) -> None:
    """Diagnose the model. The session keeps the verdict."""
    session = _open(folder)
    found = session.diagnose(console.progress)
    console.progress("", 1.0)
    if as_json:
        return console.emit(found.document())
    from parallel_cal.reporting import text

    console.show(text.list_blocks(found))


def discover(folder: Folder, as_json: Json = False) -> None:
    """Find the law of an error that no effect describes. The laws are written as effect
    files to the session's folder; `session add` takes them by name."""
    from parallel_cal.discovery.in_session import discover_in_session

    found, files = discover_in_session(_open(folder), console.progress)
    console.progress("", 1.0)
    if as_json:
        return console.emit(found.document(files))
    from parallel_cal.reporting import text

    console.show(text.list_blocks(found))
    for file in files:
        console.say(f"written: {file}; next: parallel-cal session add {folder} {file.stem}")


def exclude(
    folder: Folder,
    samples: Samples,
    reason: Annotated[str, typer.Option(help="reason for the exclusion")] = "",
    as_json: Json = False,
) -> None:
    """Exclude samples, with a reason, and fit again."""
    session = _open(folder)
    _print_state(
        session, session.exclude(dict.fromkeys(samples, reason), console.progress), as_json
    )


def include(folder: Folder, samples: Samples, as_json: Json = False) -> None:
    """Include excluded samples again, and fit again."""
    session = _open(folder)
    _print_state(session, session.include(samples, console.progress), as_json)


def report(
    folder: Folder,
    output: ReportFile = None,
    pdf: PdfFile = None,
    certificate: CertificateFile = None,
    field: CertificateField = None,
    as_json: Json = False,
) -> None:
    """Write the report of the last step. Its certificate states the excluded samples with their
    reasons."""
    from parallel_cal.reporting import report as reports

    session = _open(folder)

    def make(stated: CertificateFields) -> Report:
        return reports.report(
            session.model,
            session.dataset,
            certificate=stated,
            options=session.options_for(session.dataset),
            progress=console.progress,
        )

    write_report(make, output, pdf, certificate, field or (), as_json)


def undo(folder: Folder, as_json: Json = False) -> None:
    """Undo the last step."""
    session = _open(folder)
    _print_state(session, session.undo(), as_json)


def redo(folder: Folder, as_json: Json = False) -> None:
    """Redo the step that was undone last."""
    session = _open(folder)
    _print_state(session, session.redo(), as_json)


def branch(
    folder: Folder,
    name: Annotated[str, typer.Argument(help="name of the new branch")],
    as_json: Json = False,
) -> None:
    """Start a branch at this step, to try an alternative."""
    session = _open(folder)
    _print_state(session, session.start_branch(name), as_json)


def switch(
    folder: Folder,
    name: Annotated[str, typer.Argument(help="name of the branch")],
    as_json: Json = False,
) -> None:
    """Switch to another branch."""
    session = _open(folder)
    _print_state(session, session.switch(name), as_json)


def save(
    folder: Folder,
    output: Out,
    force: Annotated[
        bool,
        typer.Option(
            "--force", help="write even if the model in the file is better or a check fails"
        ),
    ] = False,
    reason: Reason = "",
    as_json: Json = False,
) -> None:
    """Write the model of the last step to a file. This is refused if the model in the file is
    better, or if a check fails; --force writes it anyway."""
    from parallel_cal.base.errors import ParallelCalError
    from parallel_cal.model.file.modelfile import model_hash
    from parallel_cal.session.saving import SaveRefused

    _check_reason(reason, force)
    session = _open(folder)
    try:
        found = session.save(output, lambda _: force, console.progress, reason)
    except SaveRefused as refused:
        raise ParallelCalError(f"{refused}; --force writes it anyway") from None
    console.progress("", 1.0)
    console.warn(found.objections)
    sha256 = model_hash(session.model)
    if as_json:
        written = {"output": str(output), "hash": sha256}
        return console.emit(written | found.document())
    words = f"{output} contains this model already" if found.is_in_use else f"written: {output}"
    console.say(f"{words} (sha256 {sha256[:12]})")
    for words in filter(None, (found.comparison, session.effects_note)):
        console.say(words)


for command in (
    new,
    show,
    fit,
    add,
    remove,
    diagnose,
    discover,
    exclude,
    include,
    plan,
    report,
    undo,
    redo,
    branch,
    switch,
    save,
):
    app.command()(command)
