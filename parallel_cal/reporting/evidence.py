"""The parts of the report on candidates, the certainty of the verdict, and what to measure next."""

from __future__ import annotations

from collections.abc import Sequence

from parallel_cal.base.confidence import format_percent
from parallel_cal.diagnosis.entries import Entry
from parallel_cal.diagnosis.next_measurement import PlannedPose
from parallel_cal.diagnosis.result import Diagnosis
from parallel_cal.diagnosis.signature import signature
from parallel_cal.diagnosis.thresholds import CREDIBLE, MAX_REFITTED_CANDIDATES
from parallel_cal.reporting import signatures
from parallel_cal.reporting.blocks import Column
from parallel_cal.reporting.contents import unit_along
from parallel_cal.reporting.markup import (
    Plot,
    as_html,
    figure,
    folded,
    items,
    paragraph,
    sentence,
    table,
    tabs,
)
from parallel_cal.reporting.readable import (
    value_unit,
    vector,
)
from parallel_cal.reporting.report import Report
from parallel_cal.reporting.tables import candidate_table

MAX_PRINTED_POSES = 20  # as in page.css
SET_BY_WAYPOINTS = ("direction", "travel")  # conditions that follow from the waypoints of a pose
PATTERNS = 4  # candidates whose patterns are drawn


NOTE_ON_PATTERNS = (
    "The pattern of each candidate over the residuals of the present model: the part that the "
    "geometry cannot absorb. The band contains 99 % of the means of residuals that do not depend "
    "on the quantity. An effect fits if the dashed line follows the blue one and both leave the "
    "band. An amplitude is half of the peak-to-peak value of the dashed line."
)


def candidates(report: Report, plot: Plot) -> str:
    """Render the catalogue, best candidate first, then the effects that were not tested."""
    found = report.diagnosis
    tested = [entry for entry in found.entries if entry.candidate.testable]
    rest = [(e.name, e.reason) for e in found.entries if not e.candidate.testable]
    note = (
        "Each effect competes by the part of its pattern that the geometry cannot absorb: with all "
        "other effects, unknown laws of the robot, errors of the device and drifting noise. The "
        "probability is that of the robot having it. The most probable effects are refitted."
    )
    remarks = [f"{name} fits no better than {', '.join(o)}." for name, o in found.swaps.items()]
    first = [e for e in tested if e.name in found.effects or e.rank <= MAX_REFITTED_CANDIDATES]
    later = [e for e in tested if e not in first]
    shown = paragraph("No effect could be tested.", "none")
    if first:
        shown = as_html([candidate_table(found, first)])
    shown += _patterns(found, tested, plot)
    if later:
        more = as_html([candidate_table(found, later)])
        shown += folded(f"{len(later)} more effects fit no better", more)
    if rest:
        listed = table(("effect", "reason"), rest, "evidence")
        shown += folded(f"Not tested: {len(rest)}", listed)
    return paragraph(note, "note") + items(remarks) + shown


def _patterns(found: Diagnosis, tested: Sequence[Entry], plot: Plot) -> str:
    """Render the patterns of the likeliest effects that the residuals show."""
    seen = [e for e in tested if e.name in found.effects or e.probable]
    pages, mechanism = dict[str, str](), found.model.mechanism
    for entry in seen[:PATTERNS]:
        drawn = signature(entry.candidate)
        if drawn.panels:
            words = signatures.describe_pattern(drawn, entry.probability, mechanism)
            pages[entry.name] = figure(
                plot(signatures.figure(drawn, mechanism)), f"Pattern of {entry.name}:", words
            )
    counts = {
        "that are less probable": len(seen) - len(pages),
        f"with a probability below {format_percent(1 - CREDIBLE)}": len(tested) - len(seen),
    }
    others = [
        f"{n} {'effect' if n == 1 else 'effects'} {words}" for words, n in counts.items() if n
    ]
    rest = f"Not drawn: the patterns of {' and of '.join(others)}." if others else ""
    return (paragraph(NOTE_ON_PATTERNS, "note") + tabs(pages, titled=True) if pages else "") + (
        paragraph(rest, "note") if rest else ""
    )


def measure_next(report: Report) -> str:
    """Render the advice, the conditions to record, and the planned poses."""
    following = report.diagnosis.measure_next
    advice = [sentence(text) for text in following.advice]
    missing: dict[str, list[str]] = {}
    for effect, conditions in following.record.items():
        missing.setdefault(" and ".join(conditions), []).append(effect)
    advice += [f"Record {what}, to test {', '.join(e)}." for what, e in missing.items()]
    plan = following.plan
    if not plan:
        return items(advice) or paragraph("There are no effects left to distinguish.", "none")
    words = sentence(str(plan))
    printed = ""
    if len(plan.poses) > MAX_PRINTED_POSES:
        printed = paragraph(
            f"On paper: the first {MAX_PRINTED_POSES} of {len(plan.poses)} poses.", "note more"
        )
    return items(advice) + paragraph(words) + printed + _poses(plan.poses, report)


def _poses(poses: Sequence[PlannedPose], report: Report) -> str:
    """Render the poses to measure, with their waypoints and conditions.

    A4 has no room for what a person at the robot does not set: an orientation that the robot does
    not control, and conditions that follow from the waypoints.
    """
    units, mechanism = report.provenance.joint_units, report.diagnosis.model.mechanism
    joints = [f"{name} [{value_unit(unit)[0]}]" for name, unit in units.items()]
    stops = ["waypoint 1 [mm]", "waypoint 2 [mm]"] if poses[0].by_way_of else []
    conditions = {name: value_unit(unit_along(mechanism, name)) for name in poses[0].conditions}
    columns = [
        Column(
            f"{name} [{unit}]" if unit else name,
            on_paper=not stops or name.partition(".")[0] not in SET_BY_WAYPOINTS,
        )
        for name, (unit, _) in conditions.items()
    ]
    turns = any(name.startswith("r") for name in mechanism.controls)
    quaternion = Column("quaternion x y z w", on_paper=turns)
    rows = [
        [
            str(i),
            *(vector(stop.position, "m") for stop in pose.by_way_of),
            vector(pose.position, "m"),
            vector(pose.quaternion, "", 5),
            *(vector([q], u) for q, u in zip(pose.joints, units.values(), strict=True)),
            *(f"{pose.conditions[c] * factor:.3g}" for c, (_, factor) in conditions.items()),
        ]
        for i, pose in enumerate(poses, 1)
    ]
    return table(["", *stops, "x y z [mm]", quaternion, *joints, *columns], rows)
