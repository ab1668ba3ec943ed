"""Touches of a plate as samples: the joints that a controller stored for each touch."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from parallel_cal.base.errors import DatasetError
from parallel_cal.base.units import LENGTHS, MM
from parallel_cal.importing.deltas import JOINT_NAMES, Delta, compute_positions, end_stops
from parallel_cal.importing.settings import SourceLine, sha256
from parallel_cal.importing.unit_doubts import doubt_unit
from parallel_cal.model.model import Model
from parallel_cal.recordings.configuration import explain_other_configuration
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.recordings.header_names import find_position
from parallel_cal.recordings.loading import order_joints
from parallel_cal.recordings.recording import Array, Dropped
from parallel_cal.recordings.samples import READING
from parallel_cal.recordings.table import read_table, split_unit

PROBE = READING + "probe"
SAME_PLACE = 1e-5  # m, between touches at one place by the firmware
MAX_HEIGHT_MM = 20.0  # from the nominal plane; no probe searches for a bed further away
NO_SIZE = (
    "touches of the bed cannot determine the print scale (cannot_know): a printer that is 1 % too "
    "large gives the same touches. Measure one printed length"
)


def read_touch_table(
    path: Path, plane_mm: float | None = 0.0
) -> tuple[Array, list[SourceLine]] | None:
    """Read touches (N, 3) in m, and the line of each, of a table with the columns x, y and z, in mm
    if the header states no unit; None if it has no such columns. DatasetError for a height that no
    probe reaches from the nominal plane of the bed, by default that of the touches (None)."""
    table = read_table(path)
    columns = [name for name in find_position(table, ()) or () if name]
    if not columns:
        return None
    table = table.drop_empty_rows()
    words = [table.find(name) or name for name in columns]
    units = [split_unit(word)[1] or "mm" for word in words]
    if wrong := [word for word, unit in zip(words, units, strict=True) if unit not in LENGTHS]:
        raise DatasetError(
            f"{path}:1: column {wrong[0]} is no length; expected {', '.join(LENGTHS)}"
        )
    points = table.numbers(words) * [LENGTHS[unit] for unit in units]
    places = [SourceLine(path, line) for line in table.lines]
    heights = points[:, 2] / MM
    plane = float(np.median(heights)) if plane_mm is None and len(heights) else plane_mm or 0.0
    if (far := np.flatnonzero(np.abs(heights - plane) > MAX_HEIGHT_MM)).size:
        raise places[far[0]].error(
            words[2],
            f"{heights[far[0]]:g} mm",
            f"the height of the bed there, within {MAX_HEIGHT_MM:g} mm of "
            + ("the nominal plane" if plane_mm is not None else f"{plane:g} mm, the middle of all"),
        )
    return points, places


@dataclass(frozen=True)
class Touches:
    """Joints (N, nq) in m or rad at touches of a bed, and stored heights (N,) of the tip in m.

    `xy_measured` states whether the recording also has measurements of x or y. `configuration`
    contains the numbers with which the joints were computed. `excluded` are the numbers of samples
    that are not among them.
    """

    q: Array
    height: Array
    source: str
    sha256: str
    xy_measured: bool = False
    configuration: Mapping[str, float] = field(default_factory=dict)
    excluded: tuple[int, ...] = ()

    def select(self, rows: Array) -> Touches:
        return replace(self, q=self.q[rows], height=self.height[rows])

    def explain_other_model(self, model: Model) -> str:
        """Return why the touches do not belong to a model; empty if they do."""
        return explain_other_configuration(model, self.configuration, self.source)


def touches_in(dataset: Dataset, joints: Sequence[str]) -> Touches:
    """Return the touches among a dataset's samples; DatasetError if there are none."""
    height = dataset.conditions.get(PROBE, np.full(len(dataset), np.nan))
    touched = np.isfinite(height)
    if not touched.any():
        raise DatasetError(
            f"{dataset.source}: no touch of a bed in it: expected readings of the "
            "sensor 'probe', as `import touches`, `rrf`, `klipper`, `marlin` and `linuxcnc` "
            "create them"
        )
    q = order_joints(dataset, joints).q
    other = [name for name in dataset.conditions if name.startswith(READING) and name != PROBE]
    read = any(np.isfinite(dataset.conditions[name]).any() for name in other)
    xy_measured = read or bool(dataset.measured[..., :2].any())
    return Touches(
        q[touched],
        height[touched],
        dataset.source,
        dataset.sha256,
        xy_measured,
        dataset.configuration,
        tuple(sorted(dataset.excluded)),
    )


@dataclass(frozen=True)
class PrintedEnds:
    """Joints (2k, 3) at the ends of printed lengths, and what the sensor `printed` reads there."""

    q: Array
    readings: dict[str, Array]


def make_printed_ends(
    delta: Delta, along_x: Sequence[float], along_y: Sequence[float]
) -> PrintedEnds:
    """Return the ends of parts printed about the middle of the bed.

    `along_x` and `along_y` are `[sent, measured]` in mm; either may be empty.
    """
    given = {axis: two for axis, two in (("x", along_x), ("y", along_y)) if two}
    at, readings = np.zeros((2 * len(given), 3)), dict[str, Array]()
    for k, (axis, two) in enumerate(given.items()):
        try:
            sent, measured = np.array(two, float) * MM
        except (TypeError, ValueError):
            sent = measured = np.nan
        at[2 * k : 2 * k + 2, "xy".index(axis)] = -sent / 2, sent / 2
        read = readings[f"{READING}printed_{axis}"] = np.full(len(at), np.nan)
        read[2 * k : 2 * k + 2] = -measured / 2, measured / 2
        if not (sent > 0 and measured > 0 and np.isfinite(delta.joints(at)).all()):
            expected = "[sent, measured] in mm within reach, such as [100, 100.3]"
            raise DatasetError(f"printed_{axis}={two}: expected {expected}")
    return PrintedEnds(delta.joints(at), readings)


def join_ends(parts: Sequence[PrintedEnds]) -> PrintedEnds:
    """Return all ends, each with the readings of its own part; NaN elsewhere."""
    total, before = sum(len(part.q) for part in parts), 0
    readings = dict[str, Array]()
    for part in parts:
        for name, read in part.readings.items():
            readings[name] = np.full(total, np.nan)
            readings[name][before : before + len(read)] = read
        before += len(part.q)
    return PrintedEnds(np.vstack([part.q for part in parts]), readings)


def find_visits(delta: Delta, q: Array, step: ArrayLike) -> Array:
    """Return the number (N, 1) of the first touch at the same x and y, for joints (N, nq) that a
    controller stored in whole steps (m or rad).

    Touches at one place differ in x and y by what a step of each motor moves the nozzle there.
    """
    start = np.zeros((len(q), 3))
    at = compute_positions(delta, q, start)[:, :2]
    aside = np.broadcast_to(step, q.shape[1:]) * np.eye(q.shape[1])
    moved = [compute_positions(delta, q + one, start)[:, :2] for one in aside]
    reach = SAME_PLACE + sum(np.linalg.norm(each - at, axis=1) for each in moved)
    first = np.arange(len(q))
    for k in range(len(q)):
        away = np.linalg.norm(at[:k] - at[k], axis=1)
        same = np.flatnonzero(away <= reach[k])  # NaN is at no place
        first[k] = first[same[0]] if len(same) else k
    return np.asarray(first[:, None], float)


def make_touch_samples(
    delta: Delta,
    nozzle: ArrayLike,
    places: Sequence[SourceLine],
    paths: Sequence[Path],
    step: ArrayLike | None,
    visits: Array | None = None,
    dropped: Sequence[Dropped] = (),
    warnings: Sequence[str] = (),
    *,
    printed: PrintedEnds,
) -> Dataset:
    """Return touches whose nozzle positions (N, 3) in m the controller stored.

    `places` are the lines of the file. A motor's `step` (m or rad), if it is known, rounds its
    joint. Touches with equal `visits`, by default at equal x and y, are replicates: their heights
    may differ by more than neighbouring joint readings do.
    """
    at = np.array(nozzle, float).reshape(-1, 3)
    if visits is None:
        visits = np.round(at[:, :2] / SAME_PLACE)
    q = delta.joints(at)
    share = float(np.hypot(*at[:, :2].T).max(initial=0.0)) / delta.usual_reach
    doubts = doubt_unit(share, "x and y of the touches", "the lengths of the machine")
    for k in np.flatnonzero(~np.isfinite(q).all(axis=1))[:1]:
        x, y, z = at[k] / MM
        point = f"x {x:.3f} y {y:.3f} z {z:.3f} mm"
        expected = "; ".join(["a point within reach of the configured rods", *doubts])
        raise places[k].error("position", point, expected)
    found = make_joint_samples(
        delta,
        q,
        np.zeros(len(q)),
        paths,
        step,
        visits,
        dropped,
        [*warnings, *doubts],
        printed=printed,
    )
    # The positions depend on every number of the configuration, and so do the joints.
    numbers = {name: float(number) for name, number in delta.nominal.items()}
    return replace(found, configuration=numbers | end_stops(delta))


def make_joint_samples(
    delta: Delta,
    q: Array,
    height: ArrayLike,
    paths: Sequence[Path],
    step: ArrayLike | None,
    visits: Array | None = None,
    dropped: Sequence[Dropped] = (),
    warnings: Sequence[str] = (),
    *,
    printed: PrintedEnds,
) -> Dataset:
    """Return touches at joints (N, 3) in m or rad, followed by the ends of printed lengths.

    The tip is `height` (N,) in m above the plate.
    """
    files = ", ".join(map(str, paths))
    if not len(q):
        raise DatasetError(f"{files}: the files contain no touches")
    same = None if visits is None else np.unique(visits, axis=0, return_inverse=True)[1].ravel()
    conditions = {PROBE: np.array(height, float)}
    if len(printed.q):
        n, more = len(q), len(printed.q)
        q = np.vstack([q, printed.q])
        none = np.full(n, np.nan)
        conditions = {PROBE: np.append(conditions[PROBE], np.full(more, np.nan))}
        conditions |= {name: np.append(none, read) for name, read in printed.readings.items()}
        same = None if same is None else np.append(same, np.zeros(more, int))
    else:
        warnings = (NO_SIZE, *warnings)
    found = Dataset.from_arrays(
        JOINT_NAMES,
        q,
        np.zeros((len(q), 3)),
        measured=np.zeros(6, bool),
        joint_sigma=None if step is None else np.broadcast_to(step, 3) / 12**0.5,
        conditions=conditions,
        pose_id=same,
        source=files,
        sha256=sha256(paths),
        dropped=tuple(dropped),
        warnings=tuple(warnings),
        joint_units=(delta.joint_unit,) * 3,
    )
    # Near ends of a short part are two poses, not two visits of one pose.
    ends = len(q) - len(printed.q) + np.arange(len(printed.q))
    found.pose_id[ends] = len(q) + np.arange(len(printed.q))
    return found
