"""The demo: a simulated robot with a hidden effect calibrates itself through the nodes."""

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

# Effects that a campaign finds within a minute. One is drawn, and only the virtual robot gets it.
HIDDEN = ("backlash", "gear_ripple", "shaft_twist")
RATE = 4.0  # times real time
POSES, MINUTES = 64, 5.0
PAYLOAD = 1.0  # kg that the campaign may ask for; the demo reports it as mounted


def main(json: bool = False, effect: str = "", seed: int | None = None) -> int:
    """Let a simulated Delta robot calibrate itself; return the exit status 0 or 1.

    `effect` is the hidden effect, and `seed` determines the deviations of the geometry. Both are
    drawn if they are not given. The results stay on disk for the workbench. If the demo fails, it
    deletes its folder.
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
            with _open_calibration(folder / "robot.yaml", cell, interrupted) as calibration, story:
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
    """Return a function that says whether SIGINT or SIGTERM was received while the stack is open.

    The handler only records the signal, because Python may swallow an exception that a handler
    raises, for example in a destructor.
    """
    received: list[int] = []
    for number in (signal.SIGINT, signal.SIGTERM):
        before = signal.signal(number, lambda number, frame: received.append(number))
        stack.callback(signal.signal, number, before)
    return lambda: bool(received)


def _open_calibration(
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
    """Run a campaign, carry out the operator's tasks, and return its result document."""

    def hear(status: Any) -> None:
        story.on_status(status)
        if status.state == "asking":
            calibration.set_requested_conditions(status.questions)

    result = calibration.run(hear, MINUTES, poses=POSES, payload=PAYLOAD)
    if not result.json and not calibration.cancelled:
        raise ParallelCalError(result.message or "the campaign measured nothing")
    document: dict[str, Any] = json_format.loads(result.json or "{}")
    return document | {"message": result.message, "hash": result.hash}
