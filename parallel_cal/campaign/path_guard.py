"""Check with the model whether a path is allowed: the whole path, not only its end."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import casadi as ca
import numpy as np

from parallel_cal.base.compiled import Batch, dense
from parallel_cal.base.errors import ParallelCalError
from parallel_cal.kinematics.kinematics import Kinematics, Solutions, Status
from parallel_cal.kinematics.singularity import distances
from parallel_cal.model.mechanism import Box
from parallel_cal.model.model import Model
from parallel_cal.planning.approach import controlled_coordinates
from parallel_cal.planning.posepool import CLEARANCE

CHECK_STEP = 1 / 100  # of a joint's range between two points that are looked at
MAX_WORKSPACE_OVERSHOOT = (
    0.02  # of the workspace's size: a way between poses on its face may bulge so far
)
POINTS_PER_LINE = 9  # points on each line of the robot's picture that are held against the boxes
# A way after a joint has turned that is shorter than its play need not move what it drives: as much
# play as any drive may have, or so many times what the model knows of it.
DEFAULT_BACKLASH = {"rad": 3e-3, "m": 0.2e-3}
BACKLASH_SAFETY_FACTOR = 1.25
LINE_FRACTIONS = np.linspace(0.0, 1.0, POINTS_PER_LINE)[:, None]


class PathError(ParallelCalError):
    """A path is not allowed."""


@dataclass(frozen=True)
class Guard:
    """The limits of every path: joint limits, the workspace (enlarged by `reach`), singularities
    and the poses beyond them, keep-out boxes."""

    model: Model
    keep_out: tuple[Box, ...] = ()
    reach: float = 1.0

    @classmethod
    def of(cls, model: Model, more: Iterable[Box] = (), reach: float = 1.0) -> Guard:
        """Make a guard with the model file's keep-out boxes and `more`."""
        return cls(model.robot(), (*model.mechanism.keep_out, *more), reach)

    def plan_path(self, start: np.ndarray, stops: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Return the joints (nq,) at which to stop between `start` and the last of `stops`, through
        home if the straight path is forbidden. Raise PathError if no path is known."""
        if astray := self.describe_violation(start):
            raise PathError(
                f"the robot's present pose is {astray}; move the robot back into its workspace"
            )
        start = self._clip_to_limits(start)
        found, home = [start], np.array(self.model.mechanism.home.joints)
        for a, b in pairwise([start, *stops]):
            if (why := self.find_violation(self.points(a, b))) is None:
                found.append(b)
                continue
            if any(self.find_violation(self.points(*leg)) for leg in ((a, home), (home, b))):
                share, words = why
                raise PathError(f"the path is {words} at {share:.0%} of its length")
            found += [home, b]
        return found

    def lengthen_approach(self, start: np.ndarray, stops: Sequence[np.ndarray]) -> list[np.ndarray]:
        """The same stops with one more before the last where a joint would end there after a way
        that its play swallows: it comes from further away, on the same side."""
        *before, last = [start, *stops]
        step, least = last - before[-1], self.min_approach
        short = (step != 0) & (np.abs(step) < least)
        if not short.any():
            return list(stops)
        away = np.where(short, last - np.sign(step) * least, before[-1])
        return [*before[1:], away, last]

    @cached_property
    def min_approach(self) -> np.ndarray:
        """The shortest way (nq,) after a turn that moves what a joint drives: rad or m."""
        m, known = self.model.mechanism, self.model.table.mapping(self.model.values)
        found = []
        for joint, unit in zip(m.joints, m.joint_units, strict=True):
            play = max(
                known.get(f"backlash.{joint}.width", 0.0),
                2 * known.get(f"hysteresis.{joint}.lag", 0.0),
            )
            found.append(BACKLASH_SAFETY_FACTOR * play or DEFAULT_BACKLASH[unit])
        return np.array(found)

    def points(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Joints (n, nq) along the straight way from one to the other."""
        n = 2 + int(np.max(np.abs(b - a) / (CHECK_STEP * self.model.mechanism.joint_ranges)))
        return a + np.linspace(0.0, 1.0, n)[:, None] * (b - a)

    def find_violation(self, q: np.ndarray) -> tuple[float, str] | None:
        """The first of some joints (n, nq) where the robot must not be, as a share of their way,
        and why; None where it may be at all of them."""
        bad = [
            (int(np.argmax(mask)), words) for mask, words in self._find_violations(q) if mask.any()
        ]
        if not bad:
            return None
        i, words = min(bad, key=lambda found: found[0])
        return i / max(len(q) - 1, 1), words

    def describe_violation(self, q: np.ndarray) -> str:
        """Why the robot must not be at joints (nq,) where it is; empty where it may. One that was
        sent to a limit may be read, or rest, a little beyond it."""
        why = self.find_violation(self._clip_to_limits(q)[None])
        return why[1] if why else ""

    def _clip_to_limits(self, q: np.ndarray) -> np.ndarray:
        """Joints (nq,) that are beyond their limits by less than what is looked at, at these."""
        m = self.model.mechanism
        at = np.clip(q, *np.array(m.joint_limits).T)
        return np.where(np.abs(q - at) < CHECK_STEP * np.asarray(m.joint_ranges), at, q)

    def is_allowed(self, q: np.ndarray) -> np.ndarray:
        """At which of some joints (n, nq) the robot may be, (n,)."""
        return ~np.any([mask for mask, _ in self._find_violations(q)], axis=0)

    def summarise_violations(self, q: np.ndarray) -> str:
        """How many of some joints (n, nq) are forbidden for which reason."""
        counts = ((int(mask.sum()), words) for mask, words in self._find_violations(q))
        return ", ".join(f"{count} are {words}" for count, words in counts if count)

    def _find_violations(self, q: np.ndarray) -> list[tuple[np.ndarray, str]]:
        """Of some joints (n, nq) those where the robot must not be, (n,) for every reason."""
        at = self._robot.direct(q)
        return [
            *((at.status == status, _describe_status(status)) for status in Status if status),
            (self._is_outside_workspace(at), "outside the workspace"),
            (~self._is_clear(at), "too near a singularity or beyond it"),
            *(
                (self._is_in_box(at, box), f"inside the keep-out box {box}")
                for box in self.keep_out
            ),
        ]

    # ------------------------------------------------------------------ what is asked of a pose

    @cached_property
    def _robot(self) -> Kinematics:
        return Kinematics(self.model, quick=True)

    @cached_property
    def _home(self) -> tuple[np.ndarray, ...]:
        """What every pose is held against: clearances and signs at home."""
        home = self._robot.direct(np.array([self.model.mechanism.home.joints]))
        d = distances(self.model, home)
        return d.direct, d.inverse, d.direct_sign, d.inverse_sign

    def _is_clear(self, at: Solutions) -> np.ndarray:
        here, (direct, inverse, one, other) = distances(self.model, at), self._home
        far = (here.direct > CLEARANCE * direct) & (here.inverse > CLEARANCE * inverse)
        same = (here.direct_sign == one) & (here.inverse_sign == other)
        return np.asarray(far & same)

    def _is_outside_workspace(self, at: Solutions) -> np.ndarray:
        box = self.model.mechanism.workspace
        low, high = np.array(box.low), np.array(box.high)
        slack = ((self.reach - 1) / 2 + MAX_WORKSPACE_OVERSHOOT) * (high - low)
        here = controlled_coordinates(self.model, at)
        return np.asarray(((here < low - slack) | (here > high + slack)).any(axis=1))

    def _is_in_box(self, at: Solutions, box: Box) -> np.ndarray:
        """Where the platform's origin, or a line of the robot's picture, is inside a box."""
        points = self._lines(at)
        low, high = np.array(box.low), np.array(box.high)
        inside: np.ndarray = np.all((points >= low) & (points <= high), axis=2)
        return np.asarray(inside.any(axis=1))

    def _lines(self, at: Solutions) -> np.ndarray:
        """Points (n, k, 3) m of the robot: its platform's origin, and along what it draws."""
        if self._line_end_function is None:
            return at.position[:, None]
        flat = self._line_end_function(at.configuration.rows)[0]
        ends = flat.reshape(len(at), -1, 2, 1, 3)
        along = ends[:, :, 0] + LINE_FRACTIONS * (ends[:, :, 1] - ends[:, :, 0])
        return np.concatenate([at.position[:, None], along.reshape(len(at), -1, 3)], axis=1)

    @cached_property
    def _line_end_function(self) -> Batch | None:
        """Both ends of every moving line of the mechanism's picture, as one row."""
        s = self.model.structure
        lines = self.model.mechanism.drawing(s.q, s.r, s.R, s.geometry)
        moving = [line for line in lines if line.kind not in ("base", "axis")]
        ends = [end for line in moving for pair in pairwise(line.points) for end in pair]
        if not ends:
            return None
        points = ca.substitute(ca.SX(ca.vertcat(*ends)), s.v, ca.DM(self.model.values))
        return Batch(dense("picture", [s.configuration], [points]))


def _describe_status(status: Status) -> str:
    words = {Status.OUTSIDE_LIMITS: "outside the joint limits", Status.SINGULAR: "singular"}
    return words.get(status, "out of reach")
