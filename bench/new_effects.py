"""Whether a diagnosis names each of the effects that joined the catalogue late, and no other.

Robots, physics and noise come from the independent virtual robots; every draw has its own poses.
Effects are sized in sigmas of what the geometry leaves of them.
Usage: `PYTHONPATH=. python bench/new_effects.py [draws] [kind ...]`.
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "test"))

import virtual_arm as va
import virtual_day as vd
import virtual_effects_more as more
import virtual_findings as vf
import virtual_setups as vs
from arms import nominal
from twins import hexapod
from virtual_lines import Creep, LinedRobot, Pulleys, Tension
from virtual_struts import UniversalJoints

from parallel_cal.diagnosis.diagnose import Diagnosis, diagnose
from parallel_cal.identification.fit import fit
from parallel_cal.model.model import Model, new_model
from parallel_cal.model.shelf import load_mechanism, load_sensor
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.virtual import joint_effects as ve
from parallel_cal.virtual import robot as vr
from parallel_cal.virtual.linear_delta import LinearDelta

SIZES = (0.8, 1.4, 2.0)  # sigmas of the residual
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
    "lifting arm": LiftingRobot(
        lambda: nominal("ur5"), ARM, vr.Noise(1e-5, 20e-6, 50e-6), arm_poses, heaviest=5.0
    ),
    "moving delta": MovingRobot(
        lambda: new_model("delta54"), vr.MOCK_UP, vr.THESIS_NOISE, delta_poses
    ),
    "moving stewart": MovingRobot(
        lambda: new_model("stewart42"), HEXAPOD, LEGS, leg_poses, reach=0.08
    ),
    "linear delta": Robot(lambda: new_model("linear_delta"), RAILS, LEGS, carriage_poses),
    "four lines": cable_robot(FOUR_LINES, (-0.35, -0.35, 0.1), (0.35, 0.35, 0.6)),
    "eight lines": cable_robot(EIGHT_LINES, (-0.5, -0.5, 0.2), (0.5, 0.5, 1.2)),
}


@dataclass(frozen=True)
class Kind:
    """Hidden physics: the robots to try it on, its names, and how a size and a draw make one. Its
    size is that of what the geometry and the effect `special`, a special case of it, leave."""

    names: tuple[str, ...]
    robots: tuple[str, ...]
    make: Callable[[float, np.random.Generator, int], Any]
    size: float
    special: str = ""


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
    return more.BentSpace(tuple(form + form.transpose(0, 2, 1)), (0.0, 0.0, 0.2))


def refraction(size: float, rng: np.random.Generator, n: int) -> Any:
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


def beating(size: float, rng: np.random.Generator, n: int) -> Any:
    ratio = float(rng.choice([30, 50, 80, 100]))
    return more.BeatingGears(ratio, some(size, rng, n), phases(rng, n), phases(rng, n))


def notched(size: float, rng: np.random.Generator, n: int) -> Any:
    return more.UnevenPitch(rng.uniform(2e-3, 30e-3), some(size, rng, n), phases(rng, n))


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


def known(kind: vf.Kind) -> Callable[..., Any]:
    return lambda size, rng, n: kind.make(size, rng)


KINDS = {
    "screw, periodic": Kind(("screw_pitch_error",), ("stewart", "linear delta"), wobble, 10e-6),
    "screw, growing": Kind(("screw_pitch_error",), ("stewart", "linear delta"), growing, 10e-6),
    "lobed ring": Kind(("encoder_harmonic",), ("delta",), lobes, 0.3e-3),
    "cross-talk": Kind(("encoder_crosstalk",), ("delta", "stewart"), dragged, 1e-3),
    "knock": Kind(("device_bump",), ("delta", "stewart"), knock, 20e-6),
    "bent space": Kind(("device_field",), ("fine delta", "stewart"), bent, 1e-3),
    "refraction": Kind(("device_field",), ("fine delta", "stewart"), refraction, 2e-3),
    "leaning base": Kind(("base_compliance",), ("fine delta", "stewart"), leaning, 0.2e-3),
    "twisted struts": Kind(("strut_rotation",), ("stewart",), twisted, 1e-3),
    "offset joints": Kind(("universal_joint_offset",), ("stewart",), apart, 1e-3),
    "pulleys": Kind(("pulley_radius",), ("four lines", "eight lines"), pulleys, 5e-3),
    "taut lines": Kind(("line_flex",), ("four lines", "eight lines"), taut, 0.3e-3),
    "sagging lines": Kind(("line_sag",), ("four lines", "eight lines"), hanging, 1e-4),
    "creep": Kind(("line_creep",), ("four lines", "eight lines"), creeping, 0.1e-3),
    "rubbing gears": Kind(("load_friction",), ("lifting delta", "lifting arm"), rubbing, 1e-5),
    "rubbing screws": Kind(("load_friction",), ("lifting stewart",), rubbing, 1e-8),
    "stiffening gears": Kind(
        ("strain_wave_compliance",),
        ("lifting delta", "lifting arm"),
        stiffening,
        1e-4,
        "joint_compliance",
    ),
    "beating gears": Kind(("strain_wave_ripple",), ("delta", "lifting arm"), beating, 0.3e-3),
    "uneven pitch": Kind(("encoder_interpolation",), ("stewart", "linear delta"), notched, 10e-6),
    "bending by inertia": Kind(
        ("acceleration_lag",), ("moving delta", "moving stewart"), bending, 0.1e-3
    ),
    "bed": Kind(("bed_shape",), ("gauged stewart",), bed, 1e-3),
    "probe beside": Kind(("probe_offset",), ("gauged stewart",), beside, 0.1e-3),
    "probe slanted": Kind(("probe_tilt",), ("gauged stewart",), slanted, 5e-3),
    **{
        name: Kind(
            kind.names,
            ("fine delta" if kind.noise != vr.THESIS_NOISE else "delta",),
            known(kind),
            kind.size,
        )
        for name, kind in vf.KINDS.items()
    },
}


def sized(robot: Robot, kind: Kind, wanted: float, seed: int) -> Any:
    """The effect so large that the geometry leaves `wanted` sigmas of it."""
    size, joints = kind.size, len(robot.model().joints)

    def effect() -> Any:
        return kind.make(size, np.random.default_rng(seed), joints)

    model = robot.model()
    if kind.special:
        model = model.with_effect(kind.special)
    for _ in range(2):
        still = fit(model, robot.measured([effect()], seed, loud=0.0), hold_out=0, insist=True)
        size *= wanted / float(np.sqrt(still.estimate.chi2_per_dof))
    return effect()


@dataclass
class Tally:
    """What became of the draws of one kind."""

    named: Counter[str] = field(default_factory=Counter)
    verdicts: Counter[str] = field(default_factory=Counter)
    others: Counter[str] = field(default_factory=Counter)

    def add(self, found: Diagnosis, names: tuple[str, ...]) -> None:
        self.verdicts[found.verdict.word] += 1
        groups = [{name, *found.swaps.get(name, [])} for name in found.effects]
        right = [g for g in groups if g & {*names}]
        how = "or" if right else "not"
        if any(g <= {*names} for g in right):
            how = "alone"
        self.named[how] += 1
        self.others.update("/".join(sorted(g)) for g in groups if not g <= {*names})

    def words(self) -> str:
        alone, either, missed = (self.named[k] for k in ("alone", "or", "not"))
        counts = f"alone {alone}, in A or B {either}, not {missed}"
        return f"{counts}; {dict(self.verdicts)}; otherwise {dict(self.others)}"


def hidden(robot: Robot, kind: Kind, draws: int) -> str:
    tally = Tally()
    for seed in range(draws):
        effect = sized(robot, kind, SIZES[seed % len(SIZES)], seed)
        tally.add(diagnose(robot.model(), robot.measured([effect], seed)), kind.names)
    return tally.words()


def nothing(robot: Robot, draws: int) -> str:
    tally = Tally()
    for seed in range(draws):
        tally.add(diagnose(robot.model(), robot.measured([], seed)), ())
    return tally.words()


def studies(draws: int) -> Iterator[tuple[str, Callable[[], str]]]:
    for at, robot in ROBOTS.items():
        yield f"nothing on {at}", lambda robot=robot: nothing(robot, 2 * draws)
    for (name, kind), at in product(KINDS.items(), ROBOTS):
        if at in kind.robots:
            yield f"{name} on {at}", lambda k=kind, r=ROBOTS[at]: hidden(r, k, draws)


def main() -> None:
    draws = int(sys.argv[1]) if len(sys.argv) > 1 else 10
    wanted = sys.argv[2:]
    for name, study in studies(draws):
        if not wanted or any(w in name for w in wanted):
            print(f"{name}: {study()}", flush=True)


if __name__ == "__main__":
    main()
