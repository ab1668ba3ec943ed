"""The table of planned poses: a CSV file with units, and with remarks for the person at the robot.

Lengths and angles have their unit in the header, all SI. The remarks are `#` lines before the
header; `read_table` skips them.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence

import numpy as np

from parallel_cal.base.errors import DatasetError
from parallel_cal.base.units import UNITS
from parallel_cal.model.effect import CONDITIONS
from parallel_cal.model.model import Model
from parallel_cal.recordings.table import Table, split_unit

POSITION, QUATERNION = ("x", "y", "z"), ("qx", "qy", "qz", "qw")
WAYPOINTS = ("past", "turn")  # in the order in which the robot drives to them
EXPLANATION_OF_WAYPOINTS = (
    "Each pose has two waypoints. Drive to the joints past.* first, then to turn.*, then to the "
    "pose: every joint then arrives from a known side over a known distance. Backlash and "
    "hysteresis depend on it."
)


def format_pose_table(
    model: Model,
    position: np.ndarray,
    quaternion: np.ndarray,
    joints: np.ndarray,
    conditions: Mapping[str, np.ndarray],
    waypoints: Sequence[np.ndarray] = (),
    remarks: Sequence[str] = (),
    contacts: Sequence[str] = (),
) -> str:
    """Return the CSV text of N planned poses of a model.

    `position` (N, 3) in m, `quaternion` (N, 4) x y z w, `joints` (N, nq), `conditions` (N,) by
    name, `waypoints` the joints (N, nq) at each of WAYPOINTS, or none; `contacts` (N,) names what
    each pose touches, or none.
    """
    units = dict(zip(model.joints, model.mechanism.joint_units, strict=True))
    stops = WAYPOINTS if len(waypoints) else ()
    header = [f"{name} [m]" for name in POSITION] + list(QUATERNION)
    header += [f"{name} [{unit}]" for name, unit in units.items()]
    condition_units = {name: _get_condition_unit(name, units) for name in conditions}
    header += [
        f"{name} [{unit}]" if unit in UNITS else name for name, unit in condition_units.items()
    ]
    header += [f"{stop}.{name} [{unit}]" for stop in stops for name, unit in units.items()]
    about = [*remarks, *([EXPLANATION_OF_WAYPOINTS] if stops else [])]
    about += [
        f"{name} in {unit}"
        for name, unit in condition_units.items()
        if unit != "1" and unit not in UNITS
    ]
    out = io.StringIO()
    out.writelines(f"# {line}\n" for line in about)
    rows = np.column_stack([position, quaternion, joints, *conditions.values(), *waypoints])
    words = [[name] for name in contacts] or [[]] * len(rows)
    header += ["contact"] if len(contacts) else []
    table = [[*row, *word] for row, word in zip(rows.tolist(), words, strict=True)]
    csv.writer(out, lineterminator="\n").writerows([header, *table])
    return out.getvalue()


def _get_condition_unit(name: str, joint_units: Mapping[str, str]) -> str:
    """Return the unit of a condition, "1" if it has none; that of the joint replaces rad."""
    kind, _, joint = name.partition(".")
    stated = CONDITIONS[kind][0] if kind in CONDITIONS else "1"
    return stated.replace("rad", joint_units.get(joint, "rad"))


def read_columns(table: Table, names: Sequence[str]) -> np.ndarray:
    """Return columns (N, len(names)) of a pose table in SI units, with or without units in its
    header; DatasetError with the columns that are missing."""
    words = [table.find(name) for name in names]
    if missing := [name for name, word in zip(names, words, strict=True) if word is None]:
        raise DatasetError(f"{table.path}:1: no column {', '.join(missing)}")
    found = [word for word in words if word is not None]
    factors = [UNITS.get(split_unit(word)[1] or "", 1.0) for word in found]
    return table.numbers(found) * factors
