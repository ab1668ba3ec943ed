"""Read recordings and sample files as a Dataset, with warnings about suspicious values."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from parallel_cal.base.arguments import check_arguments
from parallel_cal.base.errors import DatasetError, UnfitError
from parallel_cal.base.keyed_warning import KeyedWarning
from parallel_cal.base.progress import Progress
from parallel_cal.base.threads import single_threaded
from parallel_cal.model.configuration import Configuration
from parallel_cal.recordings.bag import read_bag
from parallel_cal.recordings.channels import find_channel, list_channels
from parallel_cal.recordings.clocks import align_clocks
from parallel_cal.recordings.columns import ColumnMap, read_column_map
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.recordings.header_names import POSITION, check_units, map_by_names
from parallel_cal.recordings.joining import join_datasets
from parallel_cal.recordings.joint_names import (
    describe_match,
    match_numbered_names,
    rename_conditions,
)
from parallel_cal.recordings.options import ReadKeywords, ReadOptions, SampleOptions
from parallel_cal.recordings.recording import Array, Dropped, Recording
from parallel_cal.recordings.replicates import replicate_ids
from parallel_cal.recordings.samplefile import PER_SAMPLE, holds_samples
from parallel_cal.recordings.samples import Samples, broadcast_to_joints
from parallel_cal.recordings.sampling import conditions_of, join_standstills, samples_of
from parallel_cal.recordings.table import Table, is_table, read_table
from parallel_cal.recordings.table_columns import Columns
from parallel_cal.recordings.table_log import make_recording
from parallel_cal.recordings.table_samples import make_dataset

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from parallel_cal.model.mechanism import Mechanism

MAX_POSITION_M = 10.0  # m from the origin; positions that are mostly further out look like mm
MIN_ABSOLUTE_TIME_S = 1e9  # s: a smaller time counts from the recording's start, not from 1970
MAP_SUFFIX = ".columns.yaml"  # of the column map beside a table
UNIT_WORDS = {"m": "a length", "rad": "an angle"}
MOTOR_CURE = (
    "If the readings are angles of a motor, state its travel per turn: in the model file ({joint}: "
    "{{unit: m, ..., drive: {{kind: spool, per_rev: 0.0712}}}}, in m) or in the column map "
    "({joint}: {{column: ..., unit: rev, per_rev: 71.2 mm}}); otherwise correct the unit"
)
LENGTH_CURE = "Correct the unit in the header or in the column map"
MAX_JOINT_TRAVEL_RAD = 4.0 * np.pi  # joints that travel further look like degrees


@check_arguments(DatasetError)
def load_dataset(
    path: str | Path,
    options: ReadOptions | None = None,
    progress: Progress | None = None,
    **given: Unpack[ReadKeywords],
) -> Dataset:
    """Read the samples of a recording.

    Parameters
    ----------
    path : str or Path
        A rosbag2 folder or file, a file of samples written by `Dataset.to_json`, or a table
        (`.csv`, `.tsv`, `.txt`) with a column map.
    options : ReadOptions, optional
        All options as one object.
    progress : callable, optional
        Called with a stage in words and the completed share (0 to 1).
    **given
        Single options by name, for example `joints` (the model's joint names in its order) or
        `mechanism` (of the model; it also converts units of a table), `exclude` (indices of the
        samples to exclude, from 0), `max_samples` (about how many samples to use at most), `topics`
        ({channel: topic}), `joint_sigma` (standard deviation of joint readings, rad or m), `mode`
        (`"auto"`, `"dwell"` or `"continuous"`).

    Returns
    -------
    Dataset
        One sample for each dwell, or for each measured pose of a robot in motion. `warnings` lists
        suspicious values. `dropped` lists messages and samples that could not be used.

    Raises
    ------
    BagError
        If the recording cannot be opened, or a topic in it cannot be used.
    DatasetError
        If there are no usable samples.

    Examples
    --------
    >>> import parallel_cal as pc
    >>> data = pc.load_dataset("bags/delta_backlash", exclude=[3])
    >>> len(data), data.q.shape
    (93, (93, 3))
    """
    return load_stamped(path, options, progress, **given)[0]


@single_threaded()
def load_stamped(
    path: str | Path,
    options: ReadOptions | None = None,
    progress: Progress | None = None,
    **given: Unpack[ReadKeywords],
) -> tuple[Dataset, int]:
    """Read samples and the stamp (ns) of their time zero; 0 for a file of samples."""
    options = (options or ReadOptions()).with_values(**given)
    start = 0
    if holds_samples(Path(path)):
        dataset = Dataset.from_json(path)
    elif is_table(Path(path)):
        dataset = load_table(Path(path), options)
    else:
        recording = read_bag(path, options.with_values(joints=options.joint_names), progress)
        dataset, start = dataset_from_recording(recording, options), recording.start_ns
    dataset = order_joints(dataset, options.joint_names)
    if options.mechanism is not None:
        dataset = match_joint_units(dataset, options.mechanism)
    return select_samples(dataset, options), start


def find_start_time(dataset: Dataset, start_ns: int) -> float | None:
    """Find when a recording began (s since 1970), by its stamp (ns) or the times of its samples;
    None if they count from its start."""
    first = 1e-9 * start_ns or float(dataset.time.min())
    return first if first > MIN_ABSOLUTE_TIME_S else None


def load_table(path: Path, options: ReadOptions) -> Dataset:
    """Read a table by its column map, or by the names in its header if it has none."""
    table = read_table(path).drop_empty_rows()
    beside = path.with_suffix(MAP_SUFFIX)
    if options.columns or beside.is_file():
        file = Path(options.columns or beside)
        return load_tables([table], read_column_map(file), str(file), options)
    robot = options.mechanism
    controls = robot.controls if robot else POSITION
    wanted = map_by_names(table, options.joint_names or (), beside, controls)
    units = dict(zip(robot.joints, robot.joint_units, strict=True)) if robot else {}
    check_units(table, wanted, beside, units)
    dataset = load_tables([table], wanted, str(beside), options)
    columns = {joint: of.column or joint for joint, of in wanted.joints.items()}
    matched = {joint: column for joint, column in columns.items() if column != joint}
    if matched:
        note = describe_match(str(path), matched)
        dataset = dataclasses.replace(dataset, warnings=(*dataset.warnings, note))
    return dataset


def load_tables(
    tables: Sequence[Table], wanted: ColumnMap, asks: str, options: ReadOptions | None = None
) -> Dataset:
    """Return the dataset of tables that contain what is `wanted`; `asks` names the requester."""
    if wanted.log is None:
        return make_dataset(tables, wanted, asks)
    options = options or ReadOptions()
    if options.joint_sigma is None:
        options = options.with_values(joint_sigma=wanted.noise.joint)
    recording = make_recording(tables, wanted, wanted.log, asks, options)
    dataset = dataset_from_recording(recording, options)
    found = Columns(tables, asks)
    constants = {
        name: np.full(len(dataset), value)
        for name, value in wanted.conditions.items()
        if not isinstance(value, str)
    }
    return dataclasses.replace(
        dataset,
        conditions=dataset.conditions | constants,
        joint_units=tuple(found.joint_unit(joint) for joint in wanted.joints.values()),
    )


@check_arguments(DatasetError)
@single_threaded()
def load_sessions(
    paths: Sequence[str | Path],
    options: ReadOptions | None = None,
    progress: Progress | None = None,
    **given: Unpack[ReadKeywords],
) -> Dataset:
    """Read one or more recordings of a robot as one dataset.

    Parameters
    ----------
    paths : sequence of str or Path
        Recordings or files of samples. With more than one, the condition `session` numbers them
        from 0.
    options, progress, **given
        As in `load_dataset`; `exclude` and `max_samples` count through all recordings.

    Returns
    -------
    Dataset

    Raises
    ------
    BagError, DatasetError
        As `load_dataset`; also if the recordings differ in joints.

    Examples
    --------
    >>> import parallel_cal as pc
    >>> data = pc.load_sessions(["bags/delta_backlash", "bags/delta_gear_ripple"])
    >>> sorted(set(data.conditions["session"].tolist()))
    [0.0, 1.0]
    """
    options = (options or ReadOptions()).with_values(**given)
    each = options.with_values(exclude=(), max_samples=None)
    datasets = [load_dataset(path, each, progress) for path in paths]
    return select_samples(join_datasets(datasets) if len(datasets) > 1 else datasets[0], options)


def select_samples(dataset: Dataset, options: ReadOptions) -> Dataset:
    """Exclude samples, and use a part of the others, as the options say."""
    kept = dataset.excluding(options.exclude)
    some = kept if options.max_samples is None else kept.thinned(options.max_samples)
    if some is kept:
        return kept
    said = f"{len(some)} of {len(kept)} samples are used, evenly spread over the recording"
    return dataclasses.replace(some, warnings=(*some.warnings, said))


def dataset_from_recording(recording: Recording, options: SampleOptions | None = None) -> Dataset:
    """Make a Dataset; DatasetError if nothing is usable or positions look like millimetres."""
    return dataset_from_aligned(align_clocks(recording), options or SampleOptions())


def dataset_from_aligned(recording: Recording, options: SampleOptions) -> Dataset:
    """Make a Dataset of a recording whose streams are on one clock."""
    recording = join_standstills(recording, options)
    samples = samples_of(recording, options)
    warnings = [*recording.notes, *samples.warnings]
    _drop_millimetres(samples)
    conditions = conditions_of(recording, samples, warnings)
    dataset = _stack(recording, samples, conditions, options)
    distance = np.linalg.norm(dataset.r, axis=1)[dataset.measured[:, :3].any(axis=1)]
    if len(distance) and np.median(distance) > MAX_POSITION_M:
        text = (
            f"the measured position looks like millimetres: median |r| = {np.median(distance):.4g}"
            "; expected metres. Publish metres (REP-103)"
        )
        if not options.assume_units:
            raise UnfitError(f"{recording.source}: {text}, or set assume_units")
        warnings.append(KeyedWarning(text, "unit", "measured position"))
    warnings += _list_unit_suspicions(dataset)
    return dataclasses.replace(dataset, warnings=tuple(warnings))


def _drop_millimetres(samples: Samples) -> None:
    """Drop the few poses that lie more than 100 times further out than the others."""
    distance = np.array([np.linalg.norm(s.r) for s in samples.kept])
    placed = distance[[s.measured[:3].any() for s in samples.kept]]
    usual = float(np.quantile(placed, 0.75)) if len(placed) else 0.0
    bad = (distance > 100.0 * usual) & (distance > 1.0)
    for i in np.flatnonzero(bad):
        detail = f"|r| = {distance[i]:.4g} m, others {usual:.3g} m"
        time = samples.kept[i].time
        samples.dropped.append(Dropped(time, "position looks like millimetres", detail))
    samples.kept = [s for s, b in zip(samples.kept, bad, strict=True) if not b]


def _list_unit_suspicions(dataset: Dataset) -> list[str]:
    """Warn of each joint and condition that does not look like its unit."""
    travel = np.ptp(dataset.q, axis=0)  # samples_of returns at least one sample
    joints = [
        KeyedWarning(
            f"{name} looks like degrees or millimetres: its range is {width:.4g}; "
            "expected rad or m (correct if the joint turns endlessly)",
            "unit",
            name,
        )
        for name, width in zip(dataset.joint_names, travel, strict=True)
        if width > MAX_JOINT_TRAVEL_RAD
    ]
    conditions = [
        KeyedWarning(
            f"{name} does not look like {channel.unit}: it ranges from {values.min():.4g} to "
            f"{values.max():.4g}; expected {low:g} to {high:g}",
            "unit",
            name,
        )
        for name in list_channels("condition", among=dataset.conditions)
        if (channel := find_channel(name))
        for low, high in [channel.plausible]
        for values in [dataset.conditions.get(name, np.zeros(0))]
        if len(values) and not (low <= values.min() and values.max() <= high)
    ]
    return [*joints, *conditions]


def _stack(
    recording: Recording, samples: Samples, conditions: dict[str, Array], options: SampleOptions
) -> Dataset:
    """Stack the samples into the arrays of a Dataset."""
    columns: dict[str, Any] = {
        name: np.array([getattr(s, name) for s in samples.kept])
        for name in PER_SAMPLE
        if name != "pose_id"
    }
    names = recording.joints.names
    sigma = options.joint_sigma
    ids = np.arange(len(samples.kept))  # a moving robot has no replicates
    if samples.mode == "dwell":
        at = Configuration(columns["q"], columns["r"], columns["R"])
        ids = replicate_ids(
            at, columns["measured"], columns["scatter_q"], options.replicate_tolerance
        )
    dropped = sorted((*recording.dropped, *samples.dropped), key=lambda d: d.time)
    return Dataset(
        joint_names=names,
        **columns,
        conditions=conditions,
        pose_id=ids,
        mode=samples.mode,
        joint_sigma=None if sigma is None else broadcast_to_joints(sigma, names, "joint_sigma"),
        dropped=tuple(dropped),
        source=recording.source,
        sha256=recording.sha256,
        frame=recording.pose.frame,
    )


def match_joint_units(dataset: Dataset, mechanism: Mechanism) -> Dataset:
    """Return the dataset with readings in the units of the mechanism, whose joints are in order.

    The angle of a motor becomes the length of its joint by the drive that the model file states.
    DatasetError if the readings have another unit and there is no drive.
    """
    if dataset.joint_units is None:
        return dataset
    drives = mechanism.drives or (None,) * len(mechanism.joints)
    factors = np.ones(len(drives))
    each = zip(mechanism.joints, dataset.joint_units, mechanism.joint_units, drives, strict=True)
    for i, (joint, found, expected, drive) in enumerate(each):
        if found == expected:
            continue
        if drive is None or found == "m":
            raise DatasetError(
                f"{dataset.source}: joint {joint} is {UNIT_WORDS[found]}, but "
                f"{UNIT_WORDS[expected]} in the model ({mechanism.name}). "
                + (MOTOR_CURE.format(joint=joint) if expected == "m" else LENGTH_CURE)
            )
        factors[i] = drive.travel
    conditions = dict(dataset.conditions)
    for joint, factor in zip(mechanism.joints, factors, strict=True):
        moves = dict.fromkeys(("travel", "velocity", "acceleration"), factor)
        for name, by in (moves | {"direction": np.sign(factor)}).items():
            if (key := f"{name}.{joint}") in conditions:
                conditions[key] = conditions[key] * by
    size, sigma = np.abs(factors), dataset.joint_sigma
    return dataclasses.replace(
        dataset,
        q=dataset.q * factors,
        scatter_q=dataset.scatter_q * size,
        joint_sigma=None if sigma is None else sigma * size,
        conditions=conditions,
        joint_units=mechanism.joint_units,
    )


def order_joints(dataset: Dataset, joints: Sequence[str] | None) -> Dataset:
    """Return the dataset with its joints in the given order; DatasetError if one is missing.

    Joints that are only numbered alike are matched, and a warning says so.
    """
    if joints is None or tuple(joints) == dataset.joint_names:
        return dataset
    missing = [name for name in joints if name not in dataset.joint_names]
    if missing and (matched := match_numbered_names(joints, dataset.joint_names)):
        names = {name: joint for joint, name in matched.items()}
        dataset = dataclasses.replace(
            dataset,
            joint_names=tuple(names.get(name, name) for name in dataset.joint_names),
            conditions=rename_conditions(dataset.conditions, names),
            warnings=(*dataset.warnings, describe_match(dataset.source, matched)),
        )
    elif missing:
        raise DatasetError(
            f"{dataset.source}: joints expected: {', '.join(joints)}; in the samples: "
            f"{', '.join(dataset.joint_names)}; not found: {', '.join(missing)}. Use "
            "the same names in the samples (the keys of joints in a column map) and in the model "
            "file"
        )
    order = [dataset.joint_names.index(name) for name in joints]
    sigma, units = dataset.joint_sigma, dataset.joint_units
    return dataclasses.replace(
        dataset,
        joint_names=tuple(joints),
        q=dataset.q[:, order],
        scatter_q=dataset.scatter_q[:, order],
        joint_sigma=None if sigma is None else sigma[order],
        joint_units=None if units is None else tuple(units[k] for k in order),
    )
