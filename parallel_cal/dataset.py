"""Channels -> Dataset: raw joints and poses per sample, conditions, replicates, folds, a file."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from parallel_cal.errors import DatasetError
from parallel_cal.recordings.recording import Array, Bools, Dropped, Progress, Recording, Topics
from parallel_cal.recordings.replicates import (
    ReplicateNoise,
    make_folds,
    replicate_ids,
    replicate_noise,
)
from parallel_cal.recordings.samplefile import (
    FILE_VERSION,
    PER_SAMPLE,
    holds_samples,
    plain,
    read_document,
    restored,
    write_atomically,
)
from parallel_cal.recordings.samples import Options, Samples, mean_rotation, per_joint
from parallel_cal.recordings.sampling import conditions_of, samples_of
from parallel_cal.recordings.sessions import joined

NUMBER = "number"  # the condition that keeps a sample's number where others were excluded
METRES = 10.0  # positions typically further than this from the origin are taken for millimetres
# name -> unit and what it is expected to be within; kelvin lie beyond
PLAUSIBLE = {"temperature": ("degC", -60.0, 150.0), "payload": ("kg", 0.0, 1e5)}
TURNS = 4.0 * np.pi  # joints that travel further are taken for degrees, or turn endlessly


@dataclass(frozen=True)
class Dataset:
    """N samples of a robot: raw joint readings and raw measured poses in SI, never FK output.

    q (N, nq) rad or m; r (N, 3) m; R (N, 3, 3); `measured` (N, 6) marks x y z rx ry rz, rotations
    about base-fixed axes; r and R hold 0 and identity where nothing is measured. `pose_cov`
    (N, 6, 6) is the accuracy of a sample as the device states it, NaN where it does not;
    `joint_sigma` (nq,) likewise or None. `scatter_q` (N, nq) and `scatter_pose` (N, 6) are the
    standard deviations of single readings within a dwell, NaN where there was one. `conditions`
    hold (N,) arrays: time, temperature, payload, direction.JOINT in -1 0 1, travel.JOINT (way
    since the last reversal), velocity.JOINT; of several recordings also session, from 0.
    Samples that revisit a pose share `pose_id`.
    """

    joint_names: tuple[str, ...]
    q: Array
    r: Array
    R: Array
    measured: Bools
    pose_cov: Array
    joint_sigma: Array | None
    time: Array
    duration: Array
    scatter_q: Array
    scatter_pose: Array
    count_q: NDArray[np.int64]
    count_pose: NDArray[np.int64]
    conditions: dict[str, Array]
    pose_id: NDArray[np.int64]
    mode: str = "dwell"
    dropped: tuple[Dropped, ...] = ()
    warnings: tuple[str, ...] = ()
    source: str = ""
    sha256: str = ""
    frame: str = ""

    @classmethod
    def from_arrays(
        cls,
        joint_names: Sequence[str],
        q: ArrayLike,
        r: ArrayLike,
        R: ArrayLike | None = None,
        *,
        measured: ArrayLike | None = None,
        pose_cov: ArrayLike | None = None,
        joint_sigma: ArrayLike | None = None,
        conditions: Mapping[str, ArrayLike] | None = None,
        pose_id: ArrayLike | None = None,
        **texts: Any,
    ) -> Dataset:
        """A dataset of q (N, nq), r (N, 3), R (N, 3, 3) without a recording; R None: not measured.

        `pose_cov` may be (6, 6) for all samples; replicates are looked for unless pose_id is given.
        """
        q, r = np.array(q, float), np.array(r, float)
        n, nq = q.shape
        shown = np.arange(6) < (3 if R is None else 6)
        measured = np.broadcast_to(shown if measured is None else np.array(measured, bool), (n, 6))
        R = np.broadcast_to(np.eye(3), (n, 3, 3)) if R is None else np.array(R, float)
        cov = np.full((6, 6), np.nan) if pose_cov is None else np.array(pose_cov, float)
        given = {k: np.array(v, float) for k, v in (conditions or {}).items()}
        time = given.setdefault("time", np.arange(n, dtype=float))
        scatter, one = np.full((n, nq), np.nan), np.ones(n, np.int64)
        if pose_id is None:
            pose_id = replicate_ids(q, r, R, measured, scatter)
        sigma = None if joint_sigma is None else np.broadcast_to(joint_sigma, (nq,)).astype(float)
        return cls(
            tuple(joint_names), q, r, R.copy(), measured.copy(),
            np.broadcast_to(cov, (n, 6, 6)).copy(), sigma, time, np.zeros(n), scatter,
            np.full((n, 6), np.nan), one, one.copy(), given, np.array(pose_id, np.int64), **texts,
        )  # fmt: skip

    def __len__(self) -> int:
        return len(self.q)

    def select(self, which: ArrayLike) -> Dataset:
        """The samples of a mask (N,) or of indices, in that order; `pose_id` stays."""
        index = np.asarray(which)
        if index.dtype == bool and index.shape != (len(self),):
            raise DatasetError(f"mask of shape {index.shape}; expected ({len(self)},)")
        index = np.arange(len(self))[index.astype(int) if index.dtype != bool else index]
        changed: dict[str, Any] = {name: getattr(self, name)[index] for name in PER_SAMPLE}
        changed["conditions"] = {k: v[index] for k, v in self.conditions.items()}
        return dataclasses.replace(self, **changed)

    @property
    def numbers(self) -> NDArray[np.int64]:
        """Number (N,) by which each sample is named: its place before any was excluded."""
        own = self.conditions.get(NUMBER)
        return np.arange(len(self)) if own is None else own.astype(np.int64)

    def excluding(self, numbers: Sequence[int]) -> Dataset:
        """Without some samples, the others keeping their numbers; DatasetError for a number that
        there is not."""
        if unknown := sorted(set(numbers) - set(self.numbers.tolist())):
            raise DatasetError(
                f"{self.source}: no sample {unknown[0]} to exclude; there are {len(self)}, "
                f"numbered {self.numbers.min()} to {self.numbers.max()}"
            )
        if not numbers:
            return self
        named = dataclasses.replace(
            self, conditions={**self.conditions, NUMBER: self.numbers.astype(float)}
        )
        said = f"left out on request: sample {', '.join(map(str, sorted(numbers)))}"
        kept = named.select(~np.isin(self.numbers, list(numbers)))
        return dataclasses.replace(kept, warnings=(*self.warnings, said))

    def replicate_noise(self) -> ReplicateNoise:
        """Scatter of revisited poses: the noise that no model of the pose alone can explain."""
        ids = np.unique(self.pose_id, return_inverse=True)[1]
        means = [mean_rotation(self.R[ids == g]) for g in range(int(ids.max(initial=-1)) + 1)]
        rotations = np.array(means).reshape(-1, 3, 3)
        return replicate_noise(ids, self.q, self.r, self.R, self.measured, rotations)

    def folds(
        self, fraction: float = 0.25, seed: int = 0
    ) -> list[tuple[NDArray[np.intp], NDArray[np.intp]]]:
        """(train, test) indices of round(1/fraction) folds; every sample is tested once.

        Replicates of a pose stay together, as do neighbours in time of a continuous motion.
        """
        groups = self.pose_id
        if self.mode == "continuous" and 0.0 < fraction <= 0.5:
            blocks = min(len(self), 5 * round(1.0 / fraction))
            groups = np.arange(len(self)) * blocks // max(1, len(self))
        return make_folds(groups, fraction, seed)

    def to_json(self, path: str | Path) -> None:
        """Write the samples to a file, all or nothing; `from_json` gives back the same numbers."""
        document: dict[str, Any] = {"parallel_cal_samples": FILE_VERSION}
        for item in dataclasses.fields(self):
            document[item.name] = plain(getattr(self, item.name))
        write_atomically(Path(path), document)

    @classmethod
    def from_json(cls, path: str | Path) -> Dataset:
        """Read a file of `to_json`; DatasetError naming the file and the key that is wrong."""
        document = read_document(Path(path))
        try:
            return cls(**{f.name: restored(f.name, document) for f in dataclasses.fields(cls)})
        except (KeyError, TypeError, ValueError) as error:
            raise DatasetError(f"{path}: not a complete sample file: {error!r}") from error


def load_dataset(
    path: str | Path,
    *,
    topics: Topics | None = None,
    joints: Sequence[str] | None = None,
    measures: Sequence[str] | None = None,
    stamps: str = "header",
    progress: Progress | None = None,
    **options: Any,
) -> Dataset:
    """Samples of a recording, or of a file written by `to_json`; further options as in Options.

    `joints` are the model's joint names in its order. BagError or DatasetError when none can be
    had.
    """
    if holds_samples(Path(path)):
        return _in_order(Dataset.from_json(path), joints)
    from parallel_cal.bag import read_bag

    recording = read_bag(
        path, topics, joints=joints, measures=measures, stamps=stamps, progress=progress
    )
    return dataset_from_recording(recording, make_options(**options))


def load_sessions(
    paths: Sequence[str | Path], *, exclude: Sequence[int] = (), **how: Any
) -> Dataset:
    """One Dataset of one or more recordings; of more than one, samples know their `session`.

    `exclude` are numbers of samples to leave out, `how` as in `load_dataset`; DatasetError where
    the recordings do not go together.
    """
    datasets = [load_dataset(path, **how) for path in paths]
    dataset = joined(datasets) if len(datasets) > 1 else datasets[0]
    return dataset.excluding(exclude)


def make_options(**options: Any) -> Options:
    """Options by name; DatasetError for an unknown one, naming those that exist."""
    known = [item.name for item in dataclasses.fields(Options)]
    unknown = sorted(set(options) - set(known))
    if unknown:
        raise DatasetError(f"unknown option {', '.join(unknown)}; known: {', '.join(known)}")
    return Options(**options)


def dataset_from_recording(recording: Recording, options: Options | None = None) -> Dataset:
    """Make a Dataset; DatasetError when nothing is usable or positions look like millimetres."""
    options = options or Options()
    samples = samples_of(recording, options)
    warnings = [*recording.notes, *samples.warnings]
    _drop_millimetres(samples)
    conditions = conditions_of(recording, samples, warnings)
    dataset = _stack(recording, samples, conditions, options)
    far = _position_suspicions(dataset)
    if far and not options.assume_units:
        raise DatasetError(f"{recording.source}: {far[0]}, or set assume_units")
    warnings += far + _joint_suspicions(dataset) + _condition_suspicions(conditions)
    return dataclasses.replace(dataset, warnings=tuple(warnings))


def _drop_millimetres(samples: Samples) -> None:
    """Drop the few poses that lie hundreds of times further out than the others."""
    distance = np.array([np.linalg.norm(s.r) for s in samples.kept])
    placed = distance[[s.measured[:3].any() for s in samples.kept]]
    usual = float(np.quantile(placed, 0.75)) if len(placed) else 0.0
    bad = (distance > 100.0 * usual) & (distance > 1.0)
    for i in np.flatnonzero(bad):
        detail = f"|r| = {distance[i]:.4g} m, others {usual:.3g} m"
        time = samples.kept[i].time
        samples.dropped.append(Dropped(time, "position looks like millimetres", detail))
    samples.kept = [s for s, b in zip(samples.kept, bad, strict=True) if not b]


def _position_suspicions(dataset: Dataset) -> list[str]:
    """A sentence if the positions do not look like metres."""
    distance = np.linalg.norm(dataset.r, axis=1)[dataset.measured[:, :3].any(axis=1)]
    if not len(distance) or np.median(distance) <= METRES:
        return []
    return [
        f"the measured position looks like millimetres: median |r| = {np.median(distance):.4g}; "
        "expected metres. Publish metres (REP-103)"
    ]


def _joint_suspicions(dataset: Dataset) -> list[str]:
    """A sentence for each joint that does not look like radians or metres."""
    travel = np.ptp(dataset.q, axis=0) if len(dataset) else np.zeros(len(dataset.joint_names))
    return [
        f"{name} looks like degrees or millimetres: it travels {width:.4g}; expected rad or m "
        "(fine if it turns endlessly)"
        for name, width in zip(dataset.joint_names, travel, strict=True)
        if width > TURNS
    ]


def _condition_suspicions(conditions: Mapping[str, Array]) -> list[str]:
    """A sentence for each condition that can hardly be in its unit."""
    return [
        f"{name} does not look like {unit}: it goes from {values.min():.4g} to {values.max():.4g}; "
        f"expected {low:g} to {high:g}"
        for name, (unit, low, high) in PLAUSIBLE.items()
        for values in [conditions.get(name, np.zeros(0))]
        if len(values) and not (low <= values.min() and values.max() <= high)
    ]


def _stack(
    recording: Recording, samples: Samples, conditions: dict[str, Array], options: Options
) -> Dataset:
    """The samples as one block of arrays."""
    columns: dict[str, Any] = {
        name: np.array([getattr(s, name) for s in samples.kept])
        for name in PER_SAMPLE
        if name != "pose_id"
    }
    names = recording.joints.names
    sigma = options.joint_sigma
    scatter = columns["scatter_q"]
    ids = np.arange(len(samples.kept))  # a moving robot does not revisit poses in our sense
    if samples.mode == "dwell":
        q, r, R = (columns[name] for name in ("q", "r", "R"))
        ids = replicate_ids(q, r, R, columns["measured"], scatter, options.replicate_tolerance)
    dropped = sorted((*recording.dropped, *samples.dropped), key=lambda d: d.time)
    return Dataset(
        joint_names=names, **columns, conditions=conditions, pose_id=ids, mode=samples.mode,
        joint_sigma=None if sigma is None else per_joint(sigma, names, "joint_sigma"),
        dropped=tuple(dropped), source=recording.source, sha256=recording.sha256,
        frame=recording.pose.frame,
    )  # fmt: skip


def _in_order(dataset: Dataset, joints: Sequence[str] | None) -> Dataset:
    """The dataset with its joints in the wanted order; DatasetError when one is missing."""
    if joints is None or tuple(joints) == dataset.joint_names:
        return dataset
    missing = [name for name in joints if name not in dataset.joint_names]
    if missing:
        raise DatasetError(
            f"{dataset.source}: joints expected: {', '.join(joints)}; in the samples: "
            f"{', '.join(dataset.joint_names)}; not found: {', '.join(missing)}"
        )
    order = [dataset.joint_names.index(name) for name in joints]
    sigma = dataset.joint_sigma
    return dataclasses.replace(
        dataset, joint_names=tuple(joints), q=dataset.q[:, order],
        scatter_q=dataset.scatter_q[:, order], joint_sigma=None if sigma is None else sigma[order],
    )  # fmt: skip
