"""How a model is identified: what a caller may choose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypedDict

from parallel_cal.base.errors import FitError

if TYPE_CHECKING:  # the command line shows its help without numpy
    from parallel_cal.identification.prior import Prior


@dataclass(frozen=True)
class FitOptions:
    """What a fit may be asked.

    `free` and `fix` are name patterns (`chain1.*`) that change what the model file says; where
    one set lies inside the other the narrower wins (`fix=["*"], free=["chain1.Lb"]`). `refit`
    identifies these alone and keeps the others with the model's covariance (re-homing, warming
    up: a few poses are enough). `hold_out` is the share of the poses left out in turn (0: none),
    drawn by `seed`; `joint_sigma` (rad or m) replaces what recording and model file say. `prior`
    is None (tolerances where the data tell less), True (throughout), False (nowhere) or a Prior;
    `loss` one of scipy's (`huber`): samples that it mistrusts are named; `insist` takes an effect's
    number that lies outside its range.
    """

    method: str = "implicit"
    free: Sequence[str] = ()
    fix: Sequence[str] = ()
    refit: Sequence[str] = ()
    hold_out: float = 0.25
    joint_sigma: float | None = None
    prior: bool | Prior | None = None
    loss: str = "linear"
    seed: int = 0
    insist: bool = False

    def __post_init__(self) -> None:
        """FitError for a share of the poses that is none; too large ones are refused later."""
        if not self.hold_out >= 0:
            raise FitError(f"hold_out {self.hold_out}: expected 0 (no check) to 0.5")


class FitKeywords(TypedDict, total=False):
    """The fields of FitOptions as keyword arguments, for functions that take them by name."""

    method: str
    free: Sequence[str]
    fix: Sequence[str]
    refit: Sequence[str]
    hold_out: float
    joint_sigma: float | None
    prior: bool | Prior | None
    loss: str
    seed: int
    insist: bool
