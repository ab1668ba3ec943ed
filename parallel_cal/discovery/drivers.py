"""Drivers: quantities that an error can depend on, at every sample and as code of an effect."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from typing import Any

import casadi as ca
import numpy as np

from parallel_cal.base.compiled import Batch, dense
from parallel_cal.diagnosis.thresholds import LEVELS, MIN_SLOW_CORRELATION, SAMPLES_PER_NUMBER
from parallel_cal.discovery.places import DEVICE, JOINT, ROD
from parallel_cal.discovery.thresholds import (
    LAGS_PER_OCTAVE,
)
from parallel_cal.effects._legs import leg_inclinations, needs_legs
from parallel_cal.effects._lines import line_stretches, needs_hanging_lines
from parallel_cal.effects._statics import (
    PAYLOAD,
    joint_forces,
    masses,
    needs_rods,
    needs_weight,
    rod_forces,
    rods,
)
from parallel_cal.identification.thresholds import ROUNDING
from parallel_cal.model.effect import CONDITIONS, Seen, parse_lag, parse_part
from parallel_cal.model.parameters import Named
from parallel_cal.posterior.scene import Scene
from parallel_cal.recordings.dataset import Dataset

ROBOT, AXIS = "robot", "axis"
OWNERS = (ROBOT, JOINT, ROD, AXIS, DEVICE)  # what a driver belongs to
READING, LOAD, TENSION, TIME = "reading", "load", "tension", "time"
STRETCH, MOMENT = "stretch", "moment"
INCLINATION = "inclination"  # of legs, lines or rods
LAGGED = "lagged temperature"  # of parts that warm up later than the sensor
NEXT, PREVIOUS = "next_joint", "previous_joint"  # readings of neighbours, for laws of all joints
JOINT_CONDITIONS = tuple(name for name, (_, _, per_joint) in CONDITIONS.items() if per_joint)
COMMON_CONDITIONS = tuple(name for name, (_, _, per_joint) in CONDITIONS.items() if not per_joint)
MIN_LEVEL_PART = 0.1  # of the platform's x axis, across z: with less, yaw is not determined
# How a law names a driver, and what an effect's `ideal` computes it from.
PLACES = {
    "x": ("m", "seen.r[0]"),
    "y": ("m", "seen.r[1]"),
    "z": ("m", "seen.r[2]"),
    "radius": ("m", "ca.sqrt(seen.r[0] ** 2 + seen.r[1] ** 2 + 1e-12)"),
    "tilt_x": ("rad", "seen.R[2, 1]"),
    "tilt_y": ("rad", "-seen.R[2, 0]"),
    "yaw": ("rad", "ca.atan2(seen.R[1, 0], seen.R[0, 0])"),
}
WORDS = {  # of drivers of the whole robot, and of those of a member's own joint or rod
    "payload": "the payload",
    "temperature": "the temperature",
    "time": "time",
    "session": "the session",
    "radius": "the platform's distance from the z axis",
    "tilt_x": "the platform's tilt about x",
    "tilt_y": "the platform's tilt about y",
    "yaw": "the platform's rotation about z",
    **{axis: f"the platform's {axis}" for axis in "xyz"},
    LOAD: "the load on its own joint",
    TENSION: "the tension of its own rod",
    STRETCH: "the stretch of its own line by the payload, with all lines of one stiffness EA",
    MOMENT: "the moment of the payload's weight about the same axis",
    INCLINATION: "the inclination of its own rod, leg or line (sine of its angle above the "
    "horizontal)",
    READING: "the reading of its own joint",
    NEXT: "the reading of the next joint",
    PREVIOUS: "the reading of the previous joint",
    "direction": "the approach direction of its own joint",
    "travel": "the travel of its own joint since the reversal",
    "velocity": "the velocity of its own joint",
    "acceleration": "the acceleration of its own joint",
}
JOINT_WORDS = {  # of drivers of one named joint or rod
    LOAD: "the load on {}",
    TENSION: "the tension of {}",
    STRETCH: "the stretch of the line of {} by the payload, with all lines of one stiffness EA",
    MOMENT: "the moment of the payload's weight about {}",
    INCLINATION: "the inclination of {} (sine of its angle above the horizontal)",
    READING: "the reading of {}",
    "direction": "the approach direction of {}",
    "travel": "the travel of {} since the reversal",
    "velocity": "the velocity of {}",
    "acceleration": "the acceleration of {}",
}
# Physics rarely depends on the last ones: they order only laws that explain the data equally well.
PLAUSIBILITY = (
    LOAD,
    TENSION,
    STRETCH,
    MOMENT,
    "payload",
    READING,
    "direction",
    "travel",
    "temperature",
    LAGGED,
    INCLINATION,
    NEXT,
    PREVIOUS,
    "radius",
    "velocity",
    "acceleration",
    "z",
    "x",
    "y",
    "tilt_x",
    "tilt_y",
    "yaw",
    "time",
    "session",
)


def name_lags(dataset: Dataset) -> list[str]:
    """Name the temperature with time constants (s) between a few samples and the recording's
    length, evenly in their logarithm; none if the temperature hardly changes."""
    known = dataset.conditions
    if not {"temperature", "time"} <= set(known) or np.ptp(known["temperature"]) <= ROUNDING:
        return []
    steps = np.diff(np.sort(known["time"]))
    steps, span = steps[steps > 0], float(np.ptp(known["time"]))
    if not len(steps):
        return []
    first = SAMPLES_PER_NUMBER * float(np.median(steps))
    octaves = np.floor(np.log2(max(span / first, 1.0)))
    lags = first * 2.0 ** (np.arange(LAGS_PER_OCTAVE * octaves + 1) / LAGS_PER_OCTAVE)
    names = dict.fromkeys(f"temperature.lag{lag:.0f}" for lag in lags)
    return [name for name in names if parse_lag(name)]


@dataclass(frozen=True)
class Driver:
    """A quantity at every sample, relative to `zero`.

    `name` is as in reports (`load.joint2`), `family` its name without the joint, `code` what an
    effect computes it from, `needs` the condition that this requires. `slow` is whether it changes
    as slowly as noise may. `owner` is what it belongs to: the JOINT, ROD or AXIS of {B} with the
    number `index`, the whole ROBOT, or the DEVICE if it is a position in the frame of a device that
    stood elsewhere in each recording.
    """

    name: str
    family: str
    unit: str
    code: str
    values: np.ndarray = field(repr=False)
    zero: float = 0.0
    needs: str = ""
    slow: bool = False
    owner: str = ROBOT
    index: int = 0

    @property
    def joint(self) -> int | None:
        """The number of the joint that it belongs to, if it belongs to one."""
        return self.index if self.owner == JOINT else None

    @property
    def few_values(self) -> bool:
        return len(np.unique(self.values)) <= LEVELS

    @property
    def range(self) -> tuple[float, float]:
        """The lowest and the highest value in the samples, not relative to `zero`."""
        return float(self.values.min() + self.zero), float(self.values.max() + self.zero)

    @property
    def words(self) -> str:
        """The driver in words: `the load on joint2`."""
        if lag := parse_lag(self.name):
            return f"the {lag[0]}, delayed by a time constant of {lag[1]:g} s"
        if self.owner == DEVICE:
            return f"the {self.family} that the device shows"
        if part := parse_part(self.name):
            return f"the {part[0]} of the part '{part[1]}'"
        if self.family not in JOINT_WORDS:
            return WORDS[self.family]
        return JOINT_WORDS[self.family].format(self.name.rpartition(".")[2])

    @property
    def rank(self) -> int:
        return PLAUSIBILITY.index(self.kind)

    @property
    def kind(self) -> str:
        """The family, for which the temperatures of all parts are one."""
        part = parse_part(self.family)
        return part[0] if part else self.family


def list_drivers(scene: Scene) -> list[Driver]:
    """List the quantities that vary between the samples."""
    order = np.argsort(scene.dataset.time, kind="stable")
    known_order = "time" in scene.dataset.conditions
    found = []
    for one in chain.from_iterable(source(scene) for source in SOURCES):
        if np.isfinite(one.values).all() and np.ptp(one.values) > ROUNDING:
            away = one.values[order] - one.values[order].mean()
            correlated = bool(away[1:] @ away[:-1] > MIN_SLOW_CORRELATION * (away @ away))
            slow = known_order and correlated
            found.append(replace(one, slow=slow, values=np.ascontiguousarray(one.values)))
    return found


def list_shown_positions(shown: np.ndarray) -> list[Driver]:
    """The positions (N, 3) that the device shows as drivers of its errors."""
    columns = {axis: (f"shown[{k}]", shown[:, k]) for k, axis in enumerate("xyz")}
    distance = "ca.sqrt(shown[0] ** 2 + shown[1] ** 2 + 1e-12)"
    columns["radius"] = distance, np.hypot(shown[:, 0], shown[:, 1])
    found = []
    for name, (code, values) in columns.items():
        if np.ptp(values) > ROUNDING:
            middle = 0.0 if name == "radius" else _round_middle(values)
            own = f"device.{name}"
            found.append(Driver(own, name, "m", code, values - middle, middle, owner=DEVICE))
    return found


def select_for_screening(drivers: Sequence[Driver]) -> list[Driver]:
    """The drivers without the time constants between those that are screened."""
    lags = [one for one in drivers if one.family == LAGGED]
    left_out = {one.name for k, one in enumerate(lags) if k % LAGS_PER_OCTAVE}
    return [one for one in drivers if one.name not in left_out]


def _iterate_readings(scene: Scene) -> Iterator[Driver]:
    """Iterate over the readings of the joints."""
    units = scene.model.mechanism.joint_units
    for i, (name, unit) in enumerate(zip(scene.model.joints, units, strict=True)):
        middle = _round_middle(scene.seen[:, i])
        values = scene.seen[:, i] - middle
        yield Driver(name, READING, unit, f"seen.q[{i}]", values, middle, owner=JOINT, index=i)


def _iterate_statics(scene: Scene) -> Iterator[Driver]:
    """Iterate over the forces and moments of the payload, and how members lie in gravity."""
    joints, units = scene.model.joints, scene.model.mechanism.joint_units
    for i, values in enumerate(compute_loads(scene).T):
        unit = "N m" if units[i] == "rad" else "N"
        own = f"{LOAD}.{joints[i]}", LOAD, unit, f"load[{i}]", values
        yield Driver(*own, needs=PAYLOAD, owner=JOINT, index=i)
    for k, values in enumerate(compute_tensions(scene).T):
        own = f"{TENSION}.rod{k + 1}", TENSION, "N", f"tension[{k}]", values
        yield Driver(*own, needs=PAYLOAD, owner=ROD, index=k)
    for i, values in enumerate(compute_stretches(scene).T):
        own = f"{STRETCH}.{joints[i]}", STRETCH, "N m", f"stretch[{i}]", values
        yield Driver(*own, needs=PAYLOAD, owner=JOINT, index=i)
    owner = ROD if rods(scene.model.mechanism)[0] else JOINT
    for k, values in enumerate(compute_inclinations(scene).T):
        name = f"{INCLINATION}.{f'rod{k + 1}' if owner == ROD else joints[k]}"
        middle, code = _round_middle(values), f"{INCLINATION}[{k}]"
        values = values - middle
        yield Driver(name, INCLINATION, "1", code, values, middle, owner=owner, index=k)
    for axis, values in compute_moments(scene).items():
        own = f"{MOMENT}.{'xyz'[axis]}", MOMENT, "N m", f"moment[{axis}]", values
        yield Driver(*own, needs=PAYLOAD, owner=AXIS, index=axis)


def _iterate_conditions(scene: Scene) -> Iterator[Driver]:
    """Iterate over the recorded conditions: of each joint, of the robot, of its parts."""
    known, joints = scene.dataset.conditions, scene.model.joints
    for kind in JOINT_CONDITIONS:
        for i, name in enumerate(joints):
            key = f"{kind}.{name}"
            if key in known:
                unit = CONDITIONS[kind][0].replace("rad", scene.model.mechanism.joint_units[i])
                own = key, kind, unit, f"at[{json.dumps(key)}]", known[key]
                yield Driver(*own, needs=kind, owner=JOINT, index=i)
    common = {kind: f"at.{kind}" for kind in COMMON_CONDITIONS if kind in known}
    parts = [name for name in known if parse_part(name) and not parse_lag(name)]
    lags = [name for name in known if parse_lag(name)]
    for name in (*common, *parts, *lags):
        unit, neutral, _ = CONDITIONS[name.split(".")[0]]
        unit = unit.replace("degC", "K")  # of a difference
        code = common.get(name, f"at[{json.dumps(name)}]")
        family = LAGGED if name in lags else name
        yield Driver(name, family, unit, code, known[name] - neutral, zero=neutral, needs=name)


def _iterate_places(scene: Scene) -> Iterator[Driver]:
    """Iterate over the coordinates of the platform that move."""
    n, moved = len(scene.model.joints), set(scene.model.mechanism.moves)
    r, R = scene.seen[:, n : n + 3], scene.seen[:, n + 3 : n + 12]
    values = {a: r[:, k] for k, a in enumerate("xyz") if a in moved}
    if {"x", "y"} <= moved:
        values["radius"] = np.hypot(r[:, 0], r[:, 1])
    if "rx" in moved:
        values["tilt_x"] = R[:, 7]
    if "ry" in moved:
        values["tilt_y"] = -R[:, 6]
    if "rz" in moved and np.hypot(R[:, 0], R[:, 3]).min() > MIN_LEVEL_PART:
        values["yaw"] = np.arctan2(R[:, 3], R[:, 0])
    for name, column in values.items():
        unit, code = PLACES[name]
        middle = 0.0 if name == "radius" else _round_middle(column)
        yield Driver(name, name, unit, code, column - middle, zero=middle)


# Of all quantities that were recorded or follow from the configuration, in this order.
SOURCES = (_iterate_readings, _iterate_statics, _iterate_conditions, _iterate_places)


def _round_middle(values: np.ndarray) -> float:
    """A round number in the middle of the values, as the zero of powers."""
    middle, spread = float(np.ptp(values) / 2 + values.min()), float(np.ptp(values))
    if spread <= 0:
        return 0.0
    step = 10.0 ** np.floor(np.log10(spread) - 0.5)
    return float(round(middle / step) * step)


def compute_loads(scene: Scene) -> np.ndarray:
    """Load of the payload on each joint (N, nq), N m or N; without columns if it is unknown.

    The masses of the robot's own links are not known; they are zero, as in `joint_compliance`.
    """
    return _compute_forces(scene, joint_forces, needs_weight(scene.model.mechanism))


def compute_tensions(scene: Scene) -> np.ndarray:
    """Tension (N, n_rods) of each rod under the payload, N; without columns if it is unknown."""
    return _compute_forces(scene, rod_forces, needs_rods(scene.model.mechanism))


def compute_stretches(scene: Scene) -> np.ndarray:
    """Stretch of each line by the payload, times EA (N, n_lines), N m; without columns if there are
    no lines or no payload."""
    return _compute_forces(scene, line_stretches, needs_hanging_lines(scene.model.mechanism))


def compute_inclinations(scene: Scene) -> np.ndarray:
    """Sine of the angle of each rod, leg or line with the horizontal (N, n); without columns if
    there are none."""
    unsuitable = needs_legs(scene.model.mechanism)
    return _compute_statics(scene, leg_inclinations, unsuitable, np.zeros(len(scene.seen)))


def compute_moments(scene: Scene) -> dict[int, np.ndarray]:
    """Moment (N,) of the payload's weight about each axis of {B} that it can turn, N m.

    None if the payload is unknown, or constant: it is then a function of the position.
    """
    payload, n = scene.dataset.conditions.get(PAYLOAD), len(scene.model.joints)
    if payload is None or np.ptp(payload) <= ROUNDING:
        return {}
    weight = payload[:, None] * np.array(scene.model.mechanism.gravity)
    moments = np.cross(scene.seen[:, n : n + 3], weight)
    return {axis: moments[:, axis] for axis in range(3) if moments[:, axis].any()}


def _compute_forces(scene: Scene, forces: Callable[..., Any], unsuitable: str) -> np.ndarray:
    """What static forces of the payload are at each sample; without columns if `unsuitable`."""
    payload = scene.dataset.conditions.get(PAYLOAD)
    return _compute_statics(scene, forces, unsuitable, payload)


def _compute_statics(
    scene: Scene, compute: Callable[..., Any], unsuitable: str, payload: np.ndarray | None
) -> np.ndarray:
    """A function of the closure and of the payload (N,) at each sample; without columns if
    `unsuitable` or without a payload."""
    mechanism = scene.model.mechanism
    if payload is None or unsuitable:
        return np.zeros((len(scene.seen), 0))
    ideal = scene.model.structure.ideal
    kinds = masses(mechanism)
    e = Named([kind.name for kind in kinds], ca.SX.zeros(len(kinds)))
    carried = ca.SX.sym("payload")
    seen = Seen(ideal.q, ideal.r, ideal.R, ideal.geometry, ideal.u)
    found = compute(seen, e, Named([PAYLOAD], carried), mechanism)
    z = ca.vertcat(ideal.configuration, ideal.v)
    (values,) = Batch(dense(compute.__name__, (z, carried), (found,)))(scene.seen, payload[:, None])
    return np.asarray(values)
