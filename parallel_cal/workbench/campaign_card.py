"""The parts of the page that start, show, pause and stop a campaign."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any

from nicegui import ui

from parallel_cal.base.errors import ParallelCalError
from parallel_cal.reporting.error_steps import FallingError, Step, describe_steps, draw_steps
from parallel_cal.workbench.bench import Live
from parallel_cal.workbench.marking import FigureSlot
from parallel_cal.workbench.widgets import card

INACTIVE_STATES = ("", "stopped", "done")


class CampaignBar:
    """The state of the campaign, with Pause and STOP.

    It is in the header, so that both buttons are in view while the robot moves.
    """

    def __init__(self, live: Live):
        self.live = live
        self.runs = False
        with ui.row().classes("w-full no-wrap items-center gap-2"):
            with ui.column().classes("grow min-w-0 gap-0"):
                self.words = ui.label().classes("w-full truncate")
                self.words.props("id=campaign aria-live=polite")
                with self.words:
                    self.whole = ui.tooltip()
                self.asked = ui.label().classes("w-full amber").props("id=asked role=alert")
            self.steers = {
                word: self._button(name, word)
                for word, name in (
                    ("continue", "Continue"),
                    ("resume", "Resume"),
                    ("pause", "Pause"),
                    ("stop", "STOP"),
                )
            }
            self.steers["stop"].props("color=negative unelevated").tooltip(
                "end the campaign and stop the robot on its path"
            )

    def show(self, told: dict[str, Any]) -> None:
        """Show the campaign's status, as `nodes.steering` reports it."""
        state = told["state"]
        self.runs = running = state not in INACTIVE_STATES
        for word, seen in (
            ("resume", state == "paused"),
            ("pause", state != "paused"),
            ("continue", state == "asking"),
        ):
            self.steers[word].set_visibility(seen)
        self.steers["pause"].set_enabled(running and state != "asking")
        # A campaign may run although its status was not received yet.
        self.steers["stop"].set_enabled(running or not state)
        words = _describe_status(told)
        self.words.set_text(words)
        self.whole.set_text(words)
        self.asked.set_text(told["reason"] if state == "asking" else "")
        self.asked.set_visibility(state == "asking")

    def _button(self, name: str, word: str) -> Any:
        click = partial(_try, partial(self.live.steer, word))
        return ui.button(name, on_click=click).props("dense").classes("shrink-0")


class CampaignCard:
    """Starts a campaign and shows its validation error over the poses."""

    def __init__(self, live: Live):
        self.live, self._curve = live, dict[str, Any]()
        with card("Automatic calibration"):
            with ui.row().classes("items-center"):
                self.poses, self.minutes, self.payload = (
                    ui.number(words, value=value, min=least).props("dense").classes("w-40")
                    for words, value, least in (
                        ("maximum poses", 80, 1),
                        ("maximum minutes", 60, 1),
                        ("available payload [kg]", 0, 0),
                    )
                )
                self.begin = ui.button("Calibrate", on_click=self._begin).props("dense outline")
            self.status = ui.label().props("id=campaign-status")
            self.chart = FigureSlot()

    def show(self, told: dict[str, Any]) -> None:
        """Show the campaign's status, as `nodes.steering` reports it."""
        inactive = told["state"] in INACTIVE_STATES
        self.begin.set_visibility(inactive)
        self.status.set_visibility(not inactive)  # in full; the header has one line for it
        self.status.set_text(_describe_status(told))
        if told["curve"] != self._curve:
            self._curve = told["curve"]
            found = _find_steps(self._curve)
            self.chart.show(*((draw_steps(found), describe_steps(found)) if found else (None,)))

    def _begin(self) -> None:
        numbers = (self.poses, self.minutes, self.payload)
        poses, minutes, payload = (float(one.value or 0) for one in numbers)
        _try(partial(self.live.calibrate, poses=int(poses), minutes=minutes, payload=payload))


def _find_steps(curve: dict[str, Any]) -> FallingError | None:
    """Return the initial model and each judgement as steps, named by the effects added there."""
    steps, known = list[Step](), set[str]()
    for point in curve["points"]:
        added = [name for name in point["effects"] if name not in known]
        known |= set(added)
        words = " and ".join(added) + " added" if added else "parameters"
        name = f"{point['poses']} poses: {words}" if point["poses"] else "initial model"
        if point["error"]:
            steps.append(Step(name, point["error"], len(steps) - 1 if steps else None))
    if not steps:
        return None
    return FallingError(
        curve["kind"],
        steps,
        noise=curve["noise"],
        now=len(steps) - 1,
        words="error at the validation poses",
    )


def _try(ask: Callable[[], None]) -> None:
    try:
        ask()
    except ParallelCalError as error:
        ui.notify(str(error), type="negative")


def _describe_status(told: dict[str, Any]) -> str:
    """Describe the state of the campaign and its progress in one line.

    What to do next follows from the status, which every window receives: the action's answer goes
    to the program that began the campaign, and a busy node may drop it.
    """
    if not told["state"]:
        return "no status received yet"
    inactive = told["state"] in INACTIVE_STATES
    words = f"{told['state']}: {(inactive and told['answer']) or told['reason']}"
    if told["poses"]:
        words += f"; {told['poses']} poses"
    if not math.isnan(told["error_unseen"]):
        words += f", validation error {1e6 * told['error_unseen']:.0f} µm"
    if inactive and told["poses"]:
        words += "; press Take samples, then Fit, to see the result"
    return words
