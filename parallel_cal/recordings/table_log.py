"""Tables that log a moving robot -> Recording, and the offset between the clocks of two tables."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from parallel_cal.base.errors import DatasetError
from parallel_cal.base.rotation import matrix_to_quaternion
from parallel_cal.base.units import MAX_TIME_S, SECONDS, find_clock_unit
from parallel_cal.recordings.cleaning import assemble
from parallel_cal.recordings.clocks import clock_offset, describe_offset
from parallel_cal.recordings.columns import ColumnMap, Join, Log
from parallel_cal.recordings.options import ReadOptions
from parallel_cal.recordings.recording import (
    Array,
    Bools,
    JointStream,
    PoseStream,
    Raw,
    Recording,
    ScalarStream,
)
from parallel_cal.recordings.table import Table
from parallel_cal.recordings.table_columns import Columns, name_unused_columns

FIRST_STAMP_NS = 1_000_000_000  # a stamp of zero would count as missing
NOT_MEASURED_VARIANCE = 1e6  # as a driver marks a coordinate that its device does not measure


@dataclass(frozen=True)
class TableLog:
    """Rows over time: joints q (n, nq), and poses of some rows (m) with position and quaternion."""

    joints: Table
    poses: Table | None
    time: Array
    q: Array
    pose_time: Array
    position: Array
    quaternion: Array
    measured: Bools

    @property
    def clocks_differ(self) -> bool:
        """Whether joints and poses are in two tables, whose clocks may differ."""
        return self.poses is not None and self.poses is not self.joints


def read_log(found: Columns, wanted: ColumnMap, clock: Join | Log) -> TableLog:
    """Return joints and poses over time, each in the order of its time.

    A row in which all cells of the joints, or of the pose, are empty has none. DatasetError if the
    columns of one of them are in several tables.
    """
    key = clock.by if isinstance(clock, Join) else clock.time
    joint_table = found.require_one_table(wanted.joint_columns)
    time = read_times(joint_table, key, clock.unit)
    q = np.hstack([found.joint(joint, gaps=True) for joint in wanted.joints.values()])
    rows = _complete_rows(joint_table, q, "joints", time)
    none = np.zeros((0, 3)), np.zeros((0, 4)), np.zeros((0, 6), bool)
    if not wanted.pose_columns:
        return TableLog(joint_table, None, time[rows], q[rows], np.zeros(0), *none)
    pose_table = found.require_one_table(wanted.pose_columns)
    pose_time = read_times(pose_table, key, clock.unit)
    r, R = found.position(wanted, gaps=True), found.rotation(wanted, gaps=True)
    parts = [] if r is None or wanted.position is None else [r[:, wanted.position.measured]]
    parts += [] if R is None else [R.reshape(len(pose_time), -1)]
    seen = _complete_rows(pose_table, np.hstack(parts), "pose", pose_time)
    n = len(seen)
    measured = np.tile(wanted.measured, (n, 1))
    position = np.zeros((n, 3)) if r is None else r[seen]
    turned = np.tile(np.eye(3), (n, 1, 1)) if R is None else R[seen]
    quaternion = matrix_to_quaternion(turned)
    moving = time[rows], q[rows], pose_time[seen]
    return TableLog(joint_table, pose_table, *moving, position, quaternion, measured)


def find_clock_offset(log: TableLog, names: Sequence[str], stated: float | None) -> _Shift:
    """Return the time (s) of the poses' clock minus that of the joints', and a note about it."""
    if stated is not None or log.poses is None or not log.clocks_differ:
        return _Shift(stated or 0.0)
    joints = JointStream(
        str(log.joints.path), tuple(names), log.time, log.q, np.full(log.q.shape, np.nan)
    )
    n = len(log.pose_time)
    pose = PoseStream(
        str(log.poses.path),
        "",
        log.pose_time,
        log.position,
        log.quaternion,
        log.measured,
        np.full((n, 6, 6), np.nan),
    )
    found = clock_offset(joints, pose)
    if found is not None:
        return _Shift(found.delay, (describe_offset(found, pose.topic, joints.topic),))
    if log.time[0] > log.pose_time[-1] or log.pose_time[0] > log.time[-1]:
        spans = [
            f"{table.path} from {times[0]:.3f} to {times[-1]:.3f} s"
            for table, times in ((log.joints, log.time), (log.poses, log.pose_time))
        ]
        raise DatasetError(
            f"the times never overlap: {spans[0]}, {spans[1]}. The clocks differ, and the motion "
            "does not show by how much: state it in the column map (offset: S, the time of the "
            "poses' clock minus that of the joints' clock)"
        )
    return _Shift(0.0)


@dataclass(frozen=True)
class _Shift:
    """The offset (s) of the poses' clock, and notes about it."""

    offset: float
    notes: tuple[str, ...] = ()


def make_recording(
    given: Sequence[Table], wanted: ColumnMap, log: Log, asks: str, options: ReadOptions
) -> Recording:
    """Return the recording of tables that log a moving robot, cleaned as the messages of a bag.

    `asks` names the requester of the columns.
    """
    found = Columns(given, asks).check(wanted, log.time)
    rows = read_log(found, wanted, log)
    shift = find_clock_offset(rows, [*wanted.joints], log.offset)
    pose_time = rows.pose_time - shift.offset
    first = min(rows.time[0], pose_time.min(initial=np.inf))
    names = tuple(wanted.joints)
    raws = {"joint_states": Raw(str(rows.joints.path), "table")}
    for stamp, q in zip(_stamps(rows.time, first), rows.q, strict=True):
        raws["joint_states"].append(stamp, stamp, (names, q, ()))
    if rows.poses is not None:
        sigma = [wanted.noise.position or 0.0] * 3 + [wanted.noise.orientation or 0.0] * 3
        variance = np.where(rows.measured[0], np.square(sigma), NOT_MEASURED_VARIANCE)
        covariance = np.diag(variance).ravel()
        poses = raws["measured_pose"] = Raw(str(rows.poses.path), "table")
        for stamp, r, quaternion in zip(
            _stamps(pose_time, first), rows.position, rows.quaternion, strict=True
        ):
            turned = tuple(quaternion) if rows.measured[0, 3] else None
            poses.append(stamp, stamp, ("", tuple(r), turned, covariance))
    options = options.with_values(joints=names, mechanism=None)
    notes = (*shift.notes, *name_unused_columns(given, wanted, [log.time]))
    recording = assemble(raws, options, " + ".join(str(table.path) for table in given), notes)

    def stream(column: str, values: Array) -> ScalarStream:
        """Return a column over time in s since the first row; an empty cell is no reading."""
        table = found.require_one_table([column])
        kept = np.flatnonzero(np.isfinite(values))
        if not len(kept):
            raise DatasetError(f"{table.path}: column {column} is empty, expected numbers in it")
        time = read_times(table, log.time, log.unit) - first
        if rows.clocks_differ and table is rows.poses:
            time = time - shift.offset
        kept = kept[np.argsort(time[kept], kind="stable")]
        return ScalarStream(f"{table.path} ({column})", time[kept], values[kept])

    # Of the numbers, not of the files: another column map makes another recording of them.
    return replace(
        recording,
        start_ns=0,  # the date of the first row is not known
        conditions={
            name: stream(column, found.numbers([column], gaps=True)[:, 0])
            for name, column in wanted.conditions.items()
            if isinstance(column, str)
        },
        distances={
            name: stream(one.column, found.reading(one)) for name, one in wanted.readings.items()
        },
        sha256=_hash_numbers(recording),
    )


def _stamps(time: Array, first: float) -> list[int]:
    ns = ((time - first) * 1e9).round().astype(np.int64) + FIRST_STAMP_NS
    return [int(stamp) for stamp in ns]


def read_times(table: Table, key: str, unit: str | None) -> Array:
    """Return the times (N,) of the rows, s. Without a unit, it follows from their size."""
    word = table.find(key)
    if word is None:
        raise DatasetError(
            f"{table.path}:1: no column {key}, which states the time of its rows; the table has "
            f"{', '.join(table.header)}"
        )
    shown = table.numbers([word])[:, 0]
    time = shown * SECONDS[unit or find_clock_unit(shown)]
    for k in np.flatnonzero(np.abs(time) > MAX_TIME_S)[:1]:
        raise DatasetError(
            f"{table.path}:{table.lines[k]}: column {word} contains {table.texts(word)[k]!r:.60}, "
            f"which is {time[k]:.3g} s, expected at most {MAX_TIME_S:g} s: state its unit in the "
            "column map (unit: ms, us or ns)"
        )
    return time


def _complete_rows(table: Table, values: Array, what: str, time: Array) -> np.ndarray:
    """Return the rows that have values, in the order of their time; DatasetError if one has gaps or
    none has values."""
    empty = np.isnan(values)
    if len(broken := np.flatnonzero(empty.any(axis=1) & ~empty.all(axis=1))):
        raise DatasetError(
            f"{table.path}:{table.lines[broken[0]]}: some cells of the {what} are empty, expected "
            "all or none: fill them in or remove the line"
        )
    rows = np.flatnonzero(~empty.all(axis=1))
    if not len(rows):
        raise DatasetError(f"{table.path}: no row has the {what}, expected numbers in them")
    return rows[np.argsort(time[rows], kind="stable")]


def _hash_numbers(recording: Recording) -> str:
    """Return the sha256 of the numbers of joints and poses."""
    digest, poses = hashlib.sha256(), recording.pose
    for values in (
        recording.joints.time,
        recording.joints.position,
        poses.time,
        poses.position,
        poses.quaternion,
        poses.covariance,
    ):
        digest.update(np.ascontiguousarray(values).tobytes())
    return digest.hexdigest()
