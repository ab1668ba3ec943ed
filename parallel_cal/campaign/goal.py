"""The goal of a campaign and its limits."""

from __future__ import annotations

from dataclasses import dataclass

from parallel_cal.identification.recheck import CERTAINTY, check_certainty
from parallel_cal.model.mechanism import Box


@dataclass(frozen=True)
class Goal:
    """The goal of a campaign and its limits.

    Parameters
    ----------
    poses : int
        Largest number of poses. Default 80.
    minutes : float
        Longest duration, min. Default 60.
    enough : float
        Stop at this rms position error at the validation poses, m (rad if no position is measured).
        Default 0: stop at a verdict.
    effects : tuple of str
        Candidate effects. Default: all.
    keep_out : tuple of Box
        Boxes in {B} that the robot must not enter. Default: none.
    payload : float
        Mass that a person may be asked to attach, kg. Default 0: never.
    warmer : float
        By how much a person may be asked to warm the robot, K. Default 0: never.
    reach : float
        Size of the region for poses after the first diagnosis, as a multiple of the workspace.
        Default 1.
    hold_out : float
        Share of the poses that is held out in each fit. Default 0.25.
    joint_sigma : float, optional
        Standard deviation of joint readings, rad or m. Default: as the model file states.
    seed : int
        Seed of the candidate poses. Default 0.
    update : bool
        Only decide whether the robot has drifted since the calibration of its model, with as few
        poses as that takes, and update the model if it has. Default False.
    certainty : float
        Of this decision: the probability at which the campaign ends. Default 0.95.

    Raises
    ------
    FitError
        If the certainty is not above 0.5 and below 1.

    Examples
    --------
    >>> import parallel_cal as pc
    >>> pc.Goal(poses=40, enough=20e-6).poses
    40
    """

    poses: int = 80
    minutes: float = 60.0
    enough: float = 0.0
    effects: tuple[str, ...] = ()
    keep_out: tuple[Box, ...] = ()
    payload: float = 0.0
    warmer: float = 0.0
    reach: float = 1.0
    hold_out: float = 0.25
    joint_sigma: float | None = None
    seed: int = 0
    update: bool = False
    certainty: float = CERTAINTY

    def __post_init__(self) -> None:
        check_certainty(self.certainty)
