"""The command that serves the live page of a session."""

from __future__ import annotations

import socket
from contextlib import ExitStack
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from threading import Thread
from typing import TYPE_CHECKING, Annotated, Any

import typer

from parallel_cal.base.errors import ParallelCalError
from parallel_cal.cli.arguments import Data, FittingOrUpdating, with_options
from parallel_cal.cli.recordings import data_options
from parallel_cal.identification.options import FitOptions
from parallel_cal.reporting import console

if TYPE_CHECKING:
    from parallel_cal.base.worker import Worker

ModelOrSession = Annotated[
    Path | None,
    typer.Argument(metavar="MODEL.yaml", help="model file, or the folder of a session"),
]
NewBags = Annotated[
    list[Path] | None,
    typer.Argument(help="recordings for a new session; without any, import tables on the page"),
]
Ros = Annotated[
    bool,
    typer.Option(
        "--ros",
        help="use the running kinematics_node and calibration_node; if none run, start them "
        "on a copy of the model",
    ),
]
Namespace = Annotated[str, typer.Option(help="namespace of the nodes, with --ros")]
SessionFolder = Annotated[
    Path | None, typer.Option(help="folder of the session [default: MODEL.session]")
]
SavedFile = Annotated[
    Path | None,
    typer.Option(
        "-o",
        "--output",
        help="file that Save writes [default: the model file of the nodes; without --ros: "
        "model.yaml in the session's folder]",
    ),
]
Host = Annotated[str, typer.Option(help="address on which the server listens")]
Port = Annotated[int, typer.Option(help="port on which the server listens")]
Token = Annotated[str, typer.Option(help="secret that visitors need; required by --host")]
Browser = Annotated[bool, typer.Option("--open/--no-open", help="open a browser")]


@with_options
def workbench(
    model: ModelOrSession = None,
    bags: NewBags = None,
    *,
    ros: Ros = False,
    namespace: Namespace = "",
    session: SessionFolder = None,
    output: SavedFile = None,
    host: Host = "127.0.0.1",
    port: Port = 8080,
    token: Token = "",
    browser: Browser = True,
    options: FittingOrUpdating,
    data: Data = None,
) -> None:
    """Open the live page. It shows where the model fails, adds the missing effect and checks the
    error."""
    if find_spec("nicegui") is None:
        raise ParallelCalError("the workbench needs NiceGUI: pip install 'parallel_cal[workbench]'")
    from parallel_cal.workbench.bench import make_worker
    from parallel_cal.workbench.server import LOOPBACK, hold_session, serve

    if host not in LOOPBACK and not token:
        raise ParallelCalError(
            f"--host {host}: other computers can connect; give a --token that they must know"
        )
    _check_port(host, port)
    watch, held = None, ExitStack()
    if ros:
        if find_spec("rclpy") is None:
            raise ParallelCalError("--ros needs ROS 2: pip install 'parallel_cal[ros]'")
        from parallel_cal.nodes.watch import Watch

        watch = Watch(namespace)
    try:
        served = Path(watch.model_file()) if watch and watch.model_file() else None
        if (model := model or served) is None:
            raise ParallelCalError(
                "no model: give MODEL.yaml" + (" to start the nodes on" if ros else "")
            )
        folder = model if model.is_dir() else session or model.with_suffix(".session")
        worker = make_worker()
        _prepare_session(worker, folder, model, bags or [], options, data)
        address = f"http://{host}:{port}/"
        held.enter_context(hold_session(folder, address))
        output = output or served or folder / "model.yaml"
        if watch and not served:  # start both nodes on the file that Save writes
            from parallel_cal.model.file.modelfile import write_model
            from parallel_cal.session.session import Session

            if not output.exists():
                write_model(Session(folder).model, output)
            watch.start(folder, output)
            console.note(f"started kinematics_node and calibration_node on {output}")
        link = f"{address}?token={token}" if token else address
        console.note(f"{folder}: {link} (Ctrl-C stops the server; the session is kept)")
        how: dict[str, Any] = {"host": host, "port": port, "token": token, "show": browser}
        serve(folder, output, watch, worker=worker, **how)
    finally:
        held.close()
        if watch:
            watch.close()


def _check_port(host: str, port: int) -> None:
    """Refuse a port that is in use before a session is made, and before a browser opens the page
    of another program."""
    try:
        family, kind, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind) as trial:
            trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            trial.bind(address)
    except OSError as error:
        raise ParallelCalError(
            f"--host {host} --port {port}: the server cannot listen there ({error.strerror}); "
            "another workbench may be running: choose another port by --port"
        ) from None


def _prepare_session(
    worker: Worker,
    folder: Path,
    model: Path,
    bags: list[Path],
    options: FitOptions,
    data: list[str] | None,
) -> None:
    """Check the session in the folder, or start a new one."""
    from parallel_cal.session.history import FILE, History

    if (folder / FILE).exists():
        known = History(folder).record.recordings
        if others := [bag for bag in bags if str(bag.resolve()) not in known]:
            raise ParallelCalError(
                f"{folder}: this session uses {', '.join(known) or 'live samples'}, not "
                f"{others[0]}; choose another folder by --session"
            )
        console.note(f"resuming the session in {folder} with its own options")
        return
    if model.is_dir():
        raise ParallelCalError(
            f"{model}: no session in this folder; give a model file and a recording"
        )
    # The worker keeps the samples for its steps. To import NiceGUI takes as long as to read them.
    Thread(target=import_module, args=("nicegui",), daemon=True).start()
    worker.work(_create_session, folder, model, bags, options, data)


def _create_session(
    folder: Path, model: Path, bags: list[Path], options: FitOptions, data: list[str] | None
) -> None:
    """Start a session, and keep it open (in the worker)."""
    from parallel_cal.model.file.modelfile import read_model
    from parallel_cal.session.session import Session
    from parallel_cal.workbench.bench import keep_open

    reading = data_options(data)
    keep_open(Session.new(folder, read_model(model), bags, reading=reading, fitting=options))
