"""Serial arms by Denavit and Hartenberg's own matrices, seen by a tracker that stands anywhere.

Like `parallel_cal.virtual`, this file shares nothing with the rest of the package.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from parallel_cal.virtual.robot import Array, turn

QUARTER = np.pi / 2
# a, d (m), alpha (rad) of every joint: A = Rot(z, theta) Trans(z, d) Trans(x, a) Rot(x, alpha).
UR5 = (
    (0.0, 0.089159, QUARTER),
    (-0.425, 0.0, 0.0),
    (-0.39225, 0.0, 0.0),
    (0.0, 0.10915, QUARTER),
    (0.0, 0.09465, -QUARTER),
    (0.0, 0.0823, 0.0),
)
WAM = (
    (0.0, 0.0, -QUARTER),
    (0.0, 0.0, QUARTER),
    (0.045, 0.55, -QUARTER),
    (-0.045, 0.0, QUARTER),
    (0.0, 0.3, -QUARTER),
    (0.0, 0.0, QUARTER),
    (0.0, 0.06, 0.0),
)
HOME = {
    "ur5": (0.3, -1.2, 1.4, -0.8, -1.3, 0.4),
    "wam": (0.1, 0.5, 0.1, 1.2, 0.1, 0.5, 0.1),
}


@dataclass(frozen=True)
class Play:
    """What drives of this kind add to the angle (rad) that the encoder of one joint reads."""

    joint: int
    eccentric: float = 0.0
    ripple: float = 0.0
    teeth: float = 50.0
    backlash: float = 0.0

    def added(self, reading: Array, direction: Array) -> Array:
        once = self.eccentric * np.sin(reading + 0.7)
        often = self.ripple * np.sin(self.teeth * reading + 0.3)
        return np.asarray(once + often - self.backlash / 2 * direction)


@dataclass(frozen=True)
class Links:
    """What the links of an arm weigh, and how its joints yield to that.

    Compliance (rad/(N m)) of every joint; mass (kg) of the link behind it, and its centre (m) in
    the frame at the end of its row. A mass more is a tool, in the last frame.
    """

    compliance: tuple[float, ...]
    mass: tuple[float, ...]
    centre: tuple[tuple[float, float, float], ...]
    gravity: tuple[float, float, float] = (0.0, 0.0, -9.81)

    def turns(self, frames: list[Array]) -> Array:
        """Angles (N, nq) by which the joints yield: compliance times z . sum of (c - o) x m g."""
        found = np.zeros((len(frames[0]), len(self.compliance)))
        for i, (mass, centre) in enumerate(zip(self.mass, self.centre, strict=True)):
            here = frames[min(i + 1, len(self.compliance))]  # a tool is at the last
            at = here[:, :3, :3] @ np.array(centre) + here[:, :3, 3]
            for j in range(min(i + 1, len(self.compliance))):
                turning = np.cross(at - frames[j][:, :3, 3], mass * np.array(self.gravity))
                found[:, j] += np.sum(frames[j][:, :3, 2] * turning, axis=1)
        return np.asarray(np.array(self.compliance) * found)


# Masses and centres of the manufacturer's data sheet; 20, 6 and 11 kg per metre.
UR5_LINKS = Links(
    (1e-5, 2e-5, 3e-5, 5e-5, 5e-5, 5e-5),
    (3.7, 8.393, 2.275, 1.219, 1.219, 0.1879),
    (
        (0.0, -0.02561, 0.00193),
        (0.2125, 0.0, 0.11336),
        (0.15, 0.0, 0.0265),
        (0.0, -0.0018, 0.01634),
        (0.0, 0.0018, 0.01634),
        (0.0, 0.0, -0.001159),
    ),
)


@dataclass(frozen=True)
class Arm:
    """An arm of turning joints: its rows off nominal, and what its joints hide."""

    rows: tuple[tuple[float, float, float], ...]
    home: tuple[float, ...]
    wrong: Array  # (n, 4): of theta (rad), d, a (m), alpha (rad)
    hidden: tuple[Play, ...] = field(default=())
    links: Links | None = None  # None: weightless

    def matrix(self, q: Array) -> Array:
        """{P} in {B} (N, 4, 4) at the joints' true angles."""
        return self.frames(q)[-1]

    def frames(self, q: Array) -> list[Array]:
        """{B} and the frame at the end of every row, in {B}, (N, 4, 4) each."""
        T = [np.broadcast_to(np.eye(4), (len(q), 4, 4))]
        for k, (a, d, alpha) in enumerate(self.rows):
            theta, along, across, twist = self.wrong[k]
            T.append(T[-1] @ _dh(q[:, k] + theta, d + along, a + across, alpha + twist))
        return T

    def reached(self, reading: Array, direction: Array) -> Array:
        """{P} in {B} (N, 4, 4) where the encoders read this, each joint come from its side."""
        q = reading.copy()
        for play in self.hidden:
            q[:, play.joint] += play.added(reading[:, play.joint], direction[:, play.joint])
        if self.links is None:
            return self.matrix(q)
        straight = q
        for _ in range(4):  # fixed point: the load depends on how far the joints yield
            q = straight + self.links.turns(self.frames(q))
        return self.matrix(q)


def _dh(theta: Array, d: float, a: float, alpha: float) -> Array:
    c, s, ca, sa = np.cos(theta), np.sin(theta), np.cos(alpha), np.sin(alpha)
    zero, one = np.zeros_like(c), np.ones_like(c)
    rows = [
        [c, -s * ca, s * sa, a * c],
        [s, c * ca, -c * sa, a * s],
        [zero, zero + sa, zero + ca, zero + d],
        [zero, zero, zero, one],
    ]
    return np.asarray(np.moveaxis(np.array(rows), -1, 0))


def arm(
    kind: str,
    seed: int = 0,
    length: float = 0.4e-3,
    angle: float = 2e-3,
    hidden: tuple = (),
    links: Links | None = None,
) -> Arm:
    """A `ur5` or a `wam` whose rows are off by these (1 sigma, m and rad)."""
    rows = {"ur5": UR5, "wam": WAM}[kind]
    wrong = np.random.default_rng([seed, len(rows)]).standard_normal((len(rows), 4))
    return Arm(rows, HOME[kind], wrong * [angle, length, length, angle], tuple(hidden), links)


@dataclass(frozen=True)
class Tracker:
    """Where a laser tracker stands in {B}, where its target sits in {P}, and its noise."""

    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)
    turned: tuple[float, float, float] = (0.0, 0.0, 0.0)
    target: tuple[float, float, float] = (0.0, 0.0, 0.0)
    target_turned: tuple[float, float, float] = (0.0, 0.0, 0.0)
    position: float = 20e-6
    orientation: float = 50e-6
    joint: float = 10e-6

    def exact(self) -> Tracker:
        """The same without noise."""
        return replace(self, position=1e-12, orientation=1e-12, joint=1e-12)


FAR_AWAY = Tracker((2.1, -1.3, 0.4), (0.2, -0.4, 2.0), (0.02, -0.03, 0.07), (0.3, 0.2, -1.0))


@dataclass(frozen=True)
class Session:
    """Readings (N, nq), what the tracker shows (N, 3) and (N, 3, 3), directions (N, nq) and what
    it would show without noise."""

    q: Array
    r: Array
    R: Array
    direction: Array
    true_r: Array
    true_R: Array
    tracker: Tracker


def session(
    robot: Arm, n: int, seed: int = 0, tracker: Tracker = FAR_AWAY, width: float = 0.9
) -> Session:
    """n poses drawn within `width` (rad) around home, every joint come from either side."""
    rng = np.random.default_rng([seed, 77])
    home = np.array(robot.home)
    q = home + rng.uniform(-width, width, (n, len(home)))
    direction = np.sign(np.diff(q, axis=0, prepend=home[None]))
    T = robot.reached(q, direction)
    F, f = turn(np.array(tracker.turned)), np.array(tracker.shift)
    r = (T[:, :3, 3] + T[:, :3, :3] @ np.array(tracker.target) - f) @ F
    R = F.T @ T[:, :3, :3] @ turn(np.array(tracker.target_turned))
    noisy = turn(tracker.orientation * rng.standard_normal((n, 3))) @ R
    return Session(
        q + tracker.joint * rng.standard_normal(q.shape),
        r + tracker.position * rng.standard_normal((n, 3)),
        noisy,
        direction,
        r,
        R,
        tracker,
    )
