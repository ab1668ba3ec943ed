"""Channels -> Dataset: raw joints and poses per sample, conditions, replicates, folds, a file."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from parallel_cal.base.documents import to_json_value
from parallel_cal.base.errors import DatasetError, ModelError
from parallel_cal.base.files import write_atomically
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
    read_document,
    restore_field,
)

if TYPE_CHECKING:
    from parallel_cal.model.model import Model

NUMBER = "number"  # the condition that keeps a sample's number where others were excluded


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

    def __repr__(self) -> str:
        kinds = sorted({name.partition(".")[0] for name in self.conditions})
        return (
            f"Dataset({len(self)} samples of {len(self.joint_names)} joints, conditions: "
            f"{', '.join(kinds) or 'none'}; {self.source or 'from arrays'})"
        )

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
        time = given.get("time", np.arange(n, dtype=float))  # an order is no time: not recorded
        scatter, one = np.full((n, nq), np.nan), np.ones(n, np.int64)
        if pose_id is None:
            pose_id = replicate_ids(Configuration(q, r, R), measured, scatter)
        sigma = None if joint_sigma is None else np.broadcast_to(joint_sigma, (nq,)).astype(float)
        return cls(
            tuple(joint_names),
            q,
            r,
            R.copy(),
            measured.copy(),
            np.broadcast_to(cov, (n, 6, 6)).copy(),
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

    def excluding(self, numbers: Sequence[int], why: str = "on request") -> Dataset:
        """Without some samples, the others keeping their numbers, with a word why; DatasetError
        for a number that there is not."""
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
        said = f"excluded {why}: sample {', '.join(map(str, sorted(numbers)))}"
        kept = named.select(~np.isin(self.numbers, list(numbers)))
        return dataclasses.replace(kept, warnings=(*self.warnings, said))

    def replicate_noise(self) -> ReplicateNoise:
        """Scatter of revisited poses: the noise that no model of the pose alone can explain."""
        return replicate_noise(self.pose_id, Configuration(self.q, self.r, self.R), self.measured)

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
        document = {"parallel_cal_samples": FILE_VERSION, **to_json_value(self)}
        write_atomically(path, json.dumps(document, allow_nan=False))

    @classmethod
    def from_json(cls, path: str | Path) -> Dataset:
        """Read a file of `to_json`; DatasetError naming the file and the key that is wrong."""
        return cls.from_document(read_document(Path(path)), str(path))

    @classmethod
    def from_document(cls, document: Mapping[str, Any], name: str) -> Dataset:
        """The samples of a file's document; DatasetError naming the file and the wrong key."""
        try:
            return cls(**{f.name: restore_field(f.name, document) for f in dataclasses.fields(cls)})
        except DatasetError as error:
            raise DatasetError(f"{name}: not a complete sample file: {error}") from None


def check_inputs(model: Model, dataset: Dataset) -> None:
    """Raise ModelError or DatasetError if an argument is of another kind, such as a file's path."""
    for name, value, attribute, error, cure in (
        ("model", model, "mechanism", ModelError, "read_model(path) or new_model(name)"),
        ("dataset", dataset, "joint_names", DatasetError, "load_dataset(path)"),
    ):
        if not hasattr(value, attribute):
            raise error(
                f"{name} is {value!r:.60} ({type(value).__name__}); expected a "
                f"{name.capitalize()}, as parallel_cal.{cure} returns it"
            )
