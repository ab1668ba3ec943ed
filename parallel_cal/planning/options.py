"""Options of a measurement plan."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, TypedDict

from parallel_cal.base.arguments import require_fields
from parallel_cal.base.errors import FitError
from parallel_cal.base.options import option
from parallel_cal.identification.options import FIX, FREE, PRIOR

if TYPE_CHECKING:  # the command line shows its help without numpy
    from parallel_cal.kinematics.kinematics import Solutions

LINEAR = ("D", "A", "prediction")  # criteria that a small update of the inverse gives
SPECTRAL = ("condition", "noise_amplification")
CRITERIA = (*LINEAR, *SPECTRAL)
METHODS = ("exchange", "annealing")


class PlanKeywords(TypedDict, total=False):
    """The fields of PlanOptions as keyword arguments."""

    criterion: str
    method: str
    pool: int | Solutions
    symmetric: bool
    free: Sequence[str]
    fix: Sequence[str]
    prior: bool
    update: bool
    seed: int


@dataclass(frozen=True)
class PlanOptions:
    """Options of a measurement plan.

    Parameters
    ----------
    criterion : str
        `prediction` (mean variance of the predicted pose over the workspace), `D` (determinant of
        the information matrix M), `A` (trace of M^-1: the sum of the variances of the
        parameters, each in units of its tolerance), `condition` (condition number of the Jacobian
        J, M = J^T J) or `noise_amplification` (index of Nahvi: s_min^2 / s_max, singular values of
        J). Use `prediction` if you have no other reason. Default `prediction`.
    method : str
        `exchange` or `annealing`; `condition` and `noise_amplification` need `annealing`.
        Default: `exchange` if the criterion allows it.
    pool : int or Solutions
        Number of poses to draw, or the poses to choose from.
    symmetric : bool
        Whether poses are chosen in sets of three, 120 degrees about z apart. Default False.
    free, fix : sequence of str
        As in FitOptions. Default none.
    prior : bool
        As in FitOptions. Default False.
    update : bool
        As in FitOptions: the last calibration is the prior. The poses are then in the order of
        their information about the drift since. Default False.
    seed : int
        Seed of the draws. Default 0.

    Raises
    ------
    FitError
        If the criterion or the method is unknown, or they do not fit together.
    """

    criterion: str = field(
        default="prediction",
        metadata=option(
            "prediction (mean variance of the predicted pose), D (determinant of the information), "
            "A (sum of the parameters' variances), condition (condition number) or "
            "noise_amplification"
        ),
    )
    method: str = field(
        default="",
        metadata=option(
            "exchange or annealing [default: annealing for the criteria condition and "
            "noise_amplification, else exchange]"
        ),
    )
    pool: int | Solutions = field(
        default=1000, metadata=option("number of candidate poses in the workspace", min=1)
    )
    symmetric: bool = field(
        default=False, metadata=option("choose triples of poses, 120 deg apart about z")
    )
    free: Sequence[str] = field(default=(), metadata=FREE)
    fix: Sequence[str] = field(default=(), metadata=FIX)
    prior: bool = field(default=False, metadata=PRIOR)
    update: bool = field(
        default=False,
        metadata=option(
            "plan for fit --update: the last calibration is the prior; the poses are in the order "
            "of what they tell about the drift since, and the fewest that suffice are named"
        ),
    )
    seed: int = field(default=0, metadata=option("seed of the candidates", min=0))

    def __post_init__(self) -> None:
        require_fields(self, FitError)
        if self.criterion not in CRITERIA:
            raise FitError(f"no criterion '{self.criterion}'; there are {', '.join(CRITERIA)}")
        if self.chosen_method not in METHODS:
            raise FitError(f"no method '{self.method}'; there are {', '.join(METHODS)}")
        if self.chosen_method == "exchange" and self.criterion not in LINEAR:
            raise FitError(f"criterion '{self.criterion}' needs the method annealing")

    @property
    def chosen_method(self) -> str:
        """The given method, or by default a method that the criterion allows."""
        return self.method or ("exchange" if self.criterion in LINEAR else "annealing")
