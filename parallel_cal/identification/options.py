"""Options of an identification."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, TypedDict

from parallel_cal.base.arguments import require_fields
from parallel_cal.base.errors import FitError
from parallel_cal.base.options import option

if TYPE_CHECKING:  # the command line shows its help without numpy
    from parallel_cal.identification.prior import Prior


# Options that a measurement plan has, too.
FREE = option(
    "identify the parameters that match this wildcard, such as 'chain1.*'. If --fix matches a "
    "parameter, too, the option that matches fewer parameters decides: --fix '*' --free 'chain1.*' "
    "identifies only chain 1"
)
FIX = option(
    "do not identify the parameters that match this wildcard. If --free matches a parameter, too, "
    "the option that matches fewer parameters decides"
)
PRIOR = option("use tolerances as priors of all parameters, not only of weakly determined ones")


@dataclass(frozen=True)
class FitOptions:
    """Options of a fit.

    Parameters
    ----------
    method : str
        Method of identification. Default `implicit`.
    free, fix : sequence of str
        Wildcards for parameter names (`chain1.*`). `free` adds parameters to the free ones of the
        model file, `fix` removes some. Where both match, the option that matches fewer
        parameters decides: `fix=["*"], free=["chain1.Lb"]` identifies `chain1.Lb` only. All
        parameters that this option matches must match the other one, too; otherwise FitError is
        raised. Default none.
    refit : sequence of str
        Wildcards for the names of the parameters to identify again. All other parameters keep their
        values and covariance. Use it if only some parameters changed, for example after re-homing
        or warm-up; a few poses are then enough. Default none: identify all free parameters.
    hold_out : float
        Share of the poses that each fold of the cross-validation holds out, up to 0.5. 0: no
        cross-validation. A very small share, such as 0.001, holds out one pose at a time
        (leave-one-out). Default 0.25.
    joint_sigma : float, optional
        Standard deviation of the joint readings, rad or m. The identified model keeps it as its
        `noise`. Default None: take it from the recording, else from the model file, else from the
        scatter within dwells.
    prior : bool or Prior, optional
        Prior knowledge of the parameters. True uses the tolerances of all parameters as priors,
        False uses none. None uses them only for parameters, or combinations of
        parameters, that the data determine weakly. A Prior states mean and covariance.
        Default None.
    update : bool
        Whether the last calibration is the prior: the covariance that the model has, widened by the
        usual drift since. A few touches are then enough. Default False.
    loss : str
        Loss function of scipy, such as `huber`. The result lists samples with a low weight.
        Default `linear`.
    seed : int
        Seed of the folds. Default 0.
    insist : bool
        Whether to accept implausible joint readings, and values of an effect that are physically
        impossible together (a hysteresis larger than the travel over which it builds up).
        Default False.
    usual_only : bool
        Whether effects that are larger than usual for the machine's class are refused. By default
        (False) they are accepted with a warning, because a usual size is no measurement of this
        machine.

    Raises
    ------
    FitError
        If `hold_out` is negative. A share above 0.5 is refused by the fit.
    """

    method: str = field(default="implicit", metadata=option("identification method"))
    free: Sequence[str] = field(default=(), metadata=FREE)
    fix: Sequence[str] = field(default=(), metadata=FIX)
    refit: Sequence[str] = field(
        default=(),
        metadata=option(
            "identify only the parameters that match this wildcard; the others keep their values "
            "and their covariance"
        ),
    )
    hold_out: float = field(
        default=0.25,
        metadata=option(
            "share of the poses that each fold of the cross-validation holds out; 0: no "
            "cross-validation; a very small share, such as 0.001: one pose at a time "
            "(leave-one-out)",
            min=0.0,
            max=0.5,
        ),
    )
    joint_sigma: float | None = field(
        default=None, metadata=option("noise of the joint readings, 1 sigma (rad or m)", min=0.0)
    )
    prior: bool | Prior | None = field(default=None, metadata=PRIOR)
    loss: str = field(
        default="linear",
        metadata=option("linear, or robust to outliers: huber, soft_l1, cauchy, arctan"),
    )
    update: bool = field(
        default=False,
        metadata=option(
            "update the last calibration: its covariance in the model file, widened by the usual "
            "drift since, is the prior; a few samples are enough"
        ),
    )
    usual_only: bool = field(
        default=False,
        metadata=option(
            "refuse effects that are larger than usual for the machine's class, instead of "
            "accepting them with a warning"
        ),
    )
    seed: int = 0
    insist: bool = False

    def __post_init__(self) -> None:
        """Raise FitError for a wrong kind of value or a negative share; a share that is too large
        is refused later."""
        require_fields(self, FitError)
        if not self.hold_out >= 0:
            raise FitError(f"hold_out {self.hold_out}: expected 0 (no validation) to 0.5")
        if self.update and (self.refit or self.prior is True):
            raise FitError(
                "update has the last calibration as its prior: do not combine it with prior or "
                "refit"
            )


class FitKeywords(TypedDict, total=False):
    """The fields of FitOptions as keyword arguments, for functions that take them by name."""

    method: str
    free: Sequence[str]
    fix: Sequence[str]
    refit: Sequence[str]
    hold_out: float
    joint_sigma: float | None
    prior: bool | Prior | None
    update: bool
    loss: str
    usual_only: bool
    seed: int
    insist: bool
