"""A robot with something hidden calibrates itself, through the real nodes, in a minute."""

from __future__ import annotations

import json as json_format
import shutil
import signal
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from random import SystemRandom
from typing import TYPE_CHECKING, Any

from parallel_cal.base.errors import ParallelCalError
from parallel_cal.nodes.demo_story import Story
from parallel_cal.reporting import console

if TYPE_CHECKING:
    from parallel_cal.nodes.calibrate import Calibration

# What shows within a minute, a load put on by hand; one is drawn, and told to the cell alone.
HIDDEN = ("backlash", "gear_ripple", "shaft_twist")
RATE = 4.0  # times faster than life
POSES, MINUTES = 64, 5.0
PAYLOAD = 1.0  # kg that whoever asks for the demo would be asked to put on


def main(json: bool = False, effect: str = "", seed: int | None = None) -> int:
    """Let a virtual Delta calibrate itself; exit status 0 or 1.

    `effect` is what it hides and `seed` draws how it is built, drawn where they are not given. What
    came out stays, to be opened on the workbench; where it fails nothing is left behind.
    """
    with ExitStack() as stack:
        interrupted = _watch_signals(stack)
        folder = Path(tempfile.mkdtemp(prefix="parallel_cal_demo_"))
        failed = stack.enter_context(ExitStack())
        failed.callback(shutil.rmtree, folder, ignore_errors=True)
        try:
            begin, story = time.monotonic(), Story(json)
            chance = SystemRandom()
            hidden = effect or chance.choice(HIDDEN)
            cell = {
                "robot": "delta",
                "effects": hidden,
                "seed": chance.randrange(10_000) if seed is None else seed,
                "rate": RATE,
            }
            with _calibration(folder / "robot.yaml", cell, interrupted) as calibration, story:
                document = _run_campaign(calibration, story)
            if interrupted():
                raise KeyboardInterrupt
            document |= {"hidden": hidden, "seed": cell["seed"], "rate": RATE}
            document["seconds"] = time.monotonic() - begin
            story.end(document)
            failed.pop_all()
        except (ParallelCalError, KeyboardInterrupt) as error:
            console.error(str(error) or "interrupted; all nodes were stopped")
            return 1
    if json:
        console.emit(document)
    return 0


def _watch_signals(stack: ExitStack) -> Callable[[], bool]:
    """Whether SIGINT or SIGTERM came, while the stack is open.

    What a signal's handler raises may be swallowed, in a destructor for example: it only notes.
    """
    asked: list[int] = []
    for number in (signal.SIGINT, signal.SIGTERM):
        before = signal.signal(number, lambda number, frame: asked.append(number))
        stack.callback(signal.signal, number, before)
    return lambda: bool(asked)


def _calibration(
    model_file: Path, cell: dict[str, Any], interrupted: Callable[[], bool]
) -> Calibration:
    try:
        from parallel_cal.nodes.calibrate import Calibration
    except ImportError as error:
        raise ParallelCalError(
            f"ROS 2 is missing ({error}): run 'make demo', or install the extra 'ros' and msg_defs"
        ) from None
    return Calibration(model_file, simulated=cell, interrupted=interrupted)


def _run_campaign(calibration: Calibration, story: Story) -> dict[str, Any]:
    """What the campaign came to; a person's part is played here."""

    def hear(status: Any) -> None:
        story.on_status(status)
        if status.state == "asking":
            calibration.set_requested_conditions(status.questions)

    result = calibration.run(hear, MINUTES, poses=POSES, payload=PAYLOAD)
    if not result.json and not calibration.cancelled:
        raise ParallelCalError(result.message or "the campaign measured nothing")
    document: dict[str, Any] = json_format.loads(result.json or "{}")
    return document | {"message": result.message, "hash": result.hash}
