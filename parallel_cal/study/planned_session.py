"""Read the poses of a session from a plan or from a recording."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from parallel_cal.base.errors import DatasetError
from parallel_cal.base.threads import single_threaded
from parallel_cal.kinematics.kinematics import Kinematics, Status
from parallel_cal.model.model import Model
from parallel_cal.planning.pose_table import WAYPOINTS, read_columns
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.recordings.loading import load_dataset
from parallel_cal.recordings.options import ReadOptions
from parallel_cal.recordings.simulate import DWELL, MOVE, simulate
from parallel_cal.recordings.table import Table, read_table

PLANNABLE_CONDITIONS = ("payload", "temperature")  # that a plan may choose for each pose


def planned_joints(path: Path, model: Model) -> np.ndarray:
    """Return the joints (N, nq) of a plan or a recording; DatasetError if they are of another
    robot."""
    if path.suffix.lower() == ".csv":
        return read_columns(_table(path, model), model.joints)
    return load_dataset(path, mechanism=model.mechanism).q


@single_threaded()
def planned_session(
    path: Path, model: Model, options: ReadOptions, pace: float = MOVE + DWELL
) -> Dataset:
    """Return the samples of a session at a plan's poses (.csv), or those of a recording.

    The samples of a plan are those of an error-free robot and device. The robot approaches the
    poses in the plan's order, one every `pace` s, through the waypoints that the plan gives.
    PLANNABLE_CONDITIONS that vary in the plan are taken from it. Raises DatasetError if the joints
    are those of another robot, or if the robot cannot be assembled with them.
    """
    if path.suffix.lower() != ".csv":
        return load_dataset(path, options, mechanism=model.mechanism)
    table = _table(path, model)
    waypoints = [
        names
        for stop in WAYPOINTS
        if any(map(table.find, names := [f"{stop}.{joint}" for joint in model.joints]))
    ]
    target = read_columns(table, model.joints)
    visited = [*(read_columns(table, names) for names in waypoints), target]
    found = Kinematics(model).direct(target)
    for k in np.flatnonzero(~found.ok):
        raise DatasetError(
            f"{table.path}:{table.lines[k]}: this {model.mechanism.name} cannot be "
            f"assembled with joints {', '.join(f'{v:.4g}' for v in target[k])} "
            f"({Status(found.status[k]).text})"
        )
    places = np.stack(visited, axis=1).reshape(-1, len(model.joints))
    session = simulate(model, len(places), targets=places, quiet=True).dataset()
    # The simulation dwells at waypoints, too: keep the dwells at the poses only.
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
    if missing := [name for name in model.joints if table.find(name) is None]:
        raise DatasetError(
            f"{path}:1: no column {', '.join(missing)}: the plan is not for this "
            f"{model.mechanism.name}, whose joints are {', '.join(model.joints)}"
        )
    return table
