"""The blind study of the effects of lines, struts and drives, on the machines that have them.

Robots, physics and noise come from the independent virtual robots; every draw has its own poses.
A hidden effect is so large that the geometry (with the effect that it generalizes) leaves one sigma
of it. A case is a diagnosis and, if it names something, `add`. It is judged by the true position
error at 150 other poses, beside that of the best possible model: the fit of the true effect, with
its true constants. With `--results` every outcome becomes a line of a file, and a case that stands
there already is not run again: a long study can be made in slices (`--minutes`). `--page` only
writes the table of docs/validation.md from docs/blind_effects.jsonl.
Usage: `python -m bench.truth.new_effects [--draws N] [--results FILE] [--minutes M]
[--page] [ROW ...]`; a ROW is a part of the name of a row, such as `creep on four`.
"""

from __future__ import annotations

import argparse
import json
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import virtual_arm as va
import virtual_day as vd
import virtual_effects_more as more
import virtual_findings as vf
import virtual_setups as vs
from arms import nominal
from twins import hexapod
from virtual_lines import Creep, LinedRobot, Pulleys, Tension
from virtual_struts import UniversalJoints

from bench.truth.blind import how_named, interval, put_between, rms, select_others
from bench.truth.slices import add_options, run_missing
from parallel_cal.base.errors import FitError
from parallel_cal.diagnosis.diagnose import diagnose
from parallel_cal.identification.fit import fit
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.model import Model, new_model
from parallel_cal.model.shelf import load_mechanism, load_sensor
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.session.steps import add
from parallel_cal.virtual import joint_effects as ve
from parallel_cal.virtual import robot as vr
from parallel_cal.virtual.linear_delta import LinearDelta

ROOT = Path(__file__).resolve().parents[2]
PAGE, STUDY = ROOT / "docs" / "validation.md", ROOT / "docs" / "blind_effects.jsonl"
START = "<!-- study of effects: written by bench/truth/new_effects.py --page -->"
END = "<!-- end of the study of effects -->"
SIZE = 1.0  # sigmas of the residual that the geometry leaves of an effect
ROUND = 5  # draws of every row before the next draws of any
DRIFT = "noise that drifts"  # what an effect of time may be no better than
HOWS = {"alone": "alone", "or": "in A or B", "not": "not"}  # how an effect is named
OTHER = 10_000  # added to a seed for the poses at which a model is judged
PLATE = 0.3  # m, under the gauge
LEGS = vr.Noise(joint=2e-6, position=5e-6, orientation=10 * vr.ARCSEC)


@dataclass(frozen=True)
class Robot:
    """A virtual robot, the model a person starts from, and poses that it goes to; a gauge over a
    plate where the model has a sensor for it."""

    model: Callable[[], Model]
    twin: Any
    noise: vr.Noise
    readings: Callable[[int], Any]

    def measured(self, effects: Any, seed: int, loud: float = 1.0) -> Dataset:
        """120 poses and 30 of them again, ten seconds each; `loud` 0 is without errors."""
        reading, pose = self.readings(seed)
        n, joints = reading.shape
        at = self.visits(reading, seed)
        gauges = [e for e in effects if isinstance(e, vs.Gauge)]
        _, r, R = vr.truth(self.twin, [e for e in effects if e not in gauges], reading, at)
        q_error, r_error, w_error = vd.errors(self.noise, n, joints, seed)
        names = self.model().joints
        sigma = np.repeat([self.noise.position, self.noise.orientation], 3)
        kinds = ("direction", *(("velocity", "acceleration") if hasattr(at, "velocity") else ()))
        conditions = {
            f"{kind}.{j}": getattr(at, kind)[:, i] for kind in kinds for i, j in enumerate(names)
        }
        conditions |= {"time": at.time, "temperature": at.temperature, "payload": at.payload}
        conditions |= self.further_conditions(at)
        if self.model().sensors:
            shown = (gauges or [vs.Gauge(PLATE)])[0].reads(r, R)
            errors = np.random.default_rng([seed, 4]).normal(0, 2e-6, n)
            conditions["reading.probe"] = shown + loud * errors
        return Dataset.from_arrays(
            names,
            reading + loud * q_error,
            r + loud * r_error,
            vr.turn(loud * w_error) @ R,
            pose_cov=np.diag(sigma**2),
            joint_sigma=self.noise.joint,
            conditions=conditions,
            pose_id=pose,
        )

    def visits(self, reading: Any, seed: int) -> Any:
        """What happened before each sample; half of the time with a load, in turns."""
        n = len(reading)
        came = np.sign(np.diff(reading, axis=0, prepend=reading[-1:]))
        warm = 20 + 4 * np.sin(np.arange(n) / 17 + seed)
        load = np.where(np.arange(n) * 6 // n % 2, 1.2, 0.2)
        return vr.SampleConditions(10.0 * np.arange(n), warm, load, came)

    def further_conditions(self, at: Any) -> dict[str, Any]:
        """Further conditions that this robot records, by name."""
        return {}


@dataclass(frozen=True)
class WarmedRobot(Robot):
    """A thermometer on each of some parts: (name, cycles of its temperature in a session)."""

    parts: tuple[tuple[str, float], ...] = ()

    def further_conditions(self, at: Any) -> dict[str, Any]:
        return {f"temperature.{part}": part_temperature(at, f) for part, f in self.parts}


def part_temperature(at: Any, cycles: float) -> Any:
    """Temperature (degC) of a part that warms and cools `cycles` times in the session."""
    return 20 + 8 * np.sin(2 * np.pi * cycles * at.time / np.max(at.time))


@dataclass(frozen=True)
class WarmParts(vr.Effect):
    """Parts of a `WarmedRobot` that grow by a rate (1/K) each: {"Lb": (rate, cycles)}."""

    growth: dict[str, tuple[float, float]]

    def geometry(self, parameters: Any, at: vr.SampleConditions) -> Any:
        warm = {name: (a, part_temperature(at, f)) for name, (a, f) in self.growth.items()}
        return more.PartsWarmth(warm).geometry(parameters, at)


@dataclass(frozen=True)
class LiftingRobot(Robot):
    """Under five loads in turns, up to `heaviest` kg."""

    heaviest: float = 2.0

    def visits(self, reading: Any, seed: int) -> Any:
        load = self.heaviest * np.array([0.0, 0.5, 0.1, 1.0, 0.25])[np.arange(len(reading)) % 5]
        return replace(super().visits(reading, seed), payload=load)


@dataclass(frozen=True)
class MovingRobot(Robot):
    """Measured while it moves."""

    reach: float = 0.6  # rad/s or m/s, at most

    def visits(self, reading: Any, seed: int) -> Any:
        n, joints = reading.shape
        drawn = vd.visits(n, joints, seed, self.reach)
        still = vars(super().visits(reading, seed)) | {"direction": drawn.direction}
        at = replace(drawn, **still)
        return more.Motion.of(at, 10 * self.reach, seed)


class LinkArm:
    """A serial arm that the virtual effects of joints and loads can be hidden in."""

    def __init__(self, parameters: Any) -> None:
        self.parameters = parameters  # the arm itself: no effect of lengths is hidden in it

    def forward(self, angle: Any, start: Any = None) -> tuple[Any, Any]:
        flat = self.parameters.matrix(np.reshape(angle, (-1, np.shape(angle)[-1])))
        T = flat.reshape(*np.shape(angle)[:-1], 4, 4)
        return T[..., :3, 3], T[..., :3, :3]


@dataclass(frozen=True)
class HeavyLinks(vr.Effect):
    """The links of a `LinkArm`, whose weight twists its joints."""

    links: va.Links

    def arm(self, reading: Any, robot: Any, at: vr.SampleConditions) -> Any:
        angle = reading
        for _ in range(4):  # fixed point: the load depends on how far the joints yield
            angle = reading + self.links.turns(robot.parameters.frames(angle))
        return angle


@dataclass(frozen=True)
class CableRobot(Robot):
    """Lines in m that hold a point; the anchors strayed by 5 mm, and `readings` draws places."""

    def measured(self, effects: Any, seed: int, loud: float = 1.0) -> Dataset:
        """120 places and 30 of them again, two minutes each; `loud` 0 is without errors."""
        r, pose = self.readings(seed)
        time = 120.0 * np.arange(len(r))
        physics = {name: made for effect in effects for name, made in effect.items()}
        q = LinedRobot(self.twin, np.ones(len(self.twin)), **physics).readings(r, time)
        q_error, r_error, _ = vd.errors(self.noise, *q.shape, seed)
        return Dataset.from_arrays(
            self.model().joints,
            q + loud * q_error,
            r + loud * r_error,
            pose_cov=np.diag([self.noise.position**2] * 3 + [np.nan] * 3),
            joint_sigma=self.noise.joint,
            conditions={"time": time},
            pose_id=pose,
        )


def strayed(drawn: Any) -> Any:
    return np.array(drawn) + np.random.default_rng(3).normal(0, 5e-3, np.shape(drawn))


def cable_robot(drawn: Any, low: Any, high: Any) -> CableRobot:
    def places(seed: int) -> Any:
        return visited(np.random.default_rng([seed, 9]).uniform(low, high, (120, 3)), seed)

    noise = vr.Noise(joint=50e-6, position=50e-6, orientation=0.0)
    anchors = np.array(drawn).tolist()
    return CableRobot(
        lambda: new_model(load_mechanism("cable", anchors=anchors)), strayed(drawn), noise, places
    )


def visited(reading: Any, seed: int, again: int = 30) -> Any:
    """Each reading once, some twice, in no order; and which pose it is."""
    rng = np.random.default_rng([seed, 5])
    n = len(reading)
    pose = rng.permutation(np.concatenate([np.arange(n), rng.choice(n, again, replace=False)]))
    return reading[pose], pose


def delta_poses(seed: int) -> Any:
    return visited(vr.NOMINAL.inverse(vd.targets(120, seed))[0], seed)


def leg_poses(seed: int) -> Any:
    rng = np.random.default_rng([seed, 9])
    r = HEXAPOD.home + rng.uniform(-0.05, 0.05, (120, 3))
    return visited(HEXAPOD.inverse(r, vr.turn(rng.uniform(-0.2, 0.2, (120, 3))))[0], seed)


def plate_poses(seed: int) -> Any:
    rng = np.random.default_rng([seed, 9])
    r = rng.uniform((-0.06, -0.06, PLATE), (0.06, 0.06, PLATE + 0.012), (120, 3))
    return visited(HEXAPOD.inverse(r, vr.turn(rng.uniform(-0.2, 0.2, (120, 3))))[0], seed)


def gauged() -> Model:
    sensor = load_sensor("probe", height=PLATE, mounted=True)
    return new_model("stewart42", sensors=[sensor])


def carriage_poses(seed: int) -> Any:
    rng = np.random.default_rng([seed, 9])
    r = rng.uniform((-0.06, -0.06, 0.02), (0.06, 0.06, 0.18), (120, 3))
    return visited(RAILS.inverse(r, np.eye(3))[0], seed)


def rails() -> LinearDelta:
    model = new_model("linear_delta")
    off = 0.3 * model.table.tolerance * np.random.default_rng(3).standard_normal(len(model.values))
    return LinearDelta(model.table.mapping(model.values + np.where(model.fixed, 0, off)))


def arm_poses(seed: int) -> Any:
    rng = np.random.default_rng([seed, 9])
    return visited(np.array(va.HOME["ur5"]) + rng.uniform(-0.9, 0.9, (120, 6)), seed)


HEXAPOD, RAILS = hexapod(), rails()
ARM = LinkArm(va.arm("ur5", 1))
ARM_NOISE = vr.Noise(1e-5, 20e-6, 50e-6)
LEG_PARTS = (("base", 1.0), ("platform", 1.7), ("legs", 2.6))
RAIL_PARTS = (("base", 1.0), ("rods", 2.6))
FOUR_LINES = [[0, -1.6, -0.1], [1.3, 1.2, -0.1], [-1.4, 0.7, -0.1], [0.3, 0.2, 2.3]]
EIGHT_LINES = [[x, y, z] for x in (-1.5, 1.6) for y in (-1.3, 1.2) for z in (-0.3, 2.1)]
DELTA = Robot(lambda: new_model("delta54"), vr.MOCK_UP, vr.THESIS_NOISE, delta_poses)
ROBOTS = {
    "delta": DELTA,
    "fine delta": replace(DELTA, noise=vf.FINEST),
    "stewart": Robot(lambda: new_model("stewart42"), HEXAPOD, LEGS, leg_poses),
    "gauged stewart": Robot(gauged, HEXAPOD, LEGS, plate_poses),
    "lifting delta": LiftingRobot(lambda: new_model("delta54"), vr.MOCK_UP, vf.FINE, delta_poses),
    "lifting stewart": LiftingRobot(
        lambda: new_model("stewart42"), HEXAPOD, LEGS, leg_poses, heaviest=40.0
    ),
    "arm": Robot(lambda: nominal("ur5"), ARM, ARM_NOISE, arm_poses),
    "lifting arm": LiftingRobot(lambda: nominal("ur5"), ARM, ARM_NOISE, arm_poses, heaviest=5.0),
    "moving delta": MovingRobot(
        lambda: new_model("delta54"), vr.MOCK_UP, vr.THESIS_NOISE, delta_poses
    ),
    "moving stewart": MovingRobot(
        lambda: new_model("stewart42"), HEXAPOD, LEGS, leg_poses, reach=0.08
    ),
    "moving arm": MovingRobot(lambda: nominal("ur5"), ARM, ARM_NOISE, arm_poses),
    "warmed stewart": WarmedRobot(
        lambda: new_model("stewart42"), HEXAPOD, LEGS, leg_poses, parts=LEG_PARTS
    ),
    "linear delta": Robot(lambda: new_model("linear_delta"), RAILS, LEGS, carriage_poses),
    "warmed linear delta": WarmedRobot(
        lambda: new_model("linear_delta"), RAILS, LEGS, carriage_poses, parts=RAIL_PARTS
    ),
    "four lines": cable_robot(FOUR_LINES, (-0.35, -0.35, 0.1), (0.35, 0.35, 0.6)),
    "eight lines": cable_robot(EIGHT_LINES, (-0.5, -0.5, 0.2), (0.5, 0.5, 1.2)),
}


WORDS = {  # what the page calls the robots
    "delta": "Delta",
    "fine delta": "Delta, finer instruments",
    "stewart": "hexapod",
    "gauged stewart": "hexapod with a gauge over a plate",
    "lifting delta": "Delta under five loads",
    "lifting stewart": "hexapod under five loads",
    "arm": "arm of six joints",
    "lifting arm": "arm of six joints under five loads",
    "moving delta": "Delta in motion",
    "moving stewart": "hexapod in motion",
    "moving arm": "arm of six joints in motion",
    "warmed stewart": "hexapod with a thermometer on each part",
    "linear delta": "linear Delta",
    "warmed linear delta": "linear Delta with a thermometer on each part",
    "four lines": "cable robot, four lines",
    "eight lines": "cable robot, eight lines",
}


@dataclass(frozen=True)
class Kind:
    """Hidden physics: the robots to try it on, its names, and how a size and a draw make one. Its
    size is that of what the geometry and the effect `special`, a special case of it, leave.
    `constants` are those of the true effect, which a program that knows it would be given."""

    names: tuple[str, ...]
    robots: tuple[str, ...]
    make: Callable[[float, np.random.Generator, int], Any]
    size: float
    special: str = ""
    constants: Callable[[Any], dict[str, float]] = lambda effect: {}


def some(size: float, rng: np.random.Generator, n: int = 3) -> tuple[float, ...]:
    """n numbers, none of them small."""
    return tuple(size * rng.uniform(0.6, 1.4, n) * rng.choice([-1, 1], n))


def phases(rng: np.random.Generator, n: int) -> tuple[float, ...]:
    return tuple(rng.uniform(-np.pi, np.pi, n))


def wobble(size: float, rng: np.random.Generator, n: int) -> Any:
    lead = rng.uniform(2e-3, 8e-3)
    return ve.UnevenScrew(lead, some(size, rng, n), phases(rng, n), (0.0,) * n)


def growing(size: float, rng: np.random.Generator, n: int) -> Any:
    return ve.UnevenScrew(5e-3, (0.0,) * n, (0.0,) * n, some(100 * size, rng, n))


def lobes(size: float, rng: np.random.Generator, n: int) -> Any:
    return more.LobedRing(int(rng.integers(3, 9)), some(size, rng, n), phases(rng, n))


def dragged(size: float, rng: np.random.Generator, n: int) -> Any:
    beside = np.roll(np.eye(n), 1, axis=0) + np.roll(np.eye(n), -1, axis=0)
    return ve.DraggedNeighbours(tuple(np.reshape(some(size, rng, n * n), (n, n)) * beside))


def knock(size: float, rng: np.random.Generator, n: int) -> Any:
    return more.Knock(rng.uniform(300, 1200), some(size, rng), some(3 * size, rng))  # type: ignore[arg-type]


def bent(size: float, rng: np.random.Generator, n: int) -> Any:
    form = np.reshape(some(size, rng, 27), (3, 3, 3))
    home = (0.0, 0.0, 0.2 if n == 3 else 0.3)
    return more.BentSpace(tuple(form + form.transpose(0, 2, 1)), home)


def refraction(size: float, rng: np.random.Generator, n: int) -> Any:
    """Seen from the base, so that it is mostly linear where the robot moves."""
    form = np.zeros((3, 3, 3))
    form[:2, 2, 2] = some(size, rng, 2)
    return more.BentSpace(tuple(form), (0.0, 0.0, 0.0))


def leaning(size: float, rng: np.random.Generator, n: int) -> Any:
    return more.LeaningBase(some(size, rng, 2))  # type: ignore[arg-type]


def twisted(size: float, rng: np.random.Generator, n: int) -> Any:
    return UniversalJoints(lead=some(size, rng, 1)[0])


def apart(size: float, rng: np.random.Generator, n: int) -> Any:
    return UniversalJoints(foot=some(size, rng, n), head=some(size, rng, n))


def pulleys(size: float, rng: np.random.Generator, n: int) -> Any:
    anchors = np.array(EIGHT_LINES if n == 8 else FOUR_LINES)
    axes = np.zeros(anchors.shape)
    axes[:, 2] = np.sign(anchors[:, 2])
    if n == 4:  # the steep line comes from the side
        axes[3] = (1.0, 0.0, 0.0)
    return {"pulleys": Pulleys(size, axes)}


def taut(size: float, rng: np.random.Generator, n: int) -> Any:
    return {"tension": Tension(EA=1.0, platform=0.2 * size, pretension=size)}


def hanging(size: float, rng: np.random.Generator, n: int) -> Any:
    return {"tension": Tension(weight_per_metre=np.sqrt(size), pretension=1.0)}


def creeping(size: float, rng: np.random.Generator, n: int) -> Any:
    fast, slow = abs(np.array(some(size, rng, 2)))
    return {"creep": Creep((fast, slow), (rng.uniform(300, 900), rng.uniform(3000, 12000)))}


def rubbing(size: float, rng: np.random.Generator, n: int) -> Any:
    return more.RubbingGears(0.2, tuple(5 * np.abs(some(size, rng, n))))


def stiffening(size: float, rng: np.random.Generator, n: int) -> Any:
    """Gears that twist half as far again under small loads as under those that are usual here."""
    k1 = 1 / np.abs(some(size, rng, n))
    torque = 1.0 if n == 3 else 20.0
    return more.StiffeningGears(tuple(k1), tuple(k1**3 / torque**2))


def sagging(size: float, rng: np.random.Generator, n: int) -> Any:
    """The manufacturer's links of a UR5, half of the time with a tool; unequal per metre."""
    own, tool = va.UR5_LINKS, rng.choice([0.0, 2.0])
    return HeavyLinks(
        replace(
            own,
            compliance=tuple(np.abs(some(size, rng, n))),
            mass=(*own.mass, tool),
            centre=(*own.centre, (0.0, 0.0, 0.08)),
        )
    )


def beating(size: float, rng: np.random.Generator, n: int) -> Any:
    ratio = float(rng.choice([30, 50, 80, 100]))
    return more.BeatingGears(ratio, some(size, rng, n), phases(rng, n), phases(rng, n))


def notched(size: float, rng: np.random.Generator, n: int) -> Any:
    return more.UnevenPitch(rng.uniform(2e-3, 30e-3), some(size, rng, n), phases(rng, n))


def trailing(size: float, rng: np.random.Generator, n: int) -> Any:
    return more.LateDrives(tuple(1 / np.abs(some(size, rng, n))))


def warm_legs(size: float, rng: np.random.Generator, n: int) -> Any:
    rates = np.abs(some(size, rng, 3))
    parts = zip(("C", "B", "L0"), rates, LEG_PARTS, strict=True)
    return WarmParts({name: (rate, cycles) for name, rate, (_, cycles) in parts})


def warm_rods(size: float, rng: np.random.Generator, n: int) -> Any:
    base, rods = np.abs(some(size, rng, 2))
    (_, slow), (_, fast) = RAIL_PARTS
    growth = {"D": (base, slow), "b": (base, slow), "Lb": (rods, fast), "dLb": (rods, fast)}
    return WarmParts(growth)


def bending(size: float, rng: np.random.Generator, n: int) -> Any:
    return more.BentByInertia(tuple(np.abs(some(size, rng, n)) ** -0.5))


def bed(size: float, rng: np.random.Generator, n: int) -> Any:
    xx, xy, yy = some(size, rng)
    return vs.Gauge(PLATE, shape=((2, 0, xx), (1, 1, xy), (0, 2, yy), (3, 0, 5 * xx)))


def beside(size: float, rng: np.random.Generator, n: int) -> Any:
    x, y = some(size, rng, 2)
    return vs.Gauge(PLATE, tip=(x, y, 0.0))


def slanted(size: float, rng: np.random.Generator, n: int) -> Any:
    x, y = some(size, rng, 2)
    return vs.Gauge(PLATE, slant=(x, y))


KINDS = {
    "screw, periodic": Kind(
        ("screw_pitch_error",),
        ("stewart", "linear delta"),
        wobble,
        10e-6,
        constants=lambda screw: {"lead": screw.lead},
    ),
    "screw, growing": Kind(("screw_pitch_error",), ("stewart", "linear delta"), growing, 10e-6),
    "lobed ring": Kind(
        ("encoder_harmonic",),
        ("delta",),
        lobes,
        0.3e-3,
        constants=lambda ring: {"order": ring.lobes},
    ),
    "cross-talk": Kind(("encoder_crosstalk",), ("delta", "stewart"), dragged, 1e-3),
    "knock": Kind(("device_bump",), ("delta", "stewart"), knock, 20e-6),
    "bent space": Kind(("device_field",), ("fine delta", "stewart"), bent, 1e-3),
    "refraction": Kind(
        ("device_field", "device_axes"), ("fine delta", "stewart"), refraction, 2e-3
    ),
    "leaning base": Kind(("base_compliance",), ("fine delta", "stewart"), leaning, 0.2e-3),
    "twisted struts": Kind(("strut_rotation",), ("stewart",), twisted, 1e-3),
    "offset joints": Kind(("universal_joint_offset",), ("stewart",), apart, 1e-3),
    "pulleys": Kind(("pulley_radius",), ("four lines", "eight lines"), pulleys, 5e-3),
    "taut lines": Kind(("line_flex",), ("four lines", "eight lines"), taut, 0.3e-3),
    "sagging lines": Kind(("line_sag",), ("four lines", "eight lines"), hanging, 1e-4),
    "creep": Kind(
        ("line_creep",),
        ("four lines", "eight lines"),
        creeping,
        0.1e-3,
        constants=lambda found: {
            "ratio": found["creep"].times[1] / found["creep"].times[0],
            "tau": found["creep"].times[1],
        },
    ),
    "rubbing gears": Kind(("load_friction",), ("lifting delta", "lifting arm"), rubbing, 1e-5),
    "rubbing screws": Kind(("load_friction",), ("lifting stewart",), rubbing, 1e-8),
    "stiffening gears": Kind(
        ("strain_wave_compliance",),
        ("lifting delta", "lifting arm"),
        stiffening,
        1e-4,
        "joint_compliance",
        constants=lambda gears: {"torque": float(np.sqrt(gears.k1[0] ** 3 / gears.k3[0]))},
    ),
    "heavy links": Kind(("own_weight_sag",), ("arm",), sagging, 1e-6),
    "beating gears": Kind(
        ("strain_wave_ripple",),
        ("delta", "lifting arm"),
        beating,
        0.3e-3,
        constants=lambda gears: {"ratio": gears.ratio},
    ),
    "uneven pitch": Kind(
        ("encoder_interpolation",),
        ("stewart", "linear delta"),
        notched,
        10e-6,
        constants=lambda scale: {"period": scale.pitch},
    ),
    "bending by inertia": Kind(
        ("acceleration_lag",), ("moving delta", "moving stewart", "moving arm"), bending, 0.1e-3
    ),
    "late drives": Kind(
        ("servo_lag",), ("moving stewart", "moving delta", "moving arm"), trailing, 1e-3
    ),
    "warm legs": Kind(("thermal_expansion_by_part",), ("warmed stewart",), warm_legs, 2e-6),
    "warm rods": Kind(("thermal_expansion_by_part",), ("warmed linear delta",), warm_rods, 2e-6),
    "bed": Kind(("bed_shape",), ("gauged stewart",), bed, 1e-3),
    "probe beside": Kind(("probe_offset",), ("gauged stewart",), beside, 0.1e-3),
    "probe slanted": Kind(("probe_tilt",), ("gauged stewart",), slanted, 5e-3),
}


def sized(robot: Robot, kind: Kind, seed: int) -> Any:
    """The effect so large that the geometry leaves SIZE sigmas of it."""
    size, joints = kind.size, len(robot.model().joints)

    def effect() -> Any:
        return kind.make(size, np.random.default_rng(seed), joints)

    model = robot.model()
    if kind.special:
        model = model.with_effect(kind.special)
    for _ in range(2):
        still = fit(model, robot.measured([effect()], seed, loud=0.0), hold_out=0, insist=True)
        size *= SIZE / float(np.sqrt(still.estimate.chi2_per_dof))
    return effect()


@dataclass(frozen=True)
class Case:
    """One session: the robot, what hides in it (a key of KINDS, empty for nothing), the seed."""

    robot: str
    hidden: str
    seed: int

    @property
    def row(self) -> str:
        return f"{self.hidden or 'nothing'} on {self.robot}"


@dataclass(frozen=True)
class Outcome:
    """What the program said, and true rms position errors (m) of the fitted geometry, of the model
    that `add` made, and of the best possible one. `best` is None for an error of the device."""

    case: Case
    verdict: str
    named: tuple[str, ...]  # "a" or "a or b"
    before: float
    after: float
    best: float | None
    refused: str = ""
    seconds: float = 0.0  # of the processor

    @property
    def how(self) -> str:
        """Whether what hides was named `alone`, in an `or`, or `not`."""
        return how_named(self.named, KINDS[self.case.hidden].names)

    @property
    def added(self) -> bool:
        """Whether `add` made another model."""
        return self.after != self.before

    @property
    def right(self) -> bool:
        return not self.named if not self.case.hidden else self.how != "not"


def is_of_robot(effect: Any) -> bool:
    """Whether the robot errs, not the device: a dict is physics of a cable robot."""
    if isinstance(effect, vs.Gauge):
        return False
    return isinstance(effect, dict) or type(effect).device is vr.Effect.device


def true_error(model: Model, robot: Robot, effects: list[Any], seed: int) -> float:
    """Rms position error (m) at other poses of the same robot."""
    other = robot.measured(list(filter(is_of_robot, effects)), seed + OTHER, loud=0.0)
    found = Kinematics(model.robot()).direct(other.q, other.conditions)
    return float(np.sqrt(np.mean(np.sum((found.position - other.r) ** 2, axis=1))))


def run(case: Case) -> Outcome:
    """Diagnose a session as a user does, add what was found, and judge the result by the truth."""
    begin = time.process_time()
    robot, effects = ROBOTS[case.robot], []
    if case.hidden:
        effects = [sized(robot, KINDS[case.hidden], case.seed)]
    data, model = robot.measured(effects, case.seed), robot.model()
    found = diagnose(model, data)
    named = tuple(" or ".join([name, *found.swaps.get(name, ())]) for name in found.effects)
    named += tuple(f"{name} or {DRIFT}" for name in found.verdict.like_drift)
    plain = fit(model, data, insist=True).model
    served, refused = plain, ""
    if found.additions:
        try:
            served = add(plain, "+".join(found.additions), data).model
        except FitError as error:
            refused = str(error)
    before, after = (true_error(m, robot, effects, case.seed) for m in (plain, served))
    seconds = round(time.process_time() - begin, 2)
    best = best_error(case, model, data, effects)
    return Outcome(case, found.verdict.word, named, before, after, best, refused, seconds)


def best_error(case: Case, model: Model, data: Dataset, effects: list[Any]) -> float | None:
    """True error of the model with what truly hides, fitted to the same samples."""
    if case.hidden:
        kind = KINDS[case.hidden]
        if not is_of_robot(effects[0]):
            return None
        model = model.with_effect(kind.names[0], kind.constants(effects[0]))
    best = fit(model, data, insist=True).model
    return true_error(best, ROBOTS[case.robot], effects, case.seed)


def rows() -> Iterator[tuple[str, str]]:
    """Yield (robot, what hides) of every row, first those of nothing."""
    yield from ((at, "") for at in ROBOTS)
    yield from ((at, name) for name, kind in KINDS.items() for at in kind.robots)


def list_cases(draws: int, wanted: list[str]) -> list[Case]:
    """Cases in the order in which to run them; twice as many draws with nothing hidden."""
    cases = []
    for first in range(0, draws, ROUND):
        for at, name in rows():
            times = 1 if name else 2
            seeds = range(times * first, times * min(first + ROUND, draws))
            cases += [Case(at, name, seed) for seed in seeds]
    return [c for c in cases if not wanted or any(w in c.row for w in wanted)]


def kept(file: Path) -> dict[Case, Outcome]:
    """The outcomes that a file of earlier slices holds."""
    if not file.exists():
        return {}
    lines = [json.loads(line) for line in file.read_text(encoding="utf-8").splitlines()]
    found = [Outcome(**(a | {"case": Case(**a["case"]), "named": (*a["named"],)})) for a in lines]
    return {outcome.case: outcome for outcome in found}


def grouped(outcomes: list[Outcome]) -> dict[tuple[str, str], list[Outcome]]:
    """Outcomes by row, in the order of the rows."""
    groups: dict[tuple[str, str], list[Outcome]] = {row: [] for row in rows()}
    for outcome in outcomes:
        groups[outcome.case.robot, outcome.case.hidden].append(outcome)
    return {row: some for row, some in groups.items() if some}


def ratio_to_best(some: list[Outcome]) -> float:
    """Rms true error after `add`, where it made a model, over that of the best possible models."""
    judged = [o for o in some if o.added and o.best is not None]
    errors = np.array([(o.after, o.best) for o in judged]).reshape(-1, 2)
    if not len(errors):
        return np.nan
    after, best = np.sqrt(np.mean(errors**2, axis=0))
    return float(after / best)


def describe(some: list[Outcome]) -> str:
    """Return a row in words, with what was named besides what hides."""
    case, hows = some[0].case, count_hows(some)
    errors = [1e6 * rms([getattr(o, side) for o in some]) for side in ("before", "after")]
    named = ", ".join(f"{words} {hows[how]}" for how, words in HOWS.items())
    return (
        f"{case.row}, {len(some)}: {named}; {dict(Counter(o.verdict for o in some))}; otherwise "
        f"{dict(list_others(some))}; true error {errors[0]:.1f} -> {errors[1]:.1f} um, "
        f"{ratio_to_best(some):.2f} of the best; {np.mean([o.seconds for o in some]):.1f} s"
    )


def count_hows(some: list[Outcome]) -> Counter[str]:
    """Return how often what hides was named; nothing that hides counts as not named."""
    return Counter(o.how if o.case.hidden else "not" for o in some)


def list_others(some: list[Outcome]) -> Counter[str]:
    """Return what was named besides what hides, in how many sessions."""
    hidden = some[0].case.hidden
    names = KINDS[hidden].names if hidden else ()
    return Counter(n for o in some for n in select_others(o.named, names))


def table_lines(outcomes: list[Outcome]) -> list[str]:
    """Return the lines of the page's table: a row for each robot and what hides in it."""
    lines = [
        "| hidden | robot | sessions | named alone | in an `A or B` | not named | interval | other "
        "names | added | true error | over the best |",
        "| --- | --- | --: | --: | --: | --: | --: | --: | --: | --: | --: |",
    ]
    for (robot, hidden), some in grouped(outcomes).items():
        hows, right = count_hows(some), sum(o.right for o in some)
        what = f"{hidden} (`{'` or `'.join(KINDS[hidden].names)}`)" if hidden else "nothing"
        before, after = (
            1e6 * rms([getattr(o, side) for o in some]) for side in ("before", "after")
        )
        cells = [what, WORDS[robot], str(len(some))]
        cells += [str(hows[how]) if hidden else "-" for how in ("alone", "or")] + [str(hows["not"])]
        cells += [interval(right, len(some)), str(sum(list_others(some).values()))]
        cells.append(str(sum(o.added for o in some)) if hidden else "-")
        ratio = ratio_to_best(some)
        cells += [f"{before:.3g} -> {after:.3g} um", f"{ratio:.2f}" if np.isfinite(ratio) else "-"]
        lines.append(f"| {' | '.join(cells)} |")
    return lines


def total_lines(outcomes: list[Outcome]) -> list[str]:
    """Return the totals of the page's table, in words."""
    groups = grouped(outcomes)
    nothing = [some for (_, hides), some in groups.items() if not hides]
    hidden = [some for (_, hides), some in groups.items() if hides]
    hows = sum((count_hows(some) for some in hidden), Counter())
    others = sum(sum(list_others(some).values()) for some in hidden)
    silent, n_silent = sum(o.right for some in nothing for o in some), sum(map(len, nothing))
    return [
        f"- Nothing was named in {silent} of {n_silent} sessions that hid nothing, with "
        f"{len(nothing)} set-ups.",
        f"- Of {sum(map(len, hidden))} sessions that hid an effect, {hows['alone']} named it "
        f"alone, {hows['or']} in an `A or B`, and {hows['not']} did not name it. Other effects "
        f"were named: {others}.",
    ]


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--draws", type=int, default=10)
    add_options(parser)
    parser.add_argument("--page", action="store_true", help=f"only write the table of {PAGE.name}")
    parser.add_argument("row", nargs="*")
    given = parser.parse_args()
    if given.page:
        outcomes = [*kept(STUDY).values()]
        lines = [*table_lines(outcomes), "", *total_lines(outcomes)]
        return put_between(PAGE, START, END, "\n".join(lines))
    cases = list_cases(given.draws, given.row)
    known = kept(given.results) if given.results else {}
    done = run_missing(cases, known, run, given.results, given.minutes)
    for some in grouped(done).values():
        print(describe(some))


if __name__ == "__main__":
    main()
