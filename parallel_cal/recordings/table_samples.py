"""Tables and a column map -> Dataset: one row for each pose at which the robot stood still."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

from parallel_cal.base.errors import DatasetError
from parallel_cal.recordings.clocks import MIN_STEPS
from parallel_cal.recordings.columns import ColumnMap, Join
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.recordings.dwells import approach
from parallel_cal.recordings.joining import fingerprint
from parallel_cal.recordings.recording import Array, Dropped
from parallel_cal.recordings.samples import READING
from parallel_cal.recordings.table import Table
from parallel_cal.recordings.table_columns import Columns, name_unused_columns
from parallel_cal.recordings.table_log import find_clock_offset, read_log, read_times
from parallel_cal.recordings.travel import travel

# A joint that moves by less between two rows keeps its direction: share of its travel, and sigmas
# of its stated noise.
MAX_STILL_SHARE = 1e-3
MAX_STILL_SIGMAS = 5.0
UNKNOWN_ORDER = (
    "the tables list the rows in different orders, so the order of visits is not known and no "
    "direction of a joint follows from it: backlash and hysteresis count as not testable. Sort "
    "both tables by the order of visits, or name a column time, or columns direction.JOINT"
)


def make_dataset(
    given: Sequence[Table], wanted: ColumnMap, asks: str, used: Sequence[str] = ()
) -> Dataset:
    """Return the dataset of tables that contain what is `wanted`; `asks` names the requester, which
    has `used` further columns itself."""
    tables, dropped, notes = _match_rows([*given], wanted, asks)
    join = [wanted.join.by] if wanted.join else []
    notes += name_unused_columns(given, wanted, [*used, *join])
    found = Columns(tables, asks).check(wanted)
    q = np.hstack([found.joint(joint) for joint in wanted.joints.values()])
    r, R, n = found.position(wanted), found.rotation(wanted), len(tables[0].rows)
    readings = {READING + name: found.reading(one) for name, one in wanted.readings.items()}
    conditions = {
        name: found.condition(name, given) if isinstance(given, str) else np.full(n, given)
        for name, given in wanted.conditions.items()
    }
    notes += found.describe_clocks(wanted)
    source = " + ".join(str(table.path) for table in given)
    stated = any(name.split(".")[0] in ("direction", "travel") for name in wanted.conditions)
    visits = None
    if wanted.visits == "in order" and not stated and n > 1:
        visits = _find_visits(given, tables, wanted, q, conditions.get("time"), asks)
        conditions |= {} if visits is None else visits.conditions(wanted)
        notes.append(f"{source}: {UNKNOWN_ORDER if visits is None else visits.note}")
    noise = wanted.noise  # as the manufacturers state it; NaN if they do not
    sigma = np.repeat([noise.position or np.nan, noise.orientation or np.nan], 3)
    pose_id = None
    if wanted.group is not None:
        pose_id = np.unique(found.texts(wanted.group), return_inverse=True)[1]
    names = dict(enumerate(found.texts(wanted.name))) if wanted.name else {}
    dataset = Dataset.from_arrays(
        tuple(wanted.joints),
        q,
        np.zeros((n, 3)) if r is None else r,
        R,
        measured=np.array(wanted.measured),
        pose_cov=np.where(np.isnan(sigma), np.nan, np.diag(sigma**2)),
        joint_sigma=wanted.noise.joint,
        conditions=conditions | readings,
        pose_id=pose_id,
        source=source,
        dropped=tuple(dropped),
        warnings=tuple(notes),
        joint_units=tuple(found.joint_unit(joint) for joint in wanted.joints.values()),
        sides_from_order=visits is not None,
        names={number: name for number, name in names.items() if name},
    )
    # Of the numbers, not of the files: another column map makes other samples of the same files.
    return dataclasses.replace(dataset, sha256=fingerprint(dataset))


@dataclasses.dataclass(frozen=True)
class _Visits:
    """Joint readings (M, nq) of all visits in their order, which of them are the samples (N,), and
    what the order was taken from."""

    q: Array
    samples: np.ndarray
    where: str

    @property
    def note(self) -> str:
        """What the directions of the joints were taken from, and how to state better ones."""
        return (
            f"the sides from which the joints came were taken from the {self.where}: if it is not "
            "that of the visits, state visits: unordered, or columns direction.JOINT"
        )

    def conditions(self, wanted: ColumnMap) -> dict[str, Array]:
        """Return the conditions direction.JOINT and travel.JOINT of the samples."""
        noise = MAX_STILL_SIGMAS * (wanted.noise.joint or 0.0)
        threshold = np.maximum(MAX_STILL_SHARE * np.ptp(self.q, axis=0), noise)
        at, level = self.samples.tolist(), self.q[self.samples]
        direction = approach(self.q, at, level, threshold)
        distance = travel(self.q, at, level, direction, threshold)
        columns = (("direction", direction.astype(float)), ("travel", distance))
        return {
            f"{name}.{joint}": values[:, j]
            for j, joint in enumerate(wanted.joints)
            for name, values in columns
        }


def _find_visits(
    given: Sequence[Table],
    matched: Sequence[Table],
    wanted: ColumnMap,
    q: Array,
    time: Array | None,
    asks: str,
) -> _Visits | None:
    """Find the order in which the rows (N, nq) were visited: by their times, or that of the table.

    The robot was also at the rows of the joints that have no partner in another table. None if no
    time states the order and the tables contradict each other.
    """
    names, join = wanted.joint_columns, wanted.join
    for table, chosen in zip(given, matched, strict=True):
        if len(given) == 1 or any(table.find(name) is None for name in names):
            continue
        clock = join.by if join and join.within is not None else wanted.conditions.get("time")
        word = table.find(clock) if isinstance(clock, str) else None
        if time is not None and word is None:
            break  # another table states the times
        if word is None and any((np.diff(one.lines) < 0).any() for one in matched):
            return None
        own = [table.column(found) for name in names if (found := table.find(name))]
        rows = np.flatnonzero(np.isfinite(own).all(axis=0))
        every = table.select(rows.tolist())
        if word is not None:
            if join and join.within is not None:
                times = read_times(every, word, join.unit)
            else:
                times = Columns([every], asks).condition("time", str(clock))
            rows = rows[np.argsort(times, kind="stable")]
            every = table.select(rows.tolist())
        columns = Columns([every], asks)
        level = np.hstack([columns.joint(joint) for joint in wanted.joints.values()])
        place = {line: k for k, line in enumerate(every.lines)}
        where = f"{'order' if word is None else 'times'} of all rows of {table.path}"
        return _Visits(level, np.array([place[line] for line in chosen.lines]), where)
    order = np.arange(len(q)) if time is None else np.argsort(time, kind="stable")
    where = f"{'order' if time is None else 'times'} of the rows"
    return _Visits(q[order], np.argsort(order), where)


def _match_rows(
    tables: list[Table], wanted: ColumnMap, asks: str
) -> tuple[list[Table], list[Dropped], list[str]]:
    """Return tables of corresponding rows, the rows that lack a partner, and notes."""
    join = wanted.join
    if len(tables) == 1:
        return tables, [], []
    if join is None:
        counts = {str(table.path): len(table.rows) for table in tables}
        if len({*counts.values()}) > 1:
            raise DatasetError(
                f"{' and '.join(f'{n} rows in {p}' for p, n in counts.items())}: state in "
                "the column map how they belong together (join: {by: COLUMN})"
            )
        paths = " and ".join(str(table.path) for table in tables)
        note = f"{paths} were matched row by row, because no column that joins them is stated"
        return tables, [], [note]
    for table in tables:
        if table.find(join.by) is None:
            raise DatasetError(f"{table.path}:1: no column {join.by} to join by")
    if join.within is None:
        return *_join_tables(tables, join, {}), []
    offsets, notes = dict[str, float](), list[str]()
    complete = [_select_complete_rows(table, wanted) for table in tables]
    if join.offset is not None or min(len(table.rows) for table in complete) >= MIN_STEPS:
        log = read_log(Columns(complete, asks).check(wanted, join.by), wanted, join)
        shift = find_clock_offset(log, [*wanted.joints], join.offset)
        notes += shift.notes
        if log.poses is not None and log.clocks_differ:
            offsets[str(log.poses.path)] = shift.offset
    return *_join_tables(tables, join, offsets), notes


def _select_complete_rows(table: Table, wanted: ColumnMap) -> Table:
    """Return the rows with numbers for joints and pose: others may have no partner and do no
    harm."""
    names = wanted.joint_columns + wanted.pose_columns
    numbers = [table.column(word) for name in names if (word := table.find(name)) is not None]
    usable = np.isfinite(numbers).all(axis=0) if numbers else np.ones(len(table.rows), bool)
    return table.select(np.flatnonzero(usable).tolist())


def _join_tables(
    tables: list[Table], join: Join, offsets: Mapping[str, float]
) -> tuple[list[Table], list[Dropped]]:
    """Return tables of corresponding rows, and the rows that lack a partner in a table.

    `offsets` (s) are those of the clocks of some tables, by path.
    """
    one = min(tables, key=lambda table: len(table.rows))
    partners = np.column_stack([_find_partners(one, table, join, offsets) for table in tables])
    kept = (partners >= 0).all(axis=1)
    if not kept.any():
        reason = f"has the same {join.by} as"
        if join.within is not None:
            reason = f"is within {join.within:g} s ({join.by}) of"
        raise DatasetError(
            f"no row of {one.path} {reason} a row of the other tables"
            + (
                ""
                if join.within is None
                else ": if their clocks differ, state the offset of the poses' clock (offset, s)"
            )
        )
    unpaired = [(one, np.flatnonzero(~kept).tolist())]
    if join.within is None:  # in a log by time, most rows belong to no sample
        for table, rows in zip(tables, partners[kept].T, strict=True):
            if table is not one:
                unpaired.append((table, sorted({*range(len(table.rows))} - {*rows.tolist()})))
    dropped = [
        Dropped(
            0.0,
            "no partner",
            f"{table.path}:{table.lines[k]}: no other table has its {join.by}",
        )
        for table, rest in unpaired
        for k in rest
    ]
    chosen = [t.select(rows.tolist()) for t, rows in zip(tables, partners[kept].T, strict=True)]
    # Only the first table keeps the column that joins them: a column must be in one table only.
    others = [
        dataclasses.replace(t, header=["" if w == t.find(join.by) else w for w in t.header])
        for t in chosen[1:]
    ]
    return [chosen[0], *others], dropped


def _find_partners(
    one: Table, other: Table, join: Join, offsets: Mapping[str, float]
) -> np.ndarray:
    """Return the row (N,) of `other` that belongs to each row of `one`; -1 if there is none."""
    mine, its = one.find(join.by) or "", other.find(join.by) or ""
    if join.within is not None:
        at, among = (
            read_times(table, word, join.unit) - offsets.get(str(table.path), 0.0)
            for table, word in ((one, mine), (other, its))
        )
        order = np.argsort(among, kind="stable")
        after = np.searchsorted(among[order], at).clip(1, max(len(among) - 1, 1))
        around = order[np.minimum(np.stack([after - 1, after]), len(among) - 1)]
        nearest = np.where(np.diff(np.abs(among[around] - at), axis=0)[0] < 0, *around[::-1])
        return np.where(np.abs(among[nearest] - at) <= join.within, nearest, -1)
    texts = other.texts(its)
    for table, words in ((other, texts), (one, one.texts(mine))):
        first = dict(zip(words[::-1], range(len(words))[::-1], strict=True))
        if twice := [k for k, text in enumerate(words) if first[text] < k]:
            raise DatasetError(
                f"{table.path}:{table.lines[twice[0]]}: {join.by} {words[twice[0]]} occurs twice"
            )
    rows = {text: k for k, text in enumerate(texts)}
    return np.array([rows.get(text, -1) for text in one.texts(mine)])
