"""The steps of a session's branches with their errors, for the picture "how the error fell"."""

from __future__ import annotations

from collections.abc import Mapping

from parallel_cal.base.units import ERROR_UNITS
from parallel_cal.reporting.error_steps import BEFORE, FallingError, Step
from parallel_cal.reporting.names import name_step
from parallel_cal.session.history import History, State


def find_steps(history: History) -> FallingError | None:
    """Return the errors of all branches of a session; None if no model was fitted yet."""
    record = history.record
    names = [record.branch, *(name for name in record.branches if name != record.branch)]
    paths = [history.history(name) for name in names]
    kind = next((k for k in ERROR_UNITS for path in paths for s in path if _error(s, k)), None)
    if kind is None:
        return None
    steps: list[Step] = []
    drawn: dict[int, int] = {}  # number of a state -> index of the step that shows it
    for branch, path in enumerate(paths):
        shown: tuple[int, State] | None = None  # the last step of this path
        for parent, state in zip([None, *path], path, strict=False):
            if state.number in drawn:
                shown = drawn[state.number], state
                continue
            error = _error(state, kind)
            if error is None:
                continue
            if shown is None and (first := _positive(state.before.get(f"{kind}_rms"))):
                # The state before the first fit has no errors of its own.
                steps.append(Step(BEFORE, first, branch=branch))
                shown = len(steps) - 1, state
            if shown and parent and error == _error(parent, kind):
                drawn[state.number] = shown[0]  # a saved model: the error is the same
                continue
            same = shown is None or _samples(shown[1]) == _samples(state)
            before = shown[0] if shown else None
            count = len(state.excluded)
            about = f"{count} excluded sample{'' if count == 1 else 's'}" if count else ""
            steps.append(Step(name_step(state.step), error, before, branch, same, about))
            drawn[state.number] = len(steps) - 1
            shown = len(steps) - 1, state
    noise = next((n for s in reversed(paths[0]) if (n := s.noise.get(f"{kind}_rms"))), None)
    return FallingError(kind, steps, names, noise, drawn.get(history.state.number))


def _positive(value: float | None) -> float | None:
    return value if value and value > 0 else None


def _error(state: State, kind: str) -> float | None:
    return _positive(state.errors.get(f"{kind}_rms"))


def _samples(state: State) -> tuple[str, Mapping[int, str]]:
    """What decides which samples judge a state."""
    return state.taken, dict.fromkeys(state.excluded, "")
