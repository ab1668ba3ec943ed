"""Sessions of virtual robots that hide a law, as Datasets, and the truth that they hide."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import arms
import findings
import numpy as np
import virtual_arm
import virtual_day as vd
import virtual_laws as laws
import virtual_sessions as days

from parallel_cal.identification.fit import fit
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.model import Model, new_model
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.virtual import robot as vr
from parallel_cal.virtual.joint_effects import Visit

FIRST_SIZE = 1.0  # times the noise of a joint: the sizes of laws are scaled from here


class SerialRobot:
    """A virtual arm with the methods of the other virtual robots."""

    def __init__(self, parameters: dict[str, virtual_arm.Arm]) -> None:
        self.parameters = parameters

    def forward(self, q: vr.Array, start: Any = None) -> tuple[vr.Array, vr.Array]:
        q = np.asarray(q)
        T = self.parameters["arm"].matrix(q.reshape(-1, q.shape[-1]))
        T = T.reshape(*q.shape[:-1], 4, 4)
        return T[..., :3, 3], T[..., :3, :3]


@dataclass(frozen=True)
class Robot:
    """A virtual robot, the model to begin with, its noise, and how its days are made."""

    built: Any
    model: Callable[[], Model]
    noise: vr.Noise
    readings: Callable[[int, int], vr.Array]  # (number of poses, seed)
    home: vr.Array
    kinds: tuple[Callable[[laws.Kin, np.random.Generator], laws.Hidden], ...]
    kin: laws.Kin

    def day(self, seed: int, poses: int = 120, again: int = 30) -> vd.Session:
        """Ten seconds a pose in a hall that warms and cools, with and without a load."""
        visits = poses + again
        masses = np.where(np.arange(visits) * 6 // visits % 2, 1.2, 0.2)
        return vd.visit(
            self.readings(poses, seed),
            self.home,
            again,
            seed,
            dwell=10.0,
            air=days.wandering,
            payload=masses,
        )


def _kin(readings: vr.Array, joints: tuple[str, ...], **more: Any) -> laws.Kin:
    low, high = readings.min(axis=0), readings.max(axis=0)
    return laws.Kin(joints, (low + high) / 2, high - low, **more)


def _delta_readings(n: int, seed: int) -> vr.Array:
    return vr.NOMINAL.inverse(vd.targets(n, seed))[0]


def _hexapod_readings(n: int, seed: int) -> vr.Array:
    rng = np.random.default_rng(seed)
    move = rng.uniform(-1, 1, (n, 6)) * ([0.04, 0.04, 0.03] + [np.radians(10)] * 3)
    r, R = np.asarray(days.DESIGNED.home) + move[:, :3], vr.turn(move[:, 3:])
    return days.DESIGNED.leg_lengths(r, R) - days.DESIGNED.offset


UR5 = virtual_arm.arm("ur5")


def _arm_readings(n: int, seed: int) -> vr.Array:
    rng = np.random.default_rng([seed, 77])
    return np.array(UR5.home) + rng.uniform(-0.9, 0.9, (n, 6))


THREE = ("joint1", "joint2", "joint3")
SIX = tuple(f"joint{i}" for i in range(1, 7))
LEGS = tuple(f"leg{i}" for i in range(1, 7))
CHAINS = ("chain1", "chain2", "chain3")
ROBOTS = {
    "delta": Robot(
        vr.MOCK_UP,
        lambda: new_model("delta54"),
        vr.THESIS_NOISE,
        _delta_readings,
        vr.NOMINAL.inverse(vr.NOMINAL.home)[0],
        laws.CHAIN_KINDS,
        _kin(
            _delta_readings(200, 0),
            THREE,
            load=0.5,
            loaded=(0, 1, 2),
            chains=CHAINS,
            warm="La_x",
            rod="Lb",
            level=(0.56, 0.9),
            equal=tuple((f"{c}.La_y",) for c in CHAINS),
        ),
    ),
    "hexapod": Robot(
        days.HEXAPOD,
        lambda: new_model("stewart42"),
        vr.Noise(joint=5e-6),
        _hexapod_readings,
        days.DESIGNED.home_joints,
        laws.CHAIN_KINDS,
        _kin(
            _hexapod_readings(200, 0),
            LEGS,
            load=4.0,
            loaded=tuple(range(6)),
            chains=LEGS,
            warm="L0",
            rod="L0",
            level=(0.37, 0.59),
            reach=0.04,
            height=0.3,
            equal=tuple((f"{leg}.L0",) for leg in LEGS),
        ),
    ),
    "arm": Robot(
        SerialRobot({"arm": UR5}),
        lambda: arms.nominal("ur5"),
        vr.Noise(joint=2e-5, position=2e-5, orientation=5e-5),
        _arm_readings,
        np.array(UR5.home),
        laws.JOINT_KINDS,
        _kin(_arm_readings(200, 0), SIX, load=4.0, loaded=(1, 2, 3, 4)),
    ),
}


def _conditions(
    robot: Robot, day: vd.Session, needs: frozenset[str] = frozenset()
) -> tuple[Visit, dict[str, vr.Array]]:
    """What happened at each sample, and what of it was recorded: what a law `needs`, too.

    The speed of each joint is drawn, in its direction. The second half of the samples is another
    session.
    """
    at = day.at(day.arrive + day.dwell / 2)
    n, joints = len(at.time), robot.kin.joints
    travel = np.column_stack([findings.travel(way) for way in day.ways.T])
    drawn = np.random.default_rng([n, len(joints)]).uniform(0, 1, (n, len(joints)))
    session = np.arange(n) * 2 // n
    at = Visit(
        **vars(at), travel=travel, velocity=at.direction * drawn * robot.kin.span, session=session
    )
    known = {
        f"{kind}.{joint}": getattr(at, kind)[:, i]
        for kind in ("direction", "travel", *sorted(needs & {"velocity"}))
        for i, joint in enumerate(joints)
    }
    common = {"time", "temperature", "payload", *(needs & {"session"})}
    return at, known | {name: np.asarray(getattr(at, name), float) for name in sorted(common)}


def measured(
    robot: Robot,
    day: vd.Session,
    effects: list[vr.Effect],
    noise: vr.Noise,
    seed: int,
    needs: frozenset[str] = frozenset(),
) -> Dataset:
    """What is measured on such a day, as a Dataset with every condition recorded."""
    at, known = _conditions(robot, day, needs)
    _, r, R = vr.truth(robot.built, effects, day.reading, at)
    q_error, r_error, w_error = noise.draw(
        np.random.default_rng([seed, 9]), len(r), len(robot.kin.joints)
    )
    q = day.reading + q_error
    cov = np.diag([robot.noise.position**2] * 3 + [robot.noise.orientation**2] * 3)
    return Dataset.from_arrays(
        robot.kin.joints,
        q,
        r + r_error,
        vr.turn(w_error) @ R,
        pose_cov=cov,
        joint_sigma=robot.noise.joint,
        conditions=known,
        pose_id=day.pose_index,
        source="virtual robot",
    )


def sized(robot: Robot, make: Callable[[float], vr.Effect], day: vd.Session, sigmas: float) -> Any:
    """The effect whose rms residual, which the geometry leaves, is so many sigmas."""
    n = robot.noise
    still = vr.Noise(n.joint * 1e-6, n.position * 1e-6, n.orientation * 1e-6)
    size = FIRST_SIZE * n.joint
    for _ in range(2):
        data = measured(robot, day, [make(size)], still, 0)
        found = fit(robot.model(), data, hold_out=0, insist=True)
        size *= sigmas / float(np.sqrt(found.estimate.chi2_per_dof))
    return make(size)


def hiding(
    name: str, kind: Callable[..., laws.Hidden], seed: int, sigmas: float = 1.5, **visits: int
) -> tuple[Dataset, laws.Hidden, vr.Effect]:
    """A session of a robot that hides a law of a kind, drawn by a seed."""
    robot = ROBOTS[name]
    hidden = kind(robot.kin, np.random.default_rng([seed, 3]))
    day = robot.day(seed, **visits)
    effect = sized(robot, hidden.make, day, sigmas)
    return measured(robot, day, [effect], robot.noise, seed, hidden.needs), hidden, effect


def compute_true_error(name: str, model: Model, effect: vr.Effect, seed: int, end: float) -> float:
    """Rms position error (m) of a model at poses that nobody measured, within the time of the
    session, which took until `end` (s)."""
    robot = ROBOTS[name]
    day = robot.day(seed + 10_000, 60, 0)
    at, known = _conditions(robot, day, frozenset({"velocity", "session"}))
    known["time"] = known["time"] * end / known["time"].max()
    at = replace(at, time=known["time"])
    _, r, _ = vr.truth(robot.built, [effect], day.reading, at)
    found = Kinematics(model.robot()).direct(day.reading, known)
    return float(np.sqrt(np.mean(np.sum((found.position - r) ** 2, axis=1))))


def is_named(laws_found: Any, hidden: laws.Hidden) -> tuple[bool, bool]:
    """Whether the place and the drivers of a hidden law are among the answers."""
    place = drivers = False
    for law in laws_found:
        for answer in (law.name, *law.alternatives):
            where, _, on = answer.partition(" by ")
            if set(on.split(" and ")) == hidden.drivers:
                drivers = True
                place = place or where in hidden.places
    return place, drivers
