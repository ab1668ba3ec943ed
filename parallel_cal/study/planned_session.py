"""Where a session is to measure: what a plan, or a recording, says of its poses."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from parallel_cal.base.errors import DatasetError
from parallel_cal.base.threads import single_threaded
from parallel_cal.kinematics.kinematics import Kinematics, Status
from parallel_cal.model.model import Model
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.recordings.loading import load_dataset
from parallel_cal.recordings.options import ReadOptions
from parallel_cal.recordings.simulate import DWELL, MOVE, simulate
from parallel_cal.recordings.table import Table, read_table

WAYPOINTS = ("past", "turn")  # on the way to a pose, as a plan names them
PLANNABLE_CONDITIONS = ("payload", "temperature")  # conditions that a plan may choose for each pose


def planned_joints(path: Path, model: Model) -> np.ndarray:
    """The joints (N, nq) of a plan or a recording; DatasetError where they are another robot's."""
    if path.suffix.lower() == ".csv":
        return _joints(_table(path, model), model, "")
    return load_dataset(path, joints=model.joints).q


@single_threaded()
def planned_session(
    path: Path, model: Model, options: ReadOptions, pace: float = MOVE + DWELL
) -> Dataset:
    """The samples of a session at a plan's poses (.csv), as a robot without errors would give them
    to a device without errors; of a recording its own joints and conditions.

    A plan's poses are come to in its order, one every `pace` s, by way of its stops where it has
    some; of `GIVEN` what changes in its columns is as there. DatasetError where joints are another
    robot's.
    """
    if path.suffix.lower() != ".csv":
        return load_dataset(path, options, joints=model.joints)
    table = _table(path, model)
    on_way = [
        stop for stop in WAYPOINTS if any(f"{stop}.{j}" in table.header for j in model.joints)
    ]
    visited = [*(_joints(table, model, f"{stop}.") for stop in on_way), _joints(table, model, "")]
    _check_reached(table, model, visited[-1])
    places = np.stack(visited, axis=1).reshape(-1, len(model.joints))
    session = simulate(model, len(places), targets=places, quiet=True).dataset()
    place = (session.time // (MOVE + DWELL)).astype(int)
    at_pose = place % len(visited) == len(visited) - 1
    pose = place[at_pose] // len(visited)
    kept = session.select(at_pose)
    own = {
        name: table.numbers([name])[:, 0] for name in PLANNABLE_CONDITIONS if name in table.header
    }
    changed = {name: column[pose] for name, column in own.items() if np.ptp(column)}
    time = kept.time * pace / ((MOVE + DWELL) * len(visited))
    conditions = {**kept.conditions, **changed, "time": time}
    return replace(kept, time=time, conditions=conditions, source=str(path))


def _table(path: Path, model: Model) -> Table:
    table = read_table(path).drop_empty_rows()
    if missing := [name for name in model.joints if name not in table.header]:
        raise DatasetError(
            f"{path}:1: no column {', '.join(missing)}: the plan is not for this "
            f"{model.mechanism.name}, whose joints are {', '.join(model.joints)}"
        )
    return table


def _joints(table: Table, model: Model, stop: str) -> np.ndarray:
    names = [f"{stop}{joint}" for joint in model.joints]
    if missing := [name for name in names if name not in table.header]:
        raise DatasetError(f"{table.path}:1: no column {', '.join(missing)}")
    return table.numbers(names)


def _check_reached(table: Table, model: Model, q: np.ndarray) -> None:
    found = Kinematics(model).direct(q)
    for k in np.flatnonzero(~found.ok):
        raise DatasetError(
            f"{table.path}:{table.lines[k]}: this {model.mechanism.name} cannot be "
            f"assembled with joints {', '.join(f'{v:.4g}' for v in q[k])} "
            f"({Status(found.status[k]).text})"
        )
