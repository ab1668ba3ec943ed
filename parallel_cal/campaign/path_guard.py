"""Check with the model whether a path is allowed along its whole length."""

from __future__ import annotations

import copy
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import casadi as ca
import numpy as np

from parallel_cal.base.compiled import Batch, dense
from parallel_cal.base.errors import ParallelCalError
from parallel_cal.kinematics.kinematics import Kinematics, Solutions, Status
from parallel_cal.model.mechanism import Box, Mechanism
from parallel_cal.model.model import Model
from parallel_cal.planning.posepool import find_clear_poses
from parallel_cal.planning.visibility import find_seen_poses, list_planned_sensors

CHECK_STEP = 1 / 100  # spacing of the checked points, as a fraction of a joint's range
# As a fraction of the workspace's size: a path that is straight in the joints bulges by so much
# beyond a face of the workspace when both its ends lie on that face.
MAX_WORKSPACE_OVERSHOOT = 0.02
POINTS_PER_LINE = 9  # points on each line of the robot's drawing that are checked against the boxes
# After a reversal, a joint drives its load only once it has moved by more than its backlash: the
# modelled backlash times a safety factor, or else a value that few drives exceed.
DEFAULT_BACKLASH = {"rad": 3e-3, "m": 0.2e-3}
BACKLASH_SAFETY_FACTOR = 1.25
LINE_FRACTIONS = np.linspace(0.0, 1.0, POINTS_PER_LINE)[:, None]
STATUS_WORDS = {Status.OUTSIDE_LIMITS: "outside the joint limits", Status.SINGULAR: "singular"}


def describe_exceeded_limits(mechanism: Mechanism, q: np.ndarray) -> str:
    """Name the joints (nq,) that are outside their limits, with their values."""
    m = mechanism
    return "; ".join(
        f"{joint} at {value:.4f} {unit}, allowed from {low:.4f} to {high:.4f}"
        for joint, unit, value, (low, high) in zip(
            m.joints, m.joint_units, q.tolist(), m.joint_limits, strict=True
        )
        if not low <= value <= high
    )


class PathError(ParallelCalError):
    """A path is not allowed."""


@dataclass(frozen=True)
class Guard:
    """The limits of every path: joint limits, workspace (enlarged by `reach`), singularities and
    the poses beyond them, keep-out boxes. `measuring` is the model with its sensors: at the poses
    to measure, a camera whose place is known must see its board."""

    model: Model
    keep_out: tuple[Box, ...] = ()
    reach: float = 1.0
    measuring: Model | None = None

    @classmethod
    def of(cls, model: Model, more: Iterable[Box] = (), reach: float = 1.0) -> Guard:
        """Make a guard with the model file's keep-out boxes and `more`."""
        return cls(model.robot(), (*model.mechanism.keep_out, *more), reach, model)

    def plan_path(self, start: np.ndarray, stops: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Return the joints (nq,) of a path from `start` through all `stops`.

        Joints that stand beyond their limits, as at a limit switch, move straight to them first.
        Where the straight path to a stop is forbidden, the path leads through home. Raises
        PathError if that is forbidden, too."""
        if astray := self.describe_violation(start):
            raise PathError(
                f"the robot's present pose is {astray}; move the robot back into its workspace"
            )
        start, inside = self._settle_at_limits(start), self._clip_to_limits(start)
        found, home = [inside], np.array(self.model.mechanism.home.joints)
        if (start != inside).any():
            found.insert(0, start)
        for a, b in pairwise([inside, *stops]):
            if (why := self.find_violation(self.points(a, b))) is None:
                found.append(b)
                continue
            if any(self.find_violation(self.points(*leg)) for leg in ((a, home), (home, b))):
                share, words = why
                raise PathError(f"the path is {words} at {share:.0%} of its length")
            found += [home, b]
        return found

    def lengthen_approach(self, start: np.ndarray, stops: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Return the stops with a waypoint before the last, if a joint's last move is so short
        that its backlash may absorb it. From the waypoint that joint approaches by
        `min_approach`, from the same side as before."""
        *before, last = [start, *stops]
        step, least = last - before[-1], self.min_approach
        short = (step != 0) & (np.abs(step) < least)
        if not short.any():
            return list(stops)
        waypoint = np.where(short, last - np.sign(step) * least, before[-1])
        return [*before[1:], waypoint, last]

    @cached_property
    def min_approach(self) -> np.ndarray:
        """The shortest move (nq,) after a reversal that surely moves a joint's load: rad or m."""
        m, known = self.model.mechanism, self.model.table.mapping(self.model.values)
        found = []
        for joint, unit in zip(m.joints, m.joint_units, strict=True):
            backlash = max(
                known.get(f"backlash.{joint}.width", 0.0),
                2 * known.get(f"hysteresis.{joint}.lag", 0.0),
            )
            found.append(BACKLASH_SAFETY_FACTOR * backlash or DEFAULT_BACKLASH[unit])
        return np.array(found)

    def points(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Return joints (n, nq) on the straight path from a to b, both included."""
        n = 2 + int(np.max(np.abs(b - a) / (CHECK_STEP * self.model.mechanism.joint_ranges)))
        return a + np.linspace(0.0, 1.0, n)[:, None] * (b - a)

    def find_violation(self, q: np.ndarray) -> tuple[float, str] | None:
        """Find the first forbidden point of a path (n, nq): its share of the path, and why it is
        forbidden; None if the whole path is allowed."""
        bad = [
            (int(np.argmax(mask)), words) for mask, words in self._find_violations(q) if mask.any()
        ]
        if not bad:
            return None
        i, words = min(bad, key=lambda found: found[0])
        exceeded = describe_exceeded_limits(self.model.mechanism, q[i])
        words += f" ({exceeded})" if exceeded else ""
        return i / max(len(q) - 1, 1), words

    def describe_violation(self, q: np.ndarray) -> str:
        """Say why the robot may not start at its present joints (nq,); empty if it may.

        A joint may stand beyond its limit, if the straight path back to it is allowed: the limits
        say where the robot may be sent."""
        start, inside = self._settle_at_limits(q), self._clip_to_limits(q)
        guard = self if (start == inside).all() else self._extend_limits_to(start)
        why = guard.find_violation(guard.points(start, inside))
        return why[1] if why else ""

    def _clip_to_limits(self, q: np.ndarray) -> np.ndarray:
        """Move joints (nq,) that are beyond a limit to that limit."""
        return np.clip(q, *np.array(self.model.mechanism.joint_limits).T)

    def _settle_at_limits(self, q: np.ndarray) -> np.ndarray:
        """Move joints (nq,) that are read less than CHECK_STEP beyond a limit to that limit."""
        at, ranges = self._clip_to_limits(q), np.asarray(self.model.mechanism.joint_ranges)
        return np.where(np.abs(q - at) < CHECK_STEP * ranges, at, q)

    def _extend_limits_to(self, q: np.ndarray) -> Guard:
        """Return a guard whose joint limits include joints (nq,)."""
        mechanism = copy.copy(self.model.mechanism)
        mechanism.joint_limits = tuple(
            (min(low, at), max(high, at))
            for (low, high), at in zip(mechanism.joint_limits, q.tolist(), strict=True)
        )
        return replace(self, model=replace(self.model, mechanism=mechanism))

    def is_allowed(self, q: np.ndarray) -> np.ndarray:
        """Return a mask (n,) of the joints (n, nq) at which the robot may be."""
        return ~np.any([mask for mask, _ in self._find_violations(q)], axis=0)

    def is_measurable(self, q: np.ndarray) -> np.ndarray:
        """Return a mask (n,) of the joints (n, nq) at which the robot may be and is measured."""
        allowed = self.is_allowed(q)
        if self.measuring is None or not list_planned_sensors(self.measuring):
            return allowed
        return np.asarray(allowed & find_seen_poses(self.measuring, self._robot.direct(q)))

    def summarise_violations(self, q: np.ndarray) -> str:
        """Say how many of the joints (n, nq) are forbidden for each reason."""
        counts = ((int(mask.sum()), words) for mask, words in self._find_violations(q))
        return ", ".join(f"{count} are {words}" for count, words in counts if count)

    def _find_violations(self, q: np.ndarray) -> list[tuple[np.ndarray, str]]:
        """Return for each reason the mask (n,) of the joints (n, nq) that it forbids."""
        at = self._robot.direct(q)
        workspace = self.model.mechanism.workspace
        low, high = np.array(workspace.low), np.array(workspace.high)
        slack = ((self.reach - 1) / 2 + MAX_WORKSPACE_OVERSHOOT) * (high - low)
        here = self.model.mechanism.controlled_coordinates(at.position, at.rotation)
        outside = np.any((here < low - slack) | (here > high + slack), axis=1)
        found: list[tuple[np.ndarray, str]] = [
            (at.status == status, STATUS_WORDS.get(status, "out of reach"))
            for status in Status
            if status
        ]
        found += [
            (outside, "outside the workspace"),
            (~find_clear_poses(self.model, at), "too near a singularity or beyond it"),
        ]
        if self.keep_out:
            points = self._sample_drawing(at)
            for box in self.keep_out:
                inside = (points >= np.array(box.low)) & (points <= np.array(box.high))
                found.append((np.any(inside.all(axis=2), axis=1), f"inside the keep-out box {box}"))
        return found

    # ------------------------------------------------------------------ the robot and its drawing

    @cached_property
    def _robot(self) -> Kinematics:
        return Kinematics(self.model, quick=True)

    def _sample_drawing(self, at: Solutions) -> np.ndarray:
        """Return points (n, k, 3) m of the robot: the platform's origin and points on its lines."""
        if self._line_end_function is None:
            return at.position[:, None]
        flat = self._line_end_function(at.configuration.rows)[0]
        ends = flat.reshape(len(at), -1, 2, 1, 3)
        along = ends[:, :, 0] + LINE_FRACTIONS * (ends[:, :, 1] - ends[:, :, 0])
        return np.concatenate([at.position[:, None], along.reshape(len(at), -1, 3)], axis=1)

    @cached_property
    def _line_end_function(self) -> Batch | None:
        """Both ends of every moving line of the mechanism's drawing, as one row; None without."""
        s = self.model.structure
        lines = s.drawing()
        moving = [line for line in lines if line.kind not in ("base", "axis")]
        ends = [end for line in moving for pair in pairwise(line.points) for end in pair]
        if not ends:
            return None
        points = ca.substitute(ca.SX(ca.vertcat(*ends)), s.v, ca.DM(self.model.values))
        return Batch(dense("picture", [s.configuration], [points]))
