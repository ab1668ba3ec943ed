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


def calibrate(
    model: Annotated[Path, typer.Argument(help="model file (YAML) of the robot")],
    poses: Annotated[int, typer.Option(min=1, help="largest number of samples")] = 80,
    minutes: Annotated[float, typer.Option(min=0.1, help="maximum duration")] = 60.0,
    enough: Annotated[
        float,
        typer.Option(
            min=0, help="stop at this rms validation error (m or rad); 0: stop at a verdict"
        ),
    ] = 0.0,
    effects: Annotated[
        list[str] | None,
        typer.Option("--effect", help="test only this effect (repeat) [default: all]"),
    ] = None,
    keep_out: Annotated[
        list[str] | None, typer.Option(help="box 'x y z x y z' (m) that the robot must not enter")
    ] = None,
    payload: Annotated[
        float,
        typer.Option(min=0, help="available payload (kg) that you can mount on request; 0: none"),
    ] = 0.0,
    warmer: Annotated[
        float,
        typer.Option(
            min=0, help="by how many kelvin you can warm the robot up on request; 0: do not ask"
        ),
    ] = 0.0,
    reach: Annotated[
        float,
        typer.Option(
            min=1,
            help="size of the region for poses after the first diagnosis, as a multiple of the "
            "workspace; 1: the workspace only",
        ),
    ] = 1.0,
    afresh: Annotated[
        bool,
        typer.Option("--afresh", help="start again instead of resuming an unfinished campaign"),
    ] = False,
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", help="file for the better model [default: MODEL]"),
    ] = None,
    namespace: Annotated[str, typer.Option(help="namespace of the nodes")] = "",
    simulated: Annotated[
        str,
        typer.Option(
            metavar="ROBOT[:EFFECT,...]",
            help="calibrate a simulated robot (delta, stewart, argos or linear_delta), such as "
            "delta or delta:backlash,warmth; docs/cell.md lists the effects",
        ),
    ] = "",
    camera: Annotated[
        bool,
        typer.Option("--camera", help="with --simulated: a camera measures, instead of a tracker"),
    ] = False,
    as_json: Json = False,
) -> None:
    """Let the robot calibrate itself. The campaign ends when the diagnosis no longer changes.
    Ctrl-C stops the robot; run the same command again to resume."""
    try:
        from parallel_cal.nodes.calibrate import Calibration
    except ImportError as error:
        raise ParallelCalError(
            f"ROS 2 was not found ({error}): source its setup.bash, or install the extra 'ros' "
            "and msg_defs"
        ) from None
    asked: list[int] = []
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, lambda number, frame: asked.append(number))
    boxes = [number for box in keep_out or [] for number in _box(box)]
    robot, _, hidden = simulated.partition(":")
    if not robot and not model.is_file():
        raise ParallelCalError(f"{model}: no such file: expected the model of the robot")
    if camera and not robot:
        raise ParallelCalError("--camera needs --simulated: a real camera needs no option here")
    cell: dict[str, Any] | None = None
    if robot:
        cell = {"robot": robot, "effects": hidden, "device": "tracker", "rate": 4.0}
    if cell and camera:  # images are found where the robot rests: few joint states show that
        cell |= {"device": "camera", "joint_rate": 50.0}
    last = [""]
    with Calibration(model, namespace, cell, interrupted=lambda: bool(asked)) as calibration:

        def hear(status: Any) -> None:
            print_status(status, last)
            if status.state == "asking":
                if cell is not None:
                    console.note("the simulated robot does this at once")
                    calibration.set_requested_conditions(status.questions)
                elif sys.stdin.isatty():
                    console.note("press Enter when you have done this")
                    while not asked and not select.select([sys.stdin], [], [], 0.1)[0]:
                        pass
                    if not asked:
                        sys.stdin.readline()
                        calibration.confirm_done()

        result = calibration.run(
            hear,
            minutes,
            poses=poses,
            enough=enough,
            effects=effects or [],
            keep_out=boxes,
            payload=payload,
            warmer=warmer,
            reach=reach,
            afresh=afresh,
            output_file=str(output.resolve()) if output else "",
        )
    document: dict[str, Any] = json.loads(result.json) if result.json else {}
    if as_json:
        console.emit(document | {"success": result.success, "message": result.message})
    else:
        console.say(f"{'done' if result.success else 'ended'}: {result.message}")
        if result.hash:
            console.say(f"written to {output or model}: sha256 {result.hash[:12]}")
        if robot and not asked:
            console.say(f"hidden effects: {', '.join(calibration.hidden) or 'none'}")
    if not result.success:
        raise typer.Exit(1)


def _box(text: str) -> list[float]:
    """Parse the six numbers of `--keep-out`."""
    try:
        numbers = [float(word) for word in text.replace(",", " ").split()]
    except ValueError:
        numbers = []
    if len(numbers) != 6:
        raise ParallelCalError(f"--keep-out '{text}': expected six numbers 'x y z x y z' (m)")
    return numbers


def print_status(status: Any, last: list[str]) -> None:
    """Print a line on stderr for every new pose and state. `last` holds the previous line."""
    error = ""
    if not math.isnan(status.error_unseen):
        error = f", validation error {1e6 * status.error_unseen:.0f} um"
    line = f"{status.state}: {status.reason} ({status.poses} poses{error})"
    if line != last[0] and status.state not in ("sampling", "done", "stopped"):
        console.note(line)
    last[0] = line
