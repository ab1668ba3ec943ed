"""A fleet as a terminal shows it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

from parallel_cal.fleet.fleet import Fleet
from parallel_cal.reporting.readable import columns, fixed

WHEN = ("before", "identified", "after")
WORST = 10  # recordings that a person reads


def said(fleet: Fleet) -> str:
    """Verdicts, the worst recordings, and those that failed."""
    return "\n".join([*_verdicts(fleet), *_worst(fleet), *_failed(fleet)])


def _verdicts(fleet: Fleet) -> Iterator[str]:
    robots = {row["robot"] for row in fleet.rows}
    yield f"{len(robots)} robots, {len(fleet.rows)} recordings, {len(fleet.failed)} failed"
    if fleet.judged:
        verdicts = Counter(row["verdict"] for row in fleet.judged)
        yield ", ".join(f"{word}: {n}" for word, n in verdicts.most_common())


def _worst(fleet: Fleet) -> Iterator[str]:
    """Those with the largest error that is left, of positions where they were measured."""
    for kind, factor, unit in (("position", 1e6, "um"), ("orientation", 1e6, "urad")):
        key = f"{kind}_rms"
        rows = [row for row in fleet.judged if row["after"][key] is not None]
        if not rows:
            continue
        worst = sorted(rows, key=lambda row: -row["after"][key])[:WORST]
        header = ("robot", "recording", f"{kind} error [{unit}]", "identified", "with effects")
        yield columns(
            (*header, "effects"),
            [
                (
                    row["robot"], row["recording"],
                    *(fixed(row[when][key], factor, 1) for when in WHEN),
                    ", ".join(row["effects"]),
                )
                for row in worst
            ],
        )  # fmt: skip
        return


def _failed(fleet: Fleet) -> Iterator[str]:
    for row in fleet.failed:
        yield f"failed: {row['robot']} {row['recording']}: {row['reason']}"
