"""The first screen: the machine with its errors, the verdict, and one next step."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from nicegui import ui

from parallel_cal.model.file.modelfile import read_model
from parallel_cal.model.summary import export_command
from parallel_cal.reporting.blocks import MAX_REMARKS
from parallel_cal.reporting.error_steps import (
    DOTTED,
    FallingError,
    Step,
    describe_steps,
    draw_steps,
)
from parallel_cal.reporting.names import name_effects, title_of
from parallel_cal.reporting.readable import write_micro
from parallel_cal.workbench.bench import Bench
from parallel_cal.workbench.error_steps import find_steps
from parallel_cal.workbench.next_step import (
    NextStep,
    WaysOn,
    find_next_step,
    offer_deciding_poses,
)
from parallel_cal.workbench.widgets import HEADING, card, draw_figure

WELCOME = (
    "This page finds how your robot differs from its model, names the physical effect that the "
    "model lacks, and writes a better model. Everything stays on this computer."
)
STEPS = (
    "Import poses that a device measured, with the joint readings at each.",
    "Fit: identify the parameters of the model.",
    "Add the effect that the errors show.",
    "Save the better model for the robot.",
)
NOT_JUDGED = "Model and measurements"  # title of the card while there is no verdict
NO_ERRORS = "The robot at home, to scale, as its model file describes it."


class MachineCard:
    """The card Machine: the robot to scale, and a slider along which its errors shrink."""

    def __init__(self) -> None:
        self._machine: dict[str, Any] = {"stages": []}
        self._figure: Any = None
        self._names: list[str] = []
        self._stage = 0  # that is shown
        with card("Machine") as self.card:
            with ui.element().classes("machine") as self._place:
                pass
            with ui.row().classes("items-center gap-x-3 gap-y-0"):
                self.words = ui.label().props("id=machine-words").classes("text-sm quiet")
                self._enlarge = ui.checkbox("enlarge", on_change=self._draw).props("dense")
            with ui.column().classes("w-full gap-0") as self._choice:
                self._slider = ui.element().classes("w-full")
                self._labels = ui.row().classes("w-full no-wrap justify-between gap-2 text-xs")
        self.card.set_visibility(False)

    def show(self, machine: dict[str, Any] | None) -> None:
        self.card.set_visibility(machine is not None)
        if machine is None:
            return
        self._machine = machine
        stages = machine["stages"]
        self._choice.set_visibility(len(stages) > 1)
        names = [stage["name"] for stage in stages]
        if names != self._names:
            # The present model is the second of two or three stages, or the only one.
            self._names, self._stage = names, min(1, len(stages) - 1)
            self._slider.clear()
            with self._slider:
                slider = ui.slider(
                    min=0, max=max(1, len(stages) - 1), step=1, value=self._stage
                ).classes("stages")
                slider.props('aria-label="errors of which model" snap markers')
                slider.on_value_change(lambda e: self._choose(int(e.value)))
        self._labels.clear()
        with self._labels:
            for stage in stages:
                ui.label(f"{stage['name']}: {stage['error']}")
        self._draw()

    def _choose(self, stage: int) -> None:
        self._stage = stage
        self._draw()

    def _draw(self) -> None:
        stages, traces = self._machine["stages"], self._machine["robot"]
        words = NO_ERRORS
        scales = self._machine.get("scales", ())
        self._enlarge.set_visibility(len(scales) > 1)
        if stages:
            stage, chosen = stages[self._stage], -1 if self._enlarge.value else 0
            traces = [*traces, *stage["traces"][chosen]]
            every = "every step " if len(stages) > 1 else ""
            words = (
                f"Position errors in the frame of the base, {stage['name']}: "
                f"{stage['error']} rms; {every}magnified {scales[chosen]:g} times"
            )
            share = self._machine.get("share")
            words += f"; arrows at {share}." if share else "."
            self._enlarge.set_text(f"enlarge {scales[-1] / scales[0]:g} times")
        self.words.set_text(words)
        config = {"displayModeBar": False}
        figure = {"data": traces, "layout": self._machine["layout"], "config": config}
        with self._place:
            self._figure = draw_figure(figure, "the machine and its errors", self._figure)


class VerdictCard:
    """The card Verdict: how the error fell, the two answers, and the next step.

    The header, which stays in view, has the verdict's word; the card has its sentences.
    """

    def __init__(self, bench: Bench, ways: WaysOn):
        self.bench, self._ways = bench, ways
        self._next: NextStep | None = None
        self._view: dict[str, Any] = {}
        with ui.card().classes("w-full gap-2").props("role=region") as self.card:
            self.title = ui.label().classes("text-base font-bold").props(HEADING)
            with ui.element().classes("falling") as self._place:
                pass
            self._figure: Any = None
            self.dotted = ui.label(DOTTED).classes("text-xs quiet")
            with ui.column().classes("gap-1 w-full").props("id=answers aria-live=polite"):
                self.missing = ui.label().props("id=missing").classes("text-lg font-bold")
                self.sizes = ui.label().props("id=sizes")
                self.left = ui.label().props("id=left")
            with ui.row().classes("items-center gap-3"):
                self.next = ui.button(on_click=self._begin).props("no-caps id=next")
                self.saved = ui.label().props("id=saved")
                self.why = ui.button("Why?", on_click=self._prove).props("flat no-caps dense")
                self.poses = ui.button(on_click=ways.show_poses).props("flat no-caps dense")
            with ui.column().classes("gap-1 w-full text-sm").props("id=verdict-words"):
                self.words = ui.label()
                self.remarks = ui.column().classes("gap-1 w-full")
            self.included = ui.label().props("id=included").classes("text-xs quiet")

    def show(self, view: dict[str, Any]) -> None:
        self._view = view
        answers = view.get("answers") or {"missing": "", "sizes": "", "left": ""}
        for key, label in (("missing", self.missing), ("sizes", self.sizes), ("left", self.left)):
            label.set_text(answers[key])
            label.set_visibility(bool(answers[key]))
        self._show_verdict(view["verdict"])
        found = find_steps(self.bench.session)
        if found is not None:
            found = _with_proposal(found, view)
        self.dotted.set_visibility(
            found is not None and not all(step.is_comparable for step in found.steps)
        )
        self._place.set_visibility(found is not None)
        if found is not None:
            figure = draw_steps(found)
            del figure["layout"]["height"]  # it fills the card
            with self._place:
                self._figure = draw_figure(figure, describe_steps(found), self._figure)
        knocked = [str(number) for number in view.get("knocked", ())]
        self.included.set_visibility(bool(knocked))
        self.included.set_text(
            "Errors and parameters are those of the model, which was fitted to all samples. "
            f"The verdict does not use sample {', '.join(knocked)}: exclude it if it is wrong."
        )
        self.why.set_visibility(_find_proof(view) is not None)
        self.show_next()

    def _show_verdict(self, verdict: dict[str, Any]) -> None:
        """Show at most two sentences, and a list, of which three lines are open."""
        title = NOT_JUDGED
        if "word" in verdict:
            title = "Preliminary verdict" if verdict.get("is_preliminary") else "Verdict"
        self.title.set_text(title)
        self.card.props(f'aria-label="{title}"')
        self.words.set_text(name_effects(write_micro(verdict["words"])))
        self.remarks.clear()
        remarks = verdict.get("remarks", ())
        with self.remarks:
            _list(remarks[:MAX_REMARKS])
            if more := remarks[MAX_REMARKS:]:
                with ui.expansion(f"{len(more)} more").props("dense").classes("w-full"):
                    _list(more)

    def show_next(self) -> None:
        """Show the step that follows from the state; it waits while another one runs."""
        self._next = find_next_step(self.bench, self._ways)
        self.next.set_visibility(self._next is not None)
        if self._next is not None:
            self.next.set_text(self._next.words)
            self.next.props(f'aria-label="next step: {self._next.words}"')
        self.next.set_enabled(not self.bench.busy)
        offered = offer_deciding_poses(self._view)
        self.poses.set_visibility(bool(offered) and getattr(self._next, "words", "") != offered)
        self.poses.set_text(offered)
        is_saved = "answers" in self._view and self.bench.is_saved
        self.saved.set_visibility(is_saved)
        output = self.bench.output
        words = f"This model is saved in {output.name}."
        command = export_command(read_model(output), output) if is_saved else ""
        if command:
            words += f" Next, write it to the controller: {command}"
        self.saved.set_text(words)

    def _begin(self) -> None:
        if self._next is not None:
            self._next.begin()

    def _prove(self) -> None:
        """Show the residuals against what they depend on, with the pattern of what was found."""
        if (proof := _find_proof(self._view)) is None:
            return
        effect, picture = proof
        title = title_of(effect)
        dialog = ui.dialog(value=True)
        dialog.props(f'maximized transition-show=fade aria-label="Why {title}?"')
        with self.card, dialog, ui.card():
            ui.label(f"Why {title}?").classes("text-base font-bold").props(
                "role=heading aria-level=2"
            )
            ui.label(
                "Points: the residuals of the present model. Blue: their mean. Orange: the mean "
                f"that {title} predicts. The band holds 99 % of the means if nothing depended on "
                "the quantity below."
            ).classes("text-sm")
            draw_figure(picture["figure"], f"proof: {name_effects(picture['words'])}")
            ui.button("Close", on_click=dialog.close).props("dense outline")


class Strip:
    """The strip below the first screen: samples, knocked samples, device and noise."""

    def __init__(self, exclude: Callable[[Mapping[int, str]], None]) -> None:
        self._exclude = exclude
        self.row = ui.element().classes("strip text-sm").props("id=strip")

    def show(self, view: dict[str, Any]) -> None:
        self.row.clear()
        self.row.set_visibility("measured" in view)
        with self.row:
            for name, words in view.get("measured", {}).items():
                with ui.row().classes("items-center gap-x-2 gap-y-0"):
                    ui.label(name).classes("font-bold")
                    ui.label(words)
                    if name == "samples":
                        self._offer_exclusion(view.get("knocked") or {})

    def _offer_exclusion(self, knocked: Mapping[str, str]) -> None:
        """Offer to exclude the samples that the verdict sets aside, all at once."""
        if not knocked:
            return
        names = ", ".join(knocked)
        is_one = len(knocked) == 1
        ui.label(f"sample {names} is knocked" if is_one else f"samples {names} are knocked")
        words = "Exclude" if is_one else f"Exclude {len(knocked)}"
        reasons = {int(number): explain_exclusion(size) for number, size in knocked.items()}
        button = ui.button(words, on_click=lambda: self._exclude(reasons))
        button.props(f'dense outline aria-label="exclude knocked: {names}"')
        button.tooltip("far from what all others show; Undo includes it again")


def explain_exclusion(size: str) -> str:
    """Say why a sample is excluded of which an owner says nothing else."""
    return f"far from what all others show ({size})"


class WelcomeCard:
    """What an empty page says: what it is, for which robot, and the four steps."""

    def __init__(self, bench: Bench, ways: WaysOn):
        self.bench, self._ways = bench, ways
        with card("Calibrate your robot") as self.card:
            ui.label(WELCOME)
            self.robot = ui.label().props("id=robot").classes("font-bold")
            with ui.element("ol").classes("steps"):
                for words in STEPS:
                    with ui.element("li"):
                        ui.label(words)
            self.empty = ui.label().props("id=empty")
            with ui.row().classes("items-center gap-3"):
                self.next = ui.button(on_click=self._begin).props("no-caps")
                self.example = ui.button(
                    "Try it with simulated poses", on_click=lambda: bench.begin("try_example")
                ).props("outline no-caps")
                self.example.tooltip(
                    "adds 80 poses of a robot that was simulated from this model, with backlash; "
                    "Undo removes them"
                )

    def _begin(self) -> None:
        if (step := find_next_step(self.bench, self._ways)) is not None:
            step.begin()

    def show(self, words: str, can_begin: bool) -> None:
        """Show the state in words; offer the next step unless a campaign measures or poses are
        being read."""
        view = self.bench.view or {}
        self.robot.set_text(view.get("robot", ""))
        self.robot.set_visibility("robot" in view)
        self.empty.set_text(words)
        step = find_next_step(self.bench, self._ways) if can_begin else None
        self.next.set_visibility(step is not None)
        self.example.set_visibility(step is not None and self.bench.live is None)
        for button in (self.next, self.example):
            button.set_enabled(not self.bench.busy)
        if step is not None:
            self.next.set_text(step.words)


def _list(sentences: Sequence[str]) -> None:
    if sentences:
        with ui.element("ul").classes("remarks"):
            for words in sentences:
                with ui.element("li"):
                    ui.label(words)


def _with_proposal(found: FallingError, view: dict[str, Any]) -> FallingError:
    """Append the error with the effects that were found but not added yet."""
    errors, offered = view.get("with_effects") or {}, view.get("offered")
    error = errors.get(f"{found.kind}_rms")
    if not (error and offered and found.now is not None):
        return found
    names = " and ".join(map(title_of, offered["effects"]))
    now = found.steps[found.now]
    proposed = Step(f"with {names}", error, found.now, now.branch, details="not added yet")
    return FallingError(
        found.kind, [*found.steps, proposed], found.branches, found.noise, found.now
    )


def _find_proof(view: dict[str, Any]) -> tuple[str, dict[str, Any]] | None:
    """Find the picture that proves the first effect found: its pattern over the residuals."""
    candidates: Sequence[dict[str, Any]] = view.get("candidates", [])
    for one in candidates:
        if one["found"] and one["pattern"]:
            return one["effect"], one["pattern"]
    return None
