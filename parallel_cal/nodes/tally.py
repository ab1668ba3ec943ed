"""Counts what was received, answered, refused and dropped, and makes diagnostics of it."""

from __future__ import annotations

from collections import Counter
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus, KeyValue

from parallel_cal.nodes.model_server import Attempt, ServedModel
from parallel_cal.reporting.age import describe_age, is_past


class Tally:
    """Counts of messages and requests by outcome, and the last reason of each refusal."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self.reasons: dict[str, str] = {}

    def add(self, channel: str, outcome: str, reason: str = "") -> None:
        """Count `channel` received, answered, refused or dropped."""
        self.counts[f"{channel} {outcome}"] += 1
        if reason:
            self.reasons[f"{channel} {outcome}: last reason"] = reason

    def items(self) -> dict[str, str]:
        """Return counts and reasons as text, sorted."""
        texts = {name: str(n) for name, n in self.counts.items()} | self.reasons
        return dict(sorted(texts.items()))


def model_diagnostics(
    name: str, served: ServedModel | None, last: Attempt, failure: str, now: float
) -> Any:
    """Return the status of the model: ERROR without one, WARN if the last load failed, or if its
    calibration can no longer be trusted at the time `now` (s since 1970)."""
    about, Level = f"{name}: model", DiagnosticStatus
    items = {"last attempt": f"{last.source}: {last.reason}", "last failure": failure}
    if served is not None:
        items |= {
            "model file": served.path,
            "hash": served.hash,
            "mechanism": served.model.mechanism.name,
            "class": served.model.machine_class,
            "effects": ", ".join(e.name for e in served.model.effects),
            "calibration": describe_age(served.age, now),
        }
    if served is None:
        return diagnostics(about, Level.ERROR, f"no model: {last.reason}", items)
    if not last.ok:
        text = f"the previous model is still in use: {last.reason}"
        return diagnostics(about, Level.WARN, text, items)
    if is_past(served.age, now):
        text = f"the calibration is too old: {describe_age(served.age, now)}"
        return diagnostics(about, Level.WARN, text, items)
    return diagnostics(about, Level.OK, "model in use", items)


def traffic_diagnostics(name: str, tally: Tally, unheard: list[str], foreign: list[str]) -> Any:
    """Return the status of the topics: WARN if a condition of the model is missing or a topic has
    a `foreign` type."""
    neutral = f"not received, neutral values are used: {', '.join(unheard)}"
    warnings = [neutral] * bool(unheard) + foreign
    level = DiagnosticStatus.WARN if warnings else DiagnosticStatus.OK
    return diagnostics(f"{name}: traffic", level, "; ".join(warnings), tally.items())


def diagnostics(name: str, level: bytes, message: str, items: dict[str, str]) -> Any:
    """Return a DiagnosticStatus with these items."""
    values = [KeyValue(key=key, value=value) for key, value in items.items()]
    return DiagnosticStatus(level=level, name=name, message=message, values=values)
