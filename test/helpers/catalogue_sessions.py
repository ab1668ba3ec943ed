"""Sessions of virtual robots that hide an effect of the catalogue, as Datasets, and their truth.

The effects come from the independent virtual robots. Every session has all conditions: what each
joint did before a sample is drawn, the hall warms and cools, the load changes, and the joints were
homed twice.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any
from unittest import mock

import numpy as np
import virtual_arm as va
import virtual_day as vd
import virtual_effects_hidden as hidden
import virtual_effects_more as more
import virtual_sessions as days
from arms import nominal
from test_virtual_robots import CABLE
from twins import hexapod
from virtual_cable import Line, WoundCable
from virtual_lines import Creep, LinedRobot, Pulleys, Tension
from virtual_small import Cable
from virtual_struts import UniversalJoints

from parallel_cal.causes import effects as catalogue
from parallel_cal.identification.fit import fit
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.model import Model, new_model
from parallel_cal.model.shelf import list_plugins, load_effect, load_mechanism
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.virtual import joint_effects as ve
from parallel_cal.virtual import load_effects as vl
from parallel_cal.virtual import robot as vr
from parallel_cal.virtual.joint_effects import Visit

POSES, AGAIN = 120, 30  # visited once; visited again
UNSEEN = 60  # poses that nobody measured, for the true error


@dataclass(frozen=True)
class Machine:
    """A virtual robot and the model that a person begins with.

    `commands(n, seed)` draws poses; `measure(effect, commands, at)` is what the robot does there
    without noise: readings (n, nq), position, and rotation (None where it cannot turn).
    """

    model: Callable[[], Model]
    noise: vr.Noise
    reach: float  # of a joint before a sample (rad or m)
    commands: Callable[[int, int], vr.Array]
    measure: Callable[[Any, vr.Array, Visit], tuple[vr.Array, vr.Array, vr.Array | None]]


HEXAPOD = hexapod()


def _delta_readings(n: int, seed: int) -> vr.Array:
    return vr.NOMINAL.inverse(vd.targets(n, seed))[0]


def _leg_readings(n: int, seed: int) -> vr.Array:
    rng = np.random.default_rng([seed, 9])
    r = HEXAPOD.home + rng.uniform(-0.05, 0.05, (n, 3))
    return HEXAPOD.inverse(r, vr.turn(rng.uniform(-0.2, 0.2, (n, 3))))[0]


def _cable_places(n: int, seed: int) -> vr.Array:
    low, high = (-0.5, -0.5, 0.0), (0.5, 0.5, 0.8)
    return np.random.default_rng([seed, 9]).uniform(low, high, (n, 3))


def _taut_places(n: int, seed: int) -> vr.Array:
    """Where no line that holds the platform becomes slack."""
    low, high = (-0.35, -0.35, 0.1), (0.35, 0.35, 0.6)
    return np.random.default_rng([seed, 9]).uniform(low, high, (n, 3))


def _measure_with(built: Any) -> Callable[..., Any]:
    def measure(effect: Any, reading: vr.Array, at: Visit) -> Any:
        _, r, R = vr.truth(built, [effect] if effect else [], reading, at)
        return reading, r, R

    return measure


def _measure_cable(line: Any, places: vr.Array, at: Visit) -> Any:
    robot = WoundCable(CABLE, line or Line())
    return robot.motors(places), robot.hangs(places, at.payload), None


# With a high anchor that is beside the home pose: a line above it has no direction to sag in.
BESIDE = CABLE | {"line4.A_x": 0.2, "line4.A_y": 0.1}


def _model_lines() -> Model:
    anchors = [[BESIDE[f"line{i}.A_{axis}"] for axis in "xyz"] for i in range(1, 5)]
    advantages = [BESIDE[f"line{i}.advantage"] for i in range(1, 5)]
    options = {"anchors": anchors, "advantages": advantages, "spools": (1, 1, 1, 2)}
    return new_model(load_mechanism("cable", **options))


def _with_lines(**physics: Any) -> LinedRobot:
    """The cable robot with lines that are more than straight distances."""
    straight = Cable(BESIDE)
    return LinedRobot(straight.anchors, straight.way, **physics)


def _measure_lines(robot: Any, places: vr.Array, at: Visit) -> Any:
    return (robot or _with_lines()).readings(places, at.time), places, None


def _arm_readings(n: int, seed: int) -> vr.Array:
    rng = np.random.default_rng([seed, 9])
    return np.array(va.HOME["ur5"]) + rng.uniform(-0.9, 0.9, (n, 6))


def _measure_arm(links: Any, reading: vr.Array, at: Visit) -> Any:
    T = va.arm("ur5", 4, links=links).reached(reading, at.direction)
    return reading, T[:, :3, 3], T[:, :3, :3]


MACHINES = {
    "arm": Machine(
        lambda: nominal("ur5"),
        vr.Noise(joint=10e-6, position=20e-6, orientation=50e-6),
        0.6,
        _arm_readings,
        _measure_arm,
    ),
    "delta": Machine(
        lambda: new_model("delta54"),
        vr.THESIS_NOISE,
        0.6,
        _delta_readings,
        _measure_with(vr.MOCK_UP),
    ),
    "simple delta": Machine(
        lambda: new_model("delta24"),
        vr.THESIS_NOISE,
        0.6,
        _delta_readings,
        lambda effect, reading, at: _measure_with(effect or vr.NOMINAL)(None, reading, at),
    ),
    "hexapod": Machine(
        lambda: new_model("stewart42"),
        vr.Noise(joint=2e-6, position=5e-6, orientation=10 * vr.ARCSEC),
        0.08,
        _leg_readings,
        _measure_with(HEXAPOD),
    ),
    "cable": Machine(
        lambda: new_model("cable"),
        vr.Noise(joint=0.02, position=0.1e-3),
        50.0,
        _cable_places,
        _measure_cable,
    ),
    "lines": Machine(
        _model_lines,
        vr.Noise(joint=0.02, position=0.1e-3),
        50.0,
        _taut_places,
        _measure_lines,
    ),
}


@dataclass(frozen=True)
class Hidden:
    """An effect of the catalogue in a virtual robot.

    `make(size, rng)` draws its physics, `size` is a first size. A law is right whose place contains
    one of `places`, and whose drivers are all of `drivers` and at least one of `decisive`.
    """

    machine: str
    make: Callable[[float, np.random.Generator], Any]
    size: float
    places: frozenset[str]
    drivers: frozenset[str]
    decisive: frozenset[str]


def _signed(size: float, rng: np.random.Generator, n: int) -> tuple[float, ...]:
    """n numbers, none of them small."""
    return tuple(size * rng.uniform(0.6, 1.4, n) * rng.choice([-1, 1], n))


def _positive(size: float, rng: np.random.Generator, n: int) -> tuple[float, ...]:
    return tuple(size * rng.uniform(0.6, 1.4, n))


def _phases(rng: np.random.Generator, n: int) -> tuple[float, ...]:
    return tuple(rng.uniform(-np.pi, np.pi, n))


def _drag(size: float, rng: np.random.Generator, n: int) -> Any:
    beside = np.roll(np.eye(n), 1, axis=0) + np.roll(np.eye(n), -1, axis=0)
    return ve.DraggedNeighbours(tuple(np.reshape(_signed(size, rng, n * n), (n, n)) * beside))


def _larger_delta(size: float, rng: np.random.Generator) -> Any:
    """Parallelograms whose bars and spacings are not equal."""
    own = dict(vr.NOMINAL.parameters)
    for name in own:
        if name.split(".")[1] in ("dC_x", "dC_y", "dC_z", "dLb"):
            own[name] += size * float(rng.choice([-1, 1])) * float(rng.uniform(0.6, 1.4))
    return vr.Delta(own)


def _stiffening(soft: tuple[float, ...], torque: float) -> Any:
    """Gears of the compliance `soft` (rad/Nm) at no load, half as stiff again at `torque` (Nm)."""
    k1 = 1 / np.array(soft)
    return more.StiffeningGears(tuple(k1), tuple(k1**3 / torque**2))


JOINTS = frozenset({"joint", "leg", "motor"})
# A line's length is that at its spool, or the distance to its anchor.
LINES = JOINTS | {"spool", "offset", "A_"}
# The length of an arm moves the platform as the reading next to it does.
ARMS = JOINTS | {"La_x", "La_y"}
PLACE = frozenset({"x", "y", "z", "radius", "tilt_x", "tilt_y", "yaw"})
READING = frozenset({"reading"})
LOADS = frozenset({"load", "tension", "stretch", "moment", "payload"})
CARRIED = frozenset({"joint", "rod", "leg", "La", "Lb", "dLb", "pose", "base", "L0"})


def _of_reading(machine: str, make: Callable[..., Any], size: float) -> Hidden:
    """An error of every joint's reading that depends on this joint."""
    return Hidden(machine, make, size, ARMS, READING, READING)


def _of_load(
    make: Callable[..., Any], size: float, machine: str = "delta", places: frozenset[str] = CARRIED
) -> Hidden:
    """An error of what carries the load: it goes with the load, wherever the platform is."""
    return Hidden(machine, make, size, places, LOADS | PLACE | READING, LOADS)


def _condition(name: str, places: frozenset[str], machine: str, make: Any, size: float) -> Hidden:
    return Hidden(machine, make, size, places, frozenset({name}), frozenset({name}))


def _of_lines(make: Callable[..., Any], size: float) -> Hidden:
    """An error of every line's length that depends on where the platform is."""
    return Hidden("lines", make, size, LINES, PLACE | READING, PLACE | READING)


def _list_pulleys(radius: float) -> Pulleys:
    """Pulleys of the low lines, which come from below, and of the high one, from the side."""
    return Pulleys(radius, [(0, 0, -1.0)] * 3 + [(1.0, 0, 0)])


# Errors of the pose alone, as a device may have them: `robot_or_device` is the right answer.
OF_POSE_ALONE = (
    "line_flex",
    "line_sag",
    "pulley_radius",
    "strut_rotation",
    "universal_joint_offset",
)
# No law of one place: a larger model is the right answer.
OF_LARGER_MODEL = ("parallelogram_errors",)
EFFECTS = {
    "acceleration_lag": _condition(
        "acceleration",
        JOINTS,
        "delta",
        lambda s, rng: more.BentByInertia(tuple(np.array(_positive(s, rng, 3)) ** -0.5)),
        0.2e-3,
    ),
    "backlash": _condition(
        "direction", ARMS, "delta", lambda s, rng: vr.Backlash(_positive(s, rng, 3)), 3e-4
    ),
    "ball_joint_clearance": _of_load(lambda s, rng: more.LooseBalls(s, 2.0), 5e-5),
    "encoder_crosstalk": Hidden(
        "hexapod",
        lambda s, rng: _drag(s, rng, 6),
        1e-3,
        ARMS,
        frozenset({"reading", "next_joint", "previous_joint"}),
        frozenset({"reading", "next_joint", "previous_joint"}),
    ),
    "encoder_eccentricity": _of_reading(
        "delta", lambda s, rng: vr.EncoderEccentricity(_signed(s, rng, 3), _signed(s, rng, 3)), 3e-3
    ),
    "encoder_gain": _of_reading("hexapod", lambda s, rng: ve.WrongPitch(_signed(s, rng, 6)), 1e-3),
    "encoder_harmonic": _of_reading(
        "delta",
        lambda s, rng: more.LobedRing(int(rng.integers(3, 9)), _signed(s, rng, 3), _phases(rng, 3)),
        1e-3,
    ),
    "encoder_interpolation": _of_reading(
        "hexapod",
        lambda s, rng: more.UnevenPitch(6e-3, _signed(s, rng, 6), _phases(rng, 6)),
        5e-6,
    ),
    "encoder_second_harmonic": _of_reading(
        "delta", lambda s, rng: ve.OvalDisc(_signed(s, rng, 3), _phases(rng, 3)), 3e-3
    ),
    "gear_transmission_error": _of_reading(
        "delta",
        lambda s, rng: hidden.GearRipple(_signed(s, rng, 3), _phases(rng, 3), rng.uniform(15, 60)),
        0.3e-3,
    ),
    "hysteresis": _condition(
        "travel",
        ARMS,
        "delta",
        lambda s, rng: ve.WindUp(_positive(s, rng, 3), 60e-3),
        3e-4,
    ),
    "joint_compliance": _of_load(
        lambda s, rng: hidden.JointCompliance(_positive(s, rng, 3)), 0.5e-3
    ),
    "latency": _condition("velocity", JOINTS, "delta", lambda s, rng: more.LateStamp(s), 1e-3),
    "line_creep": Hidden(
        "lines",
        lambda s, rng: _with_lines(creep=Creep((s, 2 * s), (180.0, 1800.0))),
        1e-4,
        LINES,
        frozenset({"time"}) | PLACE | READING,
        frozenset({"time"}),
    ),
    "line_flex": _of_lines(
        lambda s, rng: _with_lines(tension=Tension(EA=10 / s, platform=10.0, pretension=30.0)), 1e-3
    ),
    "line_sag": _of_lines(
        lambda s, rng: _with_lines(
            tension=Tension(weight_per_metre=50 * np.sqrt(s), pretension=50.0)
        ),
        1e-3,
    ),
    "line_stretch": _of_load(
        lambda s, rng: Line(EA=1 / s), 1e-4, "cable", frozenset({"pose", "offset", "motor"})
    ),
    "load_friction": Hidden(
        "delta",
        lambda s, rng: more.RubbingGears(0.2, _positive(5 * s, rng, 3)),
        0.2e-3,
        ARMS,
        LOADS | PLACE | READING | {"direction"},
        frozenset({"direction"}),
    ),
    "own_weight_sag": Hidden(
        "arm",
        lambda s, rng: replace(va.UR5_LINKS, compliance=_positive(s, rng, 6)),
        2e-5,
        ARMS,
        PLACE | READING,
        PLACE | READING,
    ),
    "parallelogram_errors": Hidden(
        "simple delta",
        _larger_delta,
        1e-4,
        frozenset({"pose", "joint", "chain", "L", "D", "b"}),
        PLACE | READING,
        PLACE | READING,
    ),
    "payload_sag": _of_load(lambda s, rng: vl.SoftFrame(s, 8 * s), 2e-6, places=CARRIED),
    "pulley_radius": _of_lines(lambda s, rng: _with_lines(pulleys=_list_pulleys(s)), 20e-3),
    "rod_compliance": _of_load(lambda s, rng: vl.SoftRods(s), 3e-6),
    "screw_pitch_error": _of_reading(
        "hexapod",
        lambda s, rng: ve.UnevenScrew(
            rng.uniform(4e-3, 8e-3), _signed(s, rng, 6), _phases(rng, 6), (0.0,) * 6
        ),
        5e-6,
    ),
    "servo_lag": _condition(
        "velocity",
        JOINTS,
        "delta",
        lambda s, rng: more.LateDrives(tuple(1 / np.array(_positive(s, rng, 3)))),
        1e-3,
    ),
    "spool_buildup": _of_reading(
        "cable", lambda s, rng: Line(section=s * np.pi * 5e-3, width=5e-3), 0.1e-3
    ),
    "strut_rotation": Hidden(
        "hexapod",
        lambda s, rng: UniversalJoints(lead=s),
        1e-3,
        ARMS | {"L0"},
        PLACE | READING,
        PLACE | READING,
    ),
    "strain_wave_compliance": _of_load(
        lambda s, rng: _stiffening(_positive(s, rng, 3), 0.5), 0.5e-3
    ),
    "strain_wave_ripple": _of_reading(
        "delta",
        lambda s, rng: more.BeatingGears(
            50.0, _signed(s, rng, 3), _phases(rng, 3), _phases(rng, 3)
        ),
        0.3e-3,
    ),
    "thermal_expansion": _condition(
        "temperature",
        frozenset({"La", "Lb", "D", "joint"}),
        "delta",
        lambda s, rng: hidden.ThermalGrowth(*_positive(s, rng, 3)),
        30e-6,
    ),
    "thermal_expansion_by_part": Hidden(
        "delta",
        lambda s, rng: more.PartsOfAHall(*_positive(s, rng, 3)),
        10e-6,
        frozenset({"La", "Lb", "D", "rod"}),
        frozenset({"temperature"}),
        frozenset({"temperature"}),
    ),
    "universal_joint_offset": Hidden(
        "hexapod",
        lambda s, rng: UniversalJoints(foot=_signed(s, rng, 6), head=_signed(s, rng, 6)),
        5e-3,
        ARMS | {"L0"},
        PLACE | READING,
        PLACE | READING,
    ),
    "zero_shift": _condition(
        "session", ARMS, "delta", lambda s, rng: more.HomedAnew(_signed(s, rng, 3)), 3e-4
    ),
}


def list_lookalikes(effect: str) -> set[str]:
    """The effect and those whose residuals it resembles, as the catalogue says."""
    names = list_plugins("effects")
    others = {one for one in names if effect in load_effect(one).lookalikes}
    return {effect, *load_effect(effect).lookalikes, *others}


@contextmanager
def without_effects(names: set[str]) -> Iterator[None]:
    """A catalogue without some effects."""
    left = [name for name in list_plugins("effects") if name not in names]
    with mock.patch.object(catalogue, "list_plugins", return_value=left):
        yield


def draw_visits(machine: Machine, n: int, joints: int, seed: int) -> more.Motion:
    """What happened before each of n samples, the air and the load."""
    at = vd.visits(n, joints, seed, machine.reach)
    payload = np.where(np.arange(n) * 6 // n % 2, 1.2, 0.2)
    at = replace(at, temperature=days.wandering(at.time / 2), payload=payload)
    return more.Motion.of(at, 10 * machine.reach, seed)


def list_conditions(joints: tuple[str, ...], at: Visit, effect: Any) -> dict[str, vr.Array]:
    """What was recorded at each sample; of an effect of warm parts, their temperatures, too, and of
    inertia the accelerations."""
    kinds = ("direction", "travel", "velocity")
    known = {
        f"{kind}.{joint}": getattr(at, kind)[:, i]
        for kind in (*kinds, *["acceleration"] * isinstance(effect, more.BentByInertia))
        for i, joint in enumerate(joints)
    }
    common = {name: getattr(at, name) for name in ("time", "temperature", "payload")}
    parts = effect.temperatures(at.time) if isinstance(effect, more.PartsOfAHall) else {}
    own = {f"temperature.{part}": warm for part, warm in parts.items()}
    return known | common | own | {"session": at.session.astype(float)}


def measure(machine: Machine, effect: Any, seed: int, loud: float = 1.0) -> Dataset:
    """A session with an effect (None: with none); `loud` 0 is without errors."""
    joints = machine.model().joints
    rng = np.random.default_rng([seed, 5])
    pose = rng.permutation(np.r_[np.arange(POSES), rng.choice(POSES, AGAIN, replace=False)])
    at = draw_visits(machine, len(pose), len(joints), seed)
    q, r, R = machine.measure(effect, machine.commands(POSES, seed)[pose], at)
    q_error, r_error, w_error = vd.errors(machine.noise, len(q), len(joints), seed)
    sigma = np.repeat([machine.noise.position, machine.noise.orientation], 3)
    if R is None:
        sigma[3:] = np.nan
    return Dataset.from_arrays(
        joints,
        q + loud * q_error,
        r + loud * r_error,
        None if R is None else vr.turn(loud * w_error) @ R,
        pose_cov=np.diag(sigma**2),
        joint_sigma=machine.noise.joint,
        conditions=list_conditions(joints, at, effect),
        pose_id=pose,
        source="virtual robot",
    )


def draw_effect(name: str, seed: int, sigmas: float) -> Any:
    """An effect whose rms residual, which the geometry leaves, is so many sigmas."""
    kind = EFFECTS[name]
    machine, size = MACHINES[kind.machine], kind.size
    for _ in range(2):
        still = measure(machine, kind.make(size, np.random.default_rng([seed, 3])), seed, loud=0.0)
        found = fit(machine.model(), still, hold_out=0, insist=True)
        size *= sigmas / float(np.sqrt(found.estimate.chi2_per_dof))
    return kind.make(size, np.random.default_rng([seed, 3]))


def compute_true_error(name: str, model: Model, effect: Any, seed: int) -> float:
    """Rms position error (m) of a model at poses that nobody measured."""
    machine = MACHINES[EFFECTS[name].machine]
    commands = machine.commands(UNSEEN, seed + 10_000)
    at = draw_visits(machine, UNSEEN, len(model.joints), seed + 10_000)
    q, r, _ = machine.measure(effect, commands, at)
    found = Kinematics(model.robot()).direct(q, list_conditions(model.joints, at, effect))
    return float(np.sqrt(np.mean(np.sum((found.position - r) ** 2, axis=1))))


def is_named(laws: Any, name: str, joints: tuple[str, ...]) -> tuple[bool, bool]:
    """Whether a law, or one that is equally good, has the right place, and the right drivers."""
    kind, place, driver = EFFECTS[name], False, False
    for law in laws:
        for answer in (law.name, *law.alternatives):
            where, _, on = answer.partition(" by ")
            families = {_family(one, joints) for one in on.split(" and ")}
            if families <= kind.drivers and families & kind.decisive:
                driver = True
                place = place or any(right in where for right in kind.places)
    return place, driver


def _family(driver: str, joints: tuple[str, ...]) -> str:
    """A driver without its joint; the reading of a joint is `reading`."""
    if driver in joints:
        return "reading"
    return driver.partition(".")[0]
