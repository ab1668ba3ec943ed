"""A pose device: its frame, its target, its clock and its missing poses."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from parallel_cal.virtual.robot import Array, apply, turn

# Another target in the field of view, relative to the correct one: m, rotation vector
OTHER_SHIFT, OTHER_TURN = np.array([0.03, -0.02, 0.01]), np.array([0.0, 0.1, 0.2])


@dataclass(frozen=True)
class Tracker:
    """A tracker that takes a pose every `period` s from `begin`; a share `missing` is lost.

    Its frame is at `shift` (m) in the base, rotated by `spin` (rotation vector). The target is at
    `target` on the platform, rotated by `target_spin`. Its clock is ahead of the robot's by
    `offset` s at time 0 and gains `drift` s per second.
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
        """Return the times (n,) of poses after one time and up to another."""
        first, last = (np.floor((t - self.begin) / self.period) for t in (after, until))
        return self.begin + self.period * np.arange(max(first + 1, 0), last + 1)

    def stamps(self, taken: Array) -> Array:
        """Return the tracker's time stamps of these times."""
        return taken * (1 + self.drift) + self.offset

    def observe(self, r: Array, R: Array, swapped: bool = False) -> tuple[Array, Array]:
        """Convert poses of the platform in the base to those of the target in the device."""
        if swapped:
            r, R = r + apply(R, OTHER_SHIFT), R @ turn(OTHER_TURN)
        away = r + apply(R, self.target) - self.shift
        F = turn(self.spin)
        return away @ F, F.T @ R @ turn(self.target_spin)
