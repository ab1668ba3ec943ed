"""Options of reading recordings and of making samples."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypedDict

import numpy as np

from parallel_cal.base.arguments import require_fields
from parallel_cal.base.errors import BagError, DatasetError
from parallel_cal.base.options import with_changes
from parallel_cal.recordings.channels import CHANNELS, CORNERS, list_channels
from parallel_cal.recordings.recording import COORDINATES

if TYPE_CHECKING:
    from parallel_cal.model.mechanism import Mechanism

MODES = ("auto", "dwell", "continuous")
MIN_VALUES = {
    "min_dwell": 0.0,
    "trim_start": 0.0,
    "trim_end": 0.0,
    "max_gap": 0.0,
    "min_joint_messages": 1,
    "min_pose_messages": 1,
    "replicate_tolerance": 0.0,
}


@dataclass(frozen=True)
class SampleOptions:
    """Options of making samples.

    Parameters
    ----------
    mode : str
        `dwell` (one sample per standstill), `continuous` (one per pose message) or `auto`.
        Default `auto`.
    min_dwell : float
        Shortest standstill that is a dwell, s. Default 0.3.
    trim_start, trim_end : float
        Time that is cut off at the start and the end of a dwell, s. Defaults 0.1 and 0.05.
    still_tolerance : float or sequence of float, optional
        How far a joint may deviate while it stands still, rad or m. Default: from the data.
    min_joint_messages : int
        Joint messages that a dwell needs. Default 3.
    min_pose_messages : int, optional
        Pose messages that a dwell needs. Default 3, or 1 if the device sends fewer per dwell.
    max_gap : float, optional
        Longest gap between joint messages around a pose, s. Default: from the data.
    joint_sigma : float or sequence of float, optional
        Standard deviation of joint readings, rad or m. Default: not stated.
    assume_units : bool
        Whether positions that look like millimetres are accepted. Default False.
    replicate_tolerance : float, optional
        Joint distance between two visits of one pose, rad or m. Default: from the data.

    Raises
    ------
    DatasetError
        If a value is outside its range.
    """

    mode: str = "auto"
    min_dwell: float = 0.3
    trim_start: float = 0.1
    trim_end: float = 0.05
    still_tolerance: float | Sequence[float] | None = None
    min_joint_messages: int = 3
    min_pose_messages: int | None = None
    max_gap: float | None = None
    joint_sigma: float | Sequence[float] | None = None
    assume_units: bool = False
    replicate_tolerance: float | None = None

    def __post_init__(self) -> None:
        require_fields(self, DatasetError)
        if self.mode not in MODES:
            raise DatasetError(f"mode='{self.mode}'; expected one of {', '.join(MODES)}")
        for name, least in MIN_VALUES.items():
            value = getattr(self, name)
            if value is not None and not least <= value < np.inf:
                raise DatasetError(f"{name}={value}: expected a number of at least {least:g}")


@dataclass(frozen=True)
class ReadOptions(SampleOptions):
    """Options of reading recordings and of making samples.

    Parameters
    ----------
    topics : dict of str
        Topic of a channel if it differs from the channel's own name; "" switches the channel off.
    joints : sequence of str, optional
        The model's joint names in its order. Default: as recorded.
    measures : sequence of str, optional
        Coordinates that the device really measures. Default: as the messages state.
    stamps : str
        `header` or `log`: which time of a message counts. Default `header`.
    exclude : sequence of int
        Numbers of excluded samples. Default none.
    max_samples : int, optional
        About how many samples to use at most: all visits of poses that are evenly spread over the
        recording. Default: all samples.
    columns : str or Path, optional
        Column map of a table (YAML). Default: the file `TABLE.columns.yaml` beside `TABLE.csv`, or
        else the names in the header.
    images : str or sequence of str
        Topic of the images of a printed board, or one per camera. Default none.
    board : str
        The board in the images, as `COLUMNSxROWS` or `COLUMNSxROWS:DICTIONARY`. Default `8x6`.
    mechanism : Mechanism, optional
        The robot: it states names and order of the joints, and converts angles of motors to lengths
        by the drives that its model file states.
    passive : sequence of str
        Joints without a motor whose readings in the joint states count, beside those of
        `mechanism`. Default none.
    mode : str
        `dwell` (one sample per standstill), `continuous` (one per pose message) or `auto`.
        Default `auto`.
    min_dwell : float
        Shortest standstill that is a dwell, s. Default 0.3.
    trim_start, trim_end : float
        Time that is cut off at the start and the end of a dwell, s. Defaults 0.1 and 0.05.
    still_tolerance : float or sequence of float, optional
        How far a joint may deviate while it stands still, rad or m. Default: from the data.
    min_joint_messages : int
        Joint messages that a dwell needs. Default 3.
    min_pose_messages : int, optional
        Pose messages that a dwell needs. Default 3, or 1 if the device sends fewer per dwell.
    max_gap : float, optional
        Longest gap between joint messages around a pose, s. Default: from the data.
    joint_sigma : float or sequence of float, optional
        Standard deviation of joint readings, rad or m. Default: not stated.
    assume_units : bool
        Whether positions that look like millimetres are accepted. Default False.
    replicate_tolerance : float, optional
        Joint distance between two visits of one pose, rad or m. Default: from the data.

    Raises
    ------
    DatasetError
        If a value of a sample's options is outside its range.
    BagError
        If a channel, a coordinate or `stamps` is unknown.
    """

    topics: Mapping[str, str] = field(default_factory=dict)
    joints: Sequence[str] | None = None
    measures: Sequence[str] | None = None
    stamps: str = "header"
    exclude: Sequence[int] = ()
    max_samples: int | None = None
    columns: str | Path | None = None
    images: str | Sequence[str] = ()
    board: str = "8x6"
    mechanism: Mechanism | None = None
    passive: Sequence[str] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.stamps not in ("header", "log"):
            raise BagError(f"stamps='{self.stamps}' unknown; expected 'header' or 'log'")
        if self.max_samples is not None and self.max_samples < 1:
            raise DatasetError(f"max_samples={self.max_samples}: expected a number of at least 1")
        for what, given, known in (
            ("measures", self.measures or (), COORDINATES),
            ("topics", self.topics, CHANNELS),
        ):
            parts = list_channels("condition", among=given) if known is CHANNELS else ()
            if unknown := [
                name
                for name in given
                if (name not in known and name not in parts) or name == CORNERS
            ]:
                raise BagError(f"{what}: {unknown} unknown; expected some of {', '.join(known)}")

    @property
    def joint_names(self) -> tuple[str, ...] | None:
        """The names of the joints in the order of the model; None if neither option states them."""
        if self.joints is None:
            return self.mechanism.joints if self.mechanism else None
        return tuple(self.joints)

    @property
    def passive_joints(self) -> tuple[str, ...]:
        """Joints without a motor that joint states may contain."""
        return (*self.passive, *(self.mechanism.passive if self.mechanism else ()))

    def with_values(self, **given: Any) -> ReadOptions:
        """Return the options with some values changed; DatasetError for an unknown name."""
        return with_changes(self, ReadOptions, given, DatasetError)


class ReadKeywords(TypedDict, total=False):
    """The fields of ReadOptions as keyword arguments, for functions that take them by name."""

    mode: str
    min_dwell: float
    trim_start: float
    trim_end: float
    still_tolerance: float | Sequence[float] | None
    min_joint_messages: int
    min_pose_messages: int | None
    max_gap: float | None
    joint_sigma: float | Sequence[float] | None
    assume_units: bool
    replicate_tolerance: float | None
    topics: Mapping[str, str]
    joints: Sequence[str] | None
    measures: Sequence[str] | None
    stamps: str
    exclude: Sequence[int]
    max_samples: int | None
    columns: str | Path | None
    images: str | Sequence[str]
    board: str
    mechanism: Mechanism | None
    passive: Sequence[str]
