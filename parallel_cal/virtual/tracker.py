"""A pose device beside the robot: where it stands, what it looks at, its clock and its gaps."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from parallel_cal.virtual.robot import Array, apply, turn

# Another target in the field of view, as seen from the one that is meant: m, rotation vector.
OTHER_SHIFT, OTHER_TURN = np.array([0.03, -0.02, 0.01]), np.array([0.0, 0.1, 0.2])


@dataclass(frozen=True)
class Tracker:
    """Takes a pose every `period` s, the first at `begin`; a share `missing` of them is lost.

    It stands at `shift` (m), turned by `spin` (rotation vector) against the base; the target sits
    at `target` on the platform, turned by `target_spin`. Its clock shows `offset` s more than the
    robot's at the beginning and gains `drift` s a second.
    """

    period: float = 0.05
    begin: float = 0.004
    missing: float = 0.01
    offset: float = 0.0
    drift: float = 0.0
    shift: Array = field(default_factory=lambda: np.zeros(3))
    spin: Array = field(default_factory=lambda: np.zeros(3))
    target: Array = field(default_factory=lambda: np.zeros(3))
    target_spin: Array = field(default_factory=lambda: np.zeros(3))

    def sampling_times(self, after: float, until: float) -> Array:
        """When (n,) poses are taken, after a time and up to another."""
        first, last = (np.floor((t - self.begin) / self.period) for t in (after, until))
        return self.begin + self.period * np.arange(max(first + 1, 0), last + 1)

    def stamps(self, taken: Array) -> Array:
        """What its clock shows then."""
        return taken * (1 + self.drift) + self.offset

    def observe(self, r: Array, R: Array, swapped: bool = False) -> tuple[Array, Array]:
        """The target's poses in the device's frame, for poses of the platform in the base."""
        if swapped:
            r, R = r + apply(R, OTHER_SHIFT), R @ turn(OTHER_TURN)
        away = r + apply(R, self.target) - self.shift
        F = turn(self.spin)
        return away @ F, F.T @ R @ turn(self.target_spin)
