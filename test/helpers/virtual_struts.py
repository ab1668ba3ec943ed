"""A hexapod whose struts are rigid halves on universal joints, with a screw between the halves.

Nothing of it comes from the package: the angles of the four axes of every strut are found so that
its halves meet. The screw turns by the angle between the halves.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from parallel_cal.virtual.robot import (
    Array,
    Effect,
    Parameters,
    SampleConditions,
    apply,
    solve,
    turn,
)
from parallel_cal.virtual.stewart import Pose, Stewart

ROUNDS = 8  # of the forward problem; each one leaves less than a tenth of the error


class JointedHexapod(Stewart):
    """`base` and `platform` (6, 3) are the axes that the joints have in common with base and
    platform, by default across the strut at home and horizontal; `foot` and `head` (m) the
    distances from them to the second axes, `lead` that of the screws (m, right-hand)."""

    def __init__(
        self,
        parameters: Parameters,
        lead: float = 0.0,
        foot: ArrayLike = 0.0,
        head: ArrayLike = 0.0,
        base: ArrayLike | None = None,
        platform: ArrayLike | None = None,
        drawn: Parameters | None = None,
    ) -> None:
        plain, drawing = Stewart(parameters), Stewart(drawn or parameters)
        along = drawing.platform + np.asarray(self.home) - drawing.base
        flat = unit(np.cross([0.0, 0.0, 1.0], along))
        self.fixed = unit(np.array([flat if axes is None else axes for axes in (base, platform)]))
        self.lead = lead
        self.off = np.stack([np.broadcast_to(foot, 6), np.broadcast_to(head, 6)])[..., None]
        self.off = self.off * np.array([1.0, -1.0])[:, None, None]
        self.straight = unit(plain.platform + np.asarray(self.home) - plain.base)
        self.second = unit(np.cross(self.fixed, self.straight))
        self.between = np.cross(self.second, self.fixed)
        super().__init__(parameters)

    def halves(self, r: Array, R: Array, angles: Array) -> tuple[Array, Array]:
        """Inner ends (..., 6, 3) and orientations (..., 6, 3, 3) of the halves: first axis of the
        array (base, platform); `angles` (..., 6, 4) about the fixed and the second axes."""
        points, frames = [], []
        for end, (ball, body) in enumerate(
            (
                (self.base, np.eye(3)),
                (r[..., None, :] + apply(R[..., None, :, :], self.platform), R[..., None, :, :]),
            )
        ):
            first = turn(angles[..., 2 * end, None] * self.fixed[end])
            second = turn(angles[..., 2 * end + 1, None] * self.second[end])
            points.append(ball + apply(body @ first, self.off[end] * self.between[end]))
            frames.append(body @ first @ second)
        return np.array(points), np.array(np.broadcast_arrays(*frames))

    def leg_lengths(self, r: Array, R: Array) -> Array:
        """Lengths that the motors count (..., 6): of the struts, and what their twist adds."""

        def gaps(u: Array) -> Array:
            (foot, head), (low, high) = self.halves(r, R, u[..., :4])
            along = apply(low, self.straight)
            apart = head - foot - u[..., 4:] * along
            bent = np.cross(along, apply(high, self.straight))
            side = apply(low, self.second[0])
            rest = np.stack([dot(bent, side), dot(bent, np.cross(along, side))], -1)
            return np.concatenate([apart, rest], -1)

        start = np.zeros((*np.shape(r)[:-1], 6, 5))
        start[..., 4] = super().leg_lengths(r, R)
        u = solve(gaps, start)
        _, (low, high) = self.halves(r, R, u[..., :4])
        mark = apply(np.swapaxes(low, -1, -2) @ high, self.second[0])
        twist = np.arctan2(
            dot(mark, np.cross(self.straight, self.second[0])), dot(mark, self.second[0])
        )
        return u[..., 4] + self.lead * twist / (2 * np.pi)

    def forward(self, q: ArrayLike, start: tuple[ArrayLike, ArrayLike] | None = None) -> Pose:
        """Find the pose (r, R) of readings `q`: that of a plain hexapod with other readings."""
        plain = Stewart(self.parameters)
        r, R = plain.forward(q, start)
        for _ in range(ROUNDS):
            added = self.leg_lengths(r, R) - plain.leg_lengths(r, R)
            r, R = plain.forward(np.asarray(q) - added, (r, R))
        return r, R


@dataclass(frozen=True)
class UniversalJoints(Effect):
    """Struts that hang on universal joints: `lead` of their screws, offsets `foot` and `head`."""

    lead: float = 0.0
    foot: tuple[float, ...] = (0.0,) * 6
    head: tuple[float, ...] = (0.0,) * 6

    def loaded_robot(self, robot: Any, angle: Array, at: SampleConditions) -> Any:
        return JointedHexapod(robot.parameters, self.lead, self.foot, self.head)


def unit(v: Any) -> Array:
    return np.asarray(v / np.linalg.norm(v, axis=-1, keepdims=True))


def dot(a: Array, b: Array) -> Array:
    return np.asarray(np.sum(a * b, axis=-1))
