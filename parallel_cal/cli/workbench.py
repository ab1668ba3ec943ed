"""The live page on a session."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import Annotated

import typer

from parallel_cal.base.errors import ParallelCalError
from parallel_cal.cli.arguments import Data, with_options
from parallel_cal.cli.recordings import data_options
from parallel_cal.identification.options import FitOptions
from parallel_cal.reporting import console


@with_options
def workbench(
    model: Annotated[
        Path, typer.Argument(metavar="MODEL.yaml", help="model file, or a session's folder")
    ],
    bags: Annotated[
        list[Path] | None, typer.Argument(help="recordings, for a new session; several: sessions")
    ] = None,
    *,
    session: Annotated[
        Path | None, typer.Option(help="the session's folder [default: MODEL.session]")
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", help="what Save writes [default: model.yaml in the folder]"),
    ] = None,
    host: Annotated[str, typer.Option(help="address to listen at")] = "127.0.0.1",
    port: Annotated[int, typer.Option(help="port to listen at")] = 8080,
    token: Annotated[str, typer.Option(help="needed with --host: who has it may come in")] = "",
    browser: Annotated[bool, typer.Option("--open/--no-open", help="open a browser")] = True,
    options: FitOptions,
    data: Data = None,
) -> None:
    """Open the live page: see where the model fails, add what is missing, watch the error fall."""
    if find_spec("nicegui") is None:
        raise ParallelCalError("the workbench needs NiceGUI: pip install 'parallel_cal[workbench]'")
    from parallel_cal.workbench.server import LOOPBACK, serve

    if host not in LOOPBACK and not token:
        raise ParallelCalError(f"--host {host}: others can come in; give a --token that they need")
    folder = model if model.is_dir() else session or model.with_suffix(".session")
    _ready(folder, model, bags or [], options, data)
    address = f"http://{host}:{port}/" + (f"?token={token}" if token else "")
    console.note(f"{folder}: {address} (Ctrl-C ends it; the session stays)")
    serve(folder, output, host=host, port=port, token=token, show=browser)


def _ready(
    folder: Path, model: Path, bags: list[Path], options: FitOptions, data: list[str] | None
) -> None:
    """A session in the folder: the one that is there, else a new one."""
    from parallel_cal.model.file.modelfile import read_model
    from parallel_cal.session.session import FILE, Session

    if (folder / FILE).exists():
        Session(folder)
        console.note(f"going on with the session in {folder}")
        return
    if model.is_dir():
        raise ParallelCalError(f"{model}: no session in this folder; give a model file and BAG")
    if not bags:
        raise ParallelCalError(f"{folder}: a new session needs at least one recording, or --ros")
    reading = data_options(data)
    Session.new(folder, read_model(model), bags, reading=reading, fitting=options)
