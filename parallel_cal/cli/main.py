"""The command line `parallel-cal` and its commands."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib import import_module
from typing import Annotated

import typer

from parallel_cal import __version__
from parallel_cal.base.errors import ParallelCalError
from parallel_cal.cli.arguments import keeping_inputs
from parallel_cal.reporting import console

# The module of each command, and its function if that has another name.
COMMANDS = {
    "new": "models",
    "mechanisms": "models",
    "effects": "models",
    "sensors": "models",
    "direct": "kinematics",
    "inverse": "kinematics",
    "info": "recordings",
    "import": "importing:import_",
    "import-csv": "recordings",
    "board": "board:app",
    "simulate": "recordings",
    "replay": "recordings",
    "record-topics": "record_topics",
    "fit": "calibration",
    "compare": "calibration",
    "add": "calibration",
    "remove": "calibration",
    "diagnose": "diagnosing",
    "discover": "discovering",
    "report": "reporting",
    "export": "exporting",
    "export-residuals": "exporting",
    "short-cut": "short_cut",
    "plan": "planning",
    "calibrate": "calibrating",
    "workbench": "workbench",
    "fleet": "fleet",
    "watch": "watching",
    "drift": "drifting",
    "demo": "showing",
    "bench": "showing",
    "session": "session:app",
    "study": "study:app",
    "fk": "kinematics:direct",
    "ik": "kinematics:inverse",
    "look": "recordings:info",
}
OTHER_NAMES = {"fk": "direct", "ik": "inverse", "look": "info"}


def _version(wanted: bool) -> None:
    if wanted:
        console.say(f"parallel-cal {__version__}")
        raise typer.Exit


def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="show the version")
    ] = False,
) -> None: ...


def application(words: Sequence[str]) -> typer.Typer:
    """Declare the command that the first word names, or all commands if it names none.

    Declaring all of them doubles the start-up time.
    """
    app = typer.Typer(
        no_args_is_help=True,
        add_completion=False,
        rich_markup_mode=None,  # rich would double the start-up time, too
        pretty_exceptions_enable=False,
        help="Kinematic calibration of parallel robots: compare the model with measurements, see "
        "where it fails, add the missing effect, check the error. All values are SI.",
        epilog="Other names: "
        + ", ".join(f"{other} is {name}" for other, name in OTHER_NAMES.items())
        + ".",
    )
    app.callback()(_options)
    for name in words[:1] if words and words[0] in COMMANDS else COMMANDS:
        module, _, called = COMMANDS[name].partition(":")
        found = getattr(
            import_module(f"parallel_cal.cli.{module}"), called or name.replace("-", "_")
        )
        if isinstance(found, typer.Typer):
            app.add_typer(found, name=name)
        else:
            app.command(name, hidden=name in OTHER_NAMES)(keeping_inputs(found))
    return app


def join_option_values(arguments: Sequence[str]) -> list[str]:
    """Join `--joints 0.1 -0.2` to `--joints=0.1 -0.2`.

    An option of Typer cannot take a variable number of values.
    """
    out: list[str] = []
    taking = None
    for argument in arguments:
        if taking is not None and taking(argument):
            out[-1] += ("" if out[-1].endswith("=") else " ") + argument
            continue
        taking = _VALUE_CHECKS.get(argument)
        out.append(argument + "=" if taking else argument)
    joined: list[str] = []
    for word in out:
        if word.startswith("--at=") and " " in word:  # `--at=a=1 b=2` is two options
            joined += [f"--at={item}" for item in word.removeprefix("--at=").split()]
        else:
            joined.append(word[:-1] if word[:-1] in _VALUE_CHECKS else word)
    return joined


def _is_number(word: str) -> bool:
    try:
        return bool([float(part) for part in word.split(",")])
    except ValueError:
        return False


_VALUE_CHECKS = {
    "--joints": _is_number,
    "--position": _is_number,
    "--orientation": _is_number,
    "--at": lambda word: "=" in word and not word.startswith("-"),
}


def main(arguments: Sequence[str] | None = None) -> None:
    """Run a command; exit with 0 on success, 1 on an error (one line), 2 on wrong usage."""
    given = join_option_values(sys.argv[1:] if arguments is None else arguments)
    try:
        application(given)(args=given, prog_name="parallel-cal")
    except ParallelCalError as error:
        console.error(str(error))
        sys.exit(1)
    except OSError as error:
        console.error(f"{error.filename or 'file'}: {error.strerror or error}")
        sys.exit(1)
    except KeyboardInterrupt:
        console.note("stopped")
        sys.exit(130)


if __name__ == "__main__":
    main()
