"""The command that runs a campaign, through running nodes or a simulated robot."""

from __future__ import annotations

import json
import math
import select
import signal
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from parallel_cal.base.errors import ParallelCalError
from parallel_cal.cli.arguments import Json
from parallel_cal.reporting import console

Robot = Annotated[Path, typer.Argument(help="model file (YAML) of the robot")]
MaxPoses = Annotated[
    int | None,
    typer.Option(min=1, help="largest number of samples [default: 80; with --update 24]"),
]
MaxMinutes = Annotated[float, typer.Option(min=0.1, help="maximum duration")]
Enough = Annotated[
    float,
    typer.Option(min=0, help="stop at this rms validation error (m or rad); 0: stop at a verdict"),
]
TestedEffects = Annotated[
    list[str] | None,
    typer.Option("--effect", help="test only this effect (repeat) [default: all]"),
]
KeepOut = Annotated[
    list[str] | None, typer.Option(help="box 'x y z x y z' (m) that the robot must not enter")
]
AvailablePayload = Annotated[
    float,
    typer.Option(min=0, help="available payload (kg) that you can mount on request; 0: none"),
]
Warmer = Annotated[
    float,
    typer.Option(
        min=0, help="by how many kelvin you can warm the robot up on request; 0: do not ask"
    ),
]
Reach = Annotated[
    float,
    typer.Option(
        min=1,
        help="size of the region for poses after the first diagnosis, as a multiple of the "
        "workspace; 1: the workspace only",
    ),
]
Afresh = Annotated[
    bool,
    typer.Option("--afresh", help="start again instead of resuming an unfinished campaign"),
]
Update = Annotated[
    bool,
    typer.Option(
        "--update",
        help="only decide whether the robot has drifted since its last calibration, in as few "
        "samples as that takes, and update the model if it has",
    ),
]
Certainty = Annotated[
    float,
    typer.Option(
        min=0.5,
        max=1,
        help="with --update: probability at which it is decided; 0.99 gives at most 1 % false "
        "alarms",
    ),
]
Output = Annotated[
    Path | None,
    typer.Option("-o", "--output", help="file for the better model [default: MODEL]"),
]
Namespace = Annotated[str, typer.Option(help="namespace of the nodes")]
Simulated = Annotated[
    str,
    typer.Option(
        metavar="ROBOT[:EFFECT,...]",
        help="calibrate a simulated robot (delta, stewart, argos or linear_delta), such as "
        "delta or delta:backlash,warmth; docs/cell.md lists the effects",
    ),
]
WithCamera = Annotated[
    bool,
    typer.Option("--camera", help="with --simulated: a camera measures, instead of a tracker"),
]


def calibrate(
    model: Robot,
    poses: MaxPoses = None,
    minutes: MaxMinutes = 60.0,
    enough: Enough = 0.0,
    effects: TestedEffects = None,
    keep_out: KeepOut = None,
    payload: AvailablePayload = 0.0,
    warmer: Warmer = 0.0,
    reach: Reach = 1.0,
    afresh: Afresh = False,
    update: Update = False,
    certainty: Certainty = 0.95,
    output: Output = None,
    namespace: Namespace = "",
    simulated: Simulated = "",
    camera: WithCamera = False,
    as_json: Json = False,
) -> None:
    """Let the robot calibrate itself. The campaign ends when the diagnosis no longer changes.
    With --update it ends as soon as it is decided whether the robot has drifted. Ctrl-C stops the
    robot; run the same command again to resume."""
    try:
        from parallel_cal.nodes.calibrate import Calibration
    except ImportError as error:
        raise ParallelCalError(
            f"ROS 2 was not found ({error}): source its setup.bash, or install the extra 'ros' "
            "and msg_defs"
        ) from None
    terminal, boxes = _Terminal(), [number for box in keep_out or [] for number in _box(box)]
    cell = _describe_cell(model, simulated, camera)
    with Calibration(model, namespace, cell, interrupted=terminal.is_interrupted) as calibration:

        def hear(status: Any) -> None:
            terminal.print_status(status)
            if status.state == "asking" and cell is not None:
                console.note("the simulated robot does this at once")
                calibration.set_requested_conditions(status.questions)
            elif status.state == "asking" and terminal.wait_for_enter():
                calibration.confirm_done()

        result = calibration.run(
            hear,
            minutes,
            poses=poses or 0,
            enough=enough,
            effects=effects or [],
            keep_out=boxes,
            payload=payload,
            warmer=warmer,
            reach=reach,
            afresh=afresh,
            update=update,
            certainty=certainty,
            output_file=str(output.resolve()) if output else "",
        )
    shown = cell is not None and not terminal.is_interrupted()
    _print_result(result, output or model, calibration.hidden if shown else None, as_json)
    if not result.success:
        raise typer.Exit(1)


def _print_result(result: Any, written: Path, hidden: list[str] | None, as_json: bool) -> None:
    """Print how a campaign ended, and the effects that a simulated robot has."""
    if as_json:
        document: dict[str, Any] = json.loads(result.json) if result.json else {}
        return console.emit(document | {"success": result.success, "message": result.message})
    console.say(f"{'done' if result.success else 'ended'}: {result.message}")
    if result.hash:
        console.say(f"written to {written}: sha256 {result.hash[:12]}")
    if hidden is not None:
        console.say(f"hidden effects: {', '.join(hidden) or 'none'}")


def _box(text: str) -> list[float]:
    """Parse the six numbers of `--keep-out`."""
    try:
        numbers = [float(word) for word in text.replace(",", " ").split()]
    except ValueError:
        numbers = []
    if len(numbers) != 6:
        raise ParallelCalError(f"--keep-out '{text}': expected six numbers 'x y z x y z' (m)")
    return numbers


def _describe_cell(model: Path, simulated: str, camera: bool) -> dict[str, Any] | None:
    """Return what simulates ROBOT:EFFECT,...; None for a real robot, whose model must exist."""
    robot, _, hidden = simulated.partition(":")
    if not robot:
        if not model.is_file():
            raise ParallelCalError(f"{model}: no such file: expected the model of the robot")
        if camera:
            raise ParallelCalError("--camera needs --simulated: a real camera needs no option here")
        return None
    cell: dict[str, Any] = {"robot": robot, "effects": hidden, "device": "tracker", "rate": 4.0}
    if camera:  # images are found where the robot rests: few joint states show that
        cell |= {"device": "camera", "joint_rate": 50.0}
    return cell


class _Terminal:
    """The terminal of a campaign: it shows the state, and a person interrupts or answers there."""

    def __init__(self) -> None:
        """Take the signals that end a program as interruptions of the campaign from now on."""
        self._signals: list[int] = []
        self._last = ""
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            signal.signal(number, lambda number, frame: self._signals.append(number))

    def is_interrupted(self) -> bool:
        return bool(self._signals)

    def print_status(self, status: Any) -> None:
        """Print a line on stderr for every new pose and state."""
        error = ""
        if not math.isnan(status.error_unseen):
            error = f", validation error {1e6 * status.error_unseen:.0f} um"
        line = f"{status.state}: {status.reason} ({status.poses} poses{error})"
        if line != self._last and status.state not in ("sampling", "done", "stopped"):
            console.note(line)
        self._last = line

    def wait_for_enter(self) -> bool:
        """Wait until somebody presses Enter; False if nobody can, or at an interruption."""
        if not sys.stdin.isatty():
            return False
        console.note("press Enter when you have done this")
        while not self._signals and not select.select([sys.stdin], [], [], 0.1)[0]:
            pass
        if self._signals:
            return False
        sys.stdin.readline()
        return True
