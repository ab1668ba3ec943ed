"""The Dataset: joints and poses per sample, conditions, replicates, folds, and its file."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from parallel_cal.base.arguments import check_arguments
from parallel_cal.base.documents import to_json_value
from parallel_cal.base.errors import DatasetError
from parallel_cal.base.files import write_atomically
from parallel_cal.base.float_fields import UNCONVERTED, find_unconverted
from parallel_cal.base.sample_names import format_sample
from parallel_cal.model.configuration import Configuration
from parallel_cal.recordings.recording import Array, Bools, Dropped
from parallel_cal.recordings.replicates import (
    ReplicateNoise,
    make_folds,
    replicate_ids,
    replicate_noise,
)
from parallel_cal.recordings.samplefile import (
    FILE_VERSION,
    PER_SAMPLE,
    is_expected,
    read_document,
    restore_field,
)
from parallel_cal.recordings.samples import READING

if TYPE_CHECKING:
    pass

NUMBER = "number"  # the condition that keeps the numbers of samples after others were excluded
# Conditions with these beginnings describe a sample; they are no cause of its error.
DESCRIPTIVE = ("time", NUMBER, "effort.", "reading.")


@dataclass(frozen=True)
class Dataset:
    """N samples of a robot: raw joint readings and raw measured poses in SI units.

    Samples that revisit a pose share `pose_id`. Poses are measured, never computed by forward
    kinematics. If no pose is measured, `conditions` holds what other sensors measured.

    Attributes
    ----------
    joint_names : tuple of str
    q : array (N, nq)
        Joint readings, rad or m.
    r : array (N, 3)
        Measured positions, m; 0 where not measured.
    R : array (N, 3, 3)
        Measured rotations; the identity where not measured.
    measured : array of bool (N, 6)
        Which of x y z rx ry rz are measured; rotations are about axes fixed to the base.
    pose_cov : array (N, 6, 6)
        Covariance of the pose of a sample as the device states it; NaN where it does not.
    joint_sigma : array (nq,), optional
        Standard deviation of joint readings, rad or m; None if not stated.
    joint_units : tuple of str, optional
        `rad` or `m` for each joint, as a table states it; None if not stated.
    time : array (N,)
        s since the recording began.
    duration : array (N,)
        Length of the dwell, s.
    scatter_q, scatter_pose : array (N, nq), (N, 6)
        Standard deviations of single readings within a dwell; NaN where there was only one.
    count_q, count_pose : array of int (N,)
        Numbers of readings that were averaged.
    conditions : dict of array (N,)
        time, temperature, payload, direction.JOINT (-1, 0, 1), travel.JOINT (distance since the
        last reversal), velocity.JOINT, in motion also acceleration.JOINT; for several recordings
        also session, counted from 0.
        reading.SENSOR.CHANNEL: a reading of another sensor, such as the pixels of a corner.
    pose_id : array of int (N,)
        Number of the commanded pose.
    mode : str
        `dwell` or `continuous`.
    dropped : tuple of Dropped
        Messages that were recorded and are not used.
    warnings : tuple of str
    source, sha256, frame : str
        The recording, the hash of its data files, and the frame of the poses.
    recordings : tuple of str
        The hash of each recording, in the order of the condition `session`, if there are several.
    configuration : dict of float
        Numbers with which a controller or an importer computed the joint readings, rad or m:
        parameters of the mechanism by name, and `JOINT.end_stop`. Empty if the joint readings were
        measured.
    excluded : dict of str
        The reason for each sample that was excluded, by its number.
    sides_from_order : bool
        direction.JOINT was not recorded. It follows from the order of a table's rows.
    names : dict of str
        Names of samples, such as those of shots, by their numbers; those of excluded ones, too.
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
    joint_units: tuple[str, ...] | None = None
    configuration: dict[str, float] = dataclasses.field(default_factory=dict)
    recordings: tuple[str, ...] = ()
    excluded: dict[int, str] = dataclasses.field(default_factory=dict)
    sides_from_order: bool = False
    names: dict[int, str] = dataclasses.field(default_factory=dict)

    def __repr__(self) -> str:
        kinds = sorted({name.partition(".")[0] for name in self.conditions})
        return (
            f"Dataset({len(self)} samples of {len(self.joint_names)} joints, conditions: "
            f"{', '.join(kinds) or 'none'}; {self.source or 'from arrays'})"
        )

    @classmethod
    @check_arguments(DatasetError)
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
        """Create a dataset from arrays, without a recording.

        Parameters
        ----------
        joint_names : sequence of str
        q : array (N, nq)
            Joint readings, rad or m.
        r : array (N, 3)
            Measured positions, m.
        R : array (N, 3, 3), optional
            Measured rotations. None: orientations are not measured.
        measured : array of bool (N, 6) or (6,), optional
            Which of x y z rx ry rz are measured. Default: position, and orientation if R is given.
        pose_cov : array (N, 6, 6) or (6, 6), optional
            Covariance of the measured pose, in m and rad. Default: not stated.
        joint_sigma : float or array (nq,), optional
            Standard deviation of the joint readings, rad or m. Default: not stated.
        conditions : dict of array (N,), optional
            As the attribute of that name.
        pose_id : array of int (N,), optional
            Number of the commanded pose. Default: replicates are detected from q.
        **texts
            Other fields of Dataset, such as `source`.

        Returns
        -------
        Dataset

        Raises
        ------
        DatasetError
            If an array has another shape.

        Examples
        --------
        >>> import parallel_cal as pc
        >>> data = pc.Dataset.from_arrays(["a", "b"], [[0.1, 0.2], [0.3, 0.4]], [[0, 0, 1]] * 2)
        >>> len(data), data.measured[0].tolist()
        (2, [True, True, True, False, False, False])
        """
        n, nq = len(np.atleast_1d(q)), len(joint_names)
        q, r = _fill("q", q, (n, nq)), _fill("r", r, (n, 3))
        for name, column in (("q", q), ("r", r)):
            if (at := find_unconverted(column)) is not None:
                raise DatasetError(f"{name}[{at}] is {column[at].tolist()}: {UNCONVERTED}")
        shown = np.arange(6) < (3 if R is None else 6) if measured is None else measured
        which = _fill("measured", shown, (n, 6), (6,)).astype(bool)
        R = np.tile(np.eye(3), (n, 1, 1)) if R is None else _fill("R", R, (n, 3, 3))
        cov = _fill("pose_cov", np.nan if pose_cov is None else pose_cov, (n, 6, 6), (6, 6), ())
        given = {k: _fill(k, v, (n,)) for k, v in (conditions or {}).items()}
        time = given.get(
            "time", np.arange(n, dtype=float)
        )  # without times, the order only; it is no condition
        scatter, one = np.full((n, nq), np.nan), np.ones(n, np.int64)
        if pose_id is None:
            pose_id = replicate_ids(Configuration(q, r, R), which, scatter)
        sigma = None if joint_sigma is None else _fill("joint_sigma", joint_sigma, (nq,), ())
        return cls(
            tuple(joint_names),
            q,
            r,
            R,
            which,
            cov,
            sigma,
            time,
            np.zeros(n),
            scatter,
            np.full((n, 6), np.nan),
            one,
            one.copy(),
            given,
            np.array(pose_id, np.int64),
            **texts,
        )

    def __len__(self) -> int:
        return len(self.q)

    @property
    def has_time(self) -> bool:
        """Whether the times of the samples were recorded; otherwise `time` is only their order."""
        return "time" in self.conditions

    def select(self, which: ArrayLike) -> Dataset:
        """Return the samples of a boolean mask (N,), or of indices in their order.

        The samples keep their `pose_id`. DatasetError if the mask has another length.
        """
        index = np.asarray(which)
        if index.dtype == bool and index.shape != (len(self),):
            raise DatasetError(f"mask of shape {index.shape}; expected ({len(self)},)")
        index = np.arange(len(self))[index.astype(int) if index.dtype != bool else index]
        changed: dict[str, Any] = {name: getattr(self, name)[index] for name in PER_SAMPLE}
        changed["conditions"] = {k: v[index] for k, v in self.conditions.items()}
        if NUMBER not in self.conditions:  # the samples get new numbers
            names = (self.names.get(i, "") for i in index.tolist())
            changed["names"] = {k: name for k, name in enumerate(names) if name}
        return dataclasses.replace(self, **changed)

    def title(self, number: int) -> str:
        """Return the number of a sample, and its name if it has one: `40 'S041'`."""
        return format_sample(number, self.names.get(number, ""))

    @cached_property  # a list of all samples asks for the number of each
    def numbers(self) -> NDArray[np.int64]:
        """Index (N,) of each sample in the recording, before any sample was excluded."""
        own = self.conditions.get(NUMBER)
        found = np.arange(len(self)) if own is None else own.astype(np.int64)
        found.setflags(write=False)
        return found

    def excluding(
        self, numbers: Sequence[int] | Mapping[int, str], why: str = "on request"
    ) -> Dataset:
        """Return the dataset without the samples of these numbers; the others keep their numbers.

        The warning about them contains `why`. A mapping states the reason for each number; `why`
        is the reason otherwise. DatasetError for an unknown number.
        """
        if unknown := sorted(set(numbers) - set(self.numbers.tolist())):
            raise DatasetError(
                f"{self.source}: no sample {unknown[0]} to exclude; there are {len(self)}, "
                f"numbered {self.numbers.min()} to {self.numbers.max()}"
            )
        if not numbers:
            return self
        said = f"excluded {why}: sample {', '.join(map(str, sorted(numbers)))}"
        kept = self.select_numbered(~np.isin(self.numbers, list(numbers)))
        reasons = numbers if isinstance(numbers, Mapping) else dict.fromkeys(numbers, why)
        return dataclasses.replace(
            kept,
            warnings=(*self.warnings, said),
            excluded={**self.excluded, **{int(n): reason for n, reason in reasons.items()}},
        )

    def thinned(self, most: int) -> Dataset:
        """Return about `most` samples, and no more unless one pose has them: every visit of poses
        that are evenly spread over the recording. The samples keep their numbers."""
        if len(self) <= most:
            return self
        poses, visits = np.unique(self.pose_id, return_counts=True)
        for count in range(max(1, most * len(poses) // len(self)), 0, -1):
            chosen = np.linspace(0, len(poses) - 1, count).astype(int)
            if visits[chosen].sum() <= most:  # else a part would be thinned again
                break
        return self.select_numbered(np.isin(self.pose_id, poses[chosen]))

    def select_numbered(self, kept: ArrayLike) -> Dataset:
        """Return samples as `select` does, with the numbers that they have now."""
        numbers = {NUMBER: self.numbers.astype(float)}
        named = dataclasses.replace(self, conditions={**self.conditions, **numbers})
        return named.select(kept)

    def replicate_noise(self) -> ReplicateNoise:
        """Return the scatter of revisited poses: noise that no model of the pose can explain."""
        return replicate_noise(self.pose_id, Configuration(self.q, self.r, self.R), self.measured)

    def folds(
        self, fraction: float = 0.25, seed: int = 0
    ) -> list[tuple[NDArray[np.intp], NDArray[np.intp]]]:
        """Return (train, test) indices of round(1/fraction) folds; every sample is tested once.

        All replicates of a pose are in the same fold, and both ends of a distance: samples that are
        the only two with a reading of one channel. In a continuous motion, samples that follow each
        other in time are in the same fold.
        """
        groups = self.pose_id.copy()
        for name, read in self.conditions.items():
            ends = np.flatnonzero(np.isfinite(read))
            if name.startswith(READING) and len(ends) == 2:
                groups[groups == groups[ends[1]]] = groups[ends[0]]
        if self.mode == "continuous" and 0.0 < fraction <= 0.5:
            blocks = min(len(self), 5 * round(1.0 / fraction))
            groups = np.arange(len(self)) * blocks // max(1, len(self))
        return make_folds(groups, fraction, seed)

    def to_json(self, path: str | Path) -> None:
        """Write the samples to a file atomically; `from_json` returns the same numbers."""
        document = {"parallel_cal_samples": FILE_VERSION, **to_json_value(self)}
        write_atomically(path, json.dumps(document, allow_nan=False))

    @classmethod
    def from_json(cls, path: str | Path) -> Dataset:
        """Read a file that `to_json` wrote; DatasetError contains its name and the wrong key."""
        return cls.from_document(read_document(Path(path)), str(path))

    @classmethod
    def from_document(cls, document: Mapping[str, Any], name: str) -> Dataset:
        """Create a dataset from a parsed JSON document.

        `name` is the name of the file for messages. DatasetError contains it and the wrong key.
        """
        try:
            names = [f.name for f in dataclasses.fields(cls) if is_expected(f.name, document)]
            return cls(**{name: restore_field(name, document) for name in names})
        except DatasetError as error:
            raise DatasetError(f"{name}: not a complete sample file: {error}") from None


def _fill(name: str, value: ArrayLike, *shapes: tuple[int, ...]) -> NDArray[np.float64]:
    """Return an array of the first shape. A value of another allowed shape is repeated."""
    found = np.array(value, dtype=float)
    if found.shape not in shapes:
        allowed = " or ".join(map(str, shapes))
        raise DatasetError(f"{name} has the shape {found.shape}; expected {allowed}")
    return np.broadcast_to(found, shapes[0]).copy()
