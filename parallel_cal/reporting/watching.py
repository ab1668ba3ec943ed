"""What a watch says, for the terminal and as a JSON document."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import datetime, timezone
from typing import Any

import numpy as np

from parallel_cal.base.confidence import format_percent
from parallel_cal.base.units import SMALL_UNITS
from parallel_cal.reporting.blocks import Block, Column, Detail, Number, Table
from parallel_cal.reporting.readable import day, number, with_sigma
from parallel_cal.watch.changes import DRIFT, LOOSE, NOISE, STEP, WARM
from parallel_cal.watch.confirmation import Confirmation
from parallel_cal.watch.watch import DAY, Suspect, Watch

MAX_SUSPECTS = 5  # that a terminal shows
MAX_SHOWN_DAYS = 10_000  # R grows without bounds
MIN_PROBABILITY = 0.02  # of a rival that is named
KIND_WORDS = {
    STEP: "jumped by {}",
    DRIFT: "drifts by {} per day",
    WARM: "follows the temperature, by {}",
    LOOSE: "scatters by {} from sample to sample",
}


def document_watch(watch: Watch, confirmation: Confirmation | None = None) -> dict[str, Any]:
    """The JSON document of `parallel-cal watch`; SI, times as ISO 8601 in UTC."""
    alarm, enough = watch.alarm, len(watch.visits) > 1
    return {
        "alarm": None if alarm is None else {"recording": alarm.recording, "time": iso(alarm.time)},
        "statistic_days": watch.trend[-1].statistic / DAY if watch.trend else None,
        "false_alarm_days": watch.false_alarm_days,
        "misfit": None if watch.misfit is None else vars(watch.misfit),
        "parts": [
            {"part": part, "probability": p, "since": [iso(t) for t in watch.since(part)]}
            for part, p in (watch.parts.items() if enough else ())
        ],
        "suspects": [vars(one) for one in (watch.suspects if enough else ())],
        "sees": [
            {
                "parameter": one.parameter,
                "unit": one.unit,
                "step": one.step if np.isfinite(one.step) else None,
            }
            for one in (watch.sights if watch.visits else ())
        ],
        "confirm": None
        if confirmation is None
        else {
            "poses": len(confirmation.plan),
            "parameter": confirmation.suspect.parameter,
            "rival": confirmation.rival and confirmation.rival.parameter,
            "sigma": confirmation.sigma,
            "rival_sigma": confirmation.rival_sigma,
            "decides": confirmation.decides,
        },
        "trend": [
            {
                "recording": p.recording,
                "time": iso(p.time),
                "samples": p.samples,
                "statistic_days": p.statistic / DAY,
            }
            for p in watch.trend
        ],
    }


def iso(time: float) -> str:
    """Format s since 1970 as ISO 8601 in UTC."""
    return datetime.fromtimestamp(time, timezone.utc).isoformat(timespec="seconds")


def describe_watch(watch: Watch, confirmation: Confirmation | None = None) -> list[Block]:
    """Describe a watch as blocks: the answer, the suspects, and what the recordings can show."""
    blocks: list[Block] = [*summarize_watch(watch)]
    if (misfit := watch.misfit) is not None:
        blocks.append(
            f"doubtful: before any change the residuals are {misfit.ratio:.3g} times as large as "
            f"noise and calibration let expect (p = {misfit.p_value:.1g}). The model is not "
            "complete, the noise is stated too small, or the robot had changed before the first "
            "recording: alarms may be false, and diagnose tells what is missing"
        )
    if watch.alarm is not None:
        rows = []
        for one in watch.suspects[:MAX_SUSPECTS]:
            unit, factor = small_unit(one.unit)
            change, sigma = Number(one.value, factor, sigma=one.sigma), Number(one.sigma, factor)
            unit += "/day" if one.kind == DRIFT else ""
            share = format_percent(one.probability)
            rows.append((one.part, one.parameter, one.kind, share, change, sigma, unit))
        header = ("part", "parameter", "kind", "probability", "change", "sigma", "unit")
        blocks.append(Table(header, rows))
    if confirmation is not None:
        one, rival = confirmation.suspect, confirmation.rival
        unit, factor = small_unit(one.unit)
        blocks.append(
            f"to confirm: measure {len(confirmation.plan)} poses; they give {one.parameter} to "
            f"{number(confirmation.sigma, factor, 2)} {unit}"
            + (f", with {rival.parameter} unknown" if rival else "")
            + (", which decides" if confirmation.decides else ", which does not decide")
        )
    return [*blocks, *describe_sight(watch)]


def summarize_watch(watch: Watch) -> Iterator[str]:
    """Say whether something has changed: which part, since when, by how much, with its rivals."""
    first, last, alarm = watch.trend[0], watch.trend[-1], watch.alarm
    span = (last.time - first.time) / DAY
    counted = f"{len(watch.trend)} recordings in {span:.3g} days"
    if len(watch.trend) < 2:
        yield (
            f"no answer yet: the first recording ({first.samples} samples) shows how the robot is; "
            "a change shows from the second one on"
        )
        return
    chance = f"without a change, R exceeds {watch.false_alarm_days:g} days once in that time"
    if alarm is None:
        yield f"no change: {counted}, R = {say_statistic(last.statistic)} ({chance})"
        return
    yield (
        f"changed: alarm at {alarm.recording} ({day(iso(alarm.time))}); {counted}, "
        f"R = {say_statistic(last.statistic)} ({chance})"
    )
    parts = {part: p for part, p in watch.parts.items() if p >= MIN_PROBABILITY}
    named = ", ".join(f"{part} {format_percent(p)}" for part, p in parts.items())
    yield f"what changed: {named}"
    part = next(iter(watch.parts))
    begin, end = watch.since(part)
    yield f"since: between {day(iso(begin))} and {day(iso(end))} ({part}, 95 %)"
    best = next(one for one in watch.suspects if one.part == part)
    yield f"how much: {best.parameter} {say_size(best)}"


def small_unit(unit: str) -> tuple[str, float]:
    """Return (name, factor) of the unit in which a terminal shows a small quantity."""
    return SMALL_UNITS.get(unit, (unit, 1.0))


def say_statistic(seconds: float) -> str:
    """Say R: `12.3 days`."""
    days = seconds / DAY
    return f"{days:.3g} days" if days < MAX_SHOWN_DAYS else f"more than {MAX_SHOWN_DAYS} days"


def say_size(one: Suspect) -> str:
    """Say how much a parameter changed: `jumped by 51.2 +- 3.1 um`."""
    if one.parameter == NOISE:
        return f"is {np.hypot(1, one.value):.3g} times as large as before"
    unit, factor = small_unit(one.unit)
    size = with_sigma(one.value, one.sigma, factor).replace("±", "+-")
    return KIND_WORDS[one.kind].format(f"{size} {unit}")


def describe_sight(watch: Watch) -> Iterator[Block]:
    """Say what the next recording would show, and what these recordings cannot show."""
    if not watch.visits:
        return
    seen = [one for one in watch.sights if np.isfinite(one.step)]
    blind = [one.parameter for one in watch.sights if not np.isfinite(one.step)]
    yield f"the next recording would show a jump of {len(seen)} of {len(watch.sights)} parameters"
    rows = []
    for one in seen:
        unit, factor = small_unit(one.unit)
        rows.append((one.parameter, Number(one.step, factor, significant=2), unit))
    if rows:
        yield Detail(Table(("parameter", Column("smallest jump"), "unit"), rows))
    if blind:
        yield Detail(f"no jump of up to ten tolerances would show in {', '.join(blind)}")
