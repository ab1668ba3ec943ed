"""Delta printers as firmwares compute them, and the corresponding mechanisms.

All values are in SI units.

- Linear: the height of carriage i is
  z + tilt . (x, y) + sqrt(L_i^2 - |(x, y) - tower_i|^2) + zero_i.
- Rotary: arm i of length U_i is turned up by t from the horizontal, and a rod of length L_i joins
  its end to the effector: (dx cos t + dz sin t) 2 U = L^2 - U^2 - dx^2 - dz^2 - y^2, with the elbow
  outwards.

Sources: Duet documentation, "Configuring RepRapFirmware for a delta printer" and "M669";
Klipper documentation, "Configuration reference", "Delta calibration".
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike

from parallel_cal.base.errors import DatasetError
from parallel_cal.base.units import DEGREE, MM
from parallel_cal.importing.controller_files import ConfiguredRobot
from parallel_cal.importing.reach import shrink_workspace
from parallel_cal.importing.settings import Settings
from parallel_cal.model.mechanism import Home, Mechanism, Workspace
from parallel_cal.model.model import Model, new_model
from parallel_cal.model.shelf import load_mechanism, load_sensor
from parallel_cal.recordings.configuration import END_STOP
from parallel_cal.recordings.recording import Array

JOINT_NAMES = ("joint1", "joint2", "joint3")
HOME_HEIGHT_M = 0.05  # m above the bed; the middle of the used height
USED_HEIGHT_M = 2 * HOME_HEIGHT_M  # above the bed
BELOW_HOMED = 30 * DEGREE  # of a hanging rotary Delta's arms in the middle of its workspace
HANGING_ANGLES = np.radians([270.0, 30.0, 150.0])  # of the motors of LinuxCNC and grblHAL
SIDE = float(np.tan(30 * DEGREE)) / 2  # distance of a triangle's side from its centre, per side
MAX_STEPS = 50  # of Newton's method; three are usual
STEPS_PER_SLOPES = 5  # the slopes hardly change over a step
CLOSE = 1e-10  # m; a smaller step has converged
DIFFERENCE = 1e-6  # m, for slopes of the firmware's formula
FLAT = 1e-6  # twice the area of a triangle on the unit circle; a smaller one has no orientation
NOT_STATED = (
    "inclinations of towers or motors, errors between the two rods of a pair "
    "and the size of the effector have no number in the firmware: they have "
    "the mechanism's nominal values"
)
ANGLES_UP = (
    "the model counts the angles of the arms upwards from the horizontal, {} downwards: a joint "
    "reading of the model is -1 times that of the controller (factor: -1 in a column map)"
)
PROBE_NOISE_UNKNOWN = (
    "the probe's noise is not stated, so a fit estimates it from the residuals. To state it, touch "
    "one place ten times and give the standard deviation in m (--sensor 'probe: {sigma: 5.0e-6}', "
    "or in the model file under sensors)"
)


class Formula(Protocol):
    """The inverse kinematics of a firmware with three motors."""

    def joints(self, r: Array, R: Array) -> Array:
        """Return motors (N, 3) in m or rad for poses r (N, 3), R (N, 3, 3); NaN out of reach."""


class Delta(Protocol):
    """A delta printer as configured."""

    @property
    def joint_unit(self) -> str:
        """The unit of its joints, m or rad."""

    @property
    def homed(self) -> Array:
        """Joints (3,) at the end-stops."""

    def joints(self, r: Array, R: Array | None = None) -> Array:
        """Return joints (N, 3) in m or rad for the nozzle at r (N, 3); NaN out of reach."""

    @property
    def step(self) -> Array | None:
        """By how much (3,) one step moves a joint, in m or rad; None if it is not known."""

    def mechanism(self) -> Mechanism:
        """Return the mechanism with these numbers."""

    @property
    def nominal(self) -> dict[str, float]:
        """These numbers by the names of the mechanism's parameters."""

    @property
    def usual_reach(self) -> float:
        """The radius (m) around the middle that is used, if the configuration does not state it."""


def count_steps(scale: Array | None) -> dict[str, Array | None]:
    """Return what `Towers` states of a firmware whose scale counts steps."""
    return {"scale": scale, "step": None if scale is None else 1 / scale}


@dataclass(frozen=True)
class Towers:
    """A linear Delta; `first` and `trim` give the towers' angles (rad), `end_stops` the joints.

    `scale` is how many steps or turns of its motor the firmware counts for 1 m of a carriage, if it
    states this, `step` the length of a step. With the scale with which joints were `recorded`, the
    joints are the readings that the same steps had then. Without it, they are heights of the
    carriages.

    `limits` are those of the joints (m), by default from 0.1 m below 0 to the end-stops. The `box`
    is the workspace, by default from z = 0 upwards.
    """

    radius: Array
    rods: Array
    trim: Array
    end_stops: Array
    first: float = 210 * DEGREE
    tilt: tuple[float, float] = (0.0, 0.0)
    zero: tuple[float, float, float] = (0.0, 0.0, 0.0)
    reach: float | None = None
    scale: Array | None = None
    recorded: Array | None = None
    limits: tuple[tuple[float, float], ...] | None = None
    box: Workspace | None = None
    step: Array | None = None

    @classmethod
    def of(
        cls, radius: ArrayLike, rods: ArrayLike, trim: ArrayLike, heights: ArrayLike, **more: Any
    ) -> Towers:
        """Return the Delta of a firmware's numbers in mm and degrees.

        `heights` (mm) are the nozzle's heights by the firmware when one tower is at its end-stop
        and the nozzle is on the axis.
        """
        out, long = np.broadcast_to(radius, 3) * MM, np.asarray(rods) * MM
        tops = np.asarray(heights) * MM + np.sqrt(long**2 - out**2)
        return cls(out, long, np.asarray(trim) * DEGREE, tops, **more)

    @property
    def joint_unit(self) -> str:
        return "m"

    @property
    def heights(self) -> Array:
        """The heights (m) that `of` takes."""
        return self.end_stops - np.sqrt(self.rods**2 - self.radius**2)

    @cached_property
    def readings_per_height(self) -> Array:
        """Readings (3,) of the recording per height of a carriage."""
        if self.scale is None or self.recorded is None:
            return np.ones(3)
        return self.scale / self.recorded

    @property
    def homed(self) -> Array:
        return self.end_stops * self.readings_per_height

    @cached_property
    def towers(self) -> Array:
        """Positions (3, 2) of the towers, m."""
        around = self.first + np.arange(3) * 120 * DEGREE + self.trim
        return np.column_stack([self.radius * np.cos(around), self.radius * np.sin(around)])

    def joints(self, r: Array, R: Array | None = None) -> Array:
        away = ((r[:, None, :2] - self.towers) ** 2).sum(axis=2)
        with np.errstate(invalid="ignore"):
            up = np.sqrt(self.rods**2 - away)
        heights = (r[:, 2] + r[:, :2] @ np.array(self.tilt))[:, None] + up + np.array(self.zero)
        return np.asarray(heights * self.readings_per_height)

    @property
    def nominal(self) -> dict[str, float]:
        found: dict[str, float] = {}
        for i in range(3):
            found |= {
                f"chain{i + 1}.D_x": self.radius[i] * np.cos(self.trim[i]),
                f"chain{i + 1}.D_y": self.radius[i] * np.sin(self.trim[i]),
                f"chain{i + 1}.D_z": -self.zero[i],
                f"chain{i + 1}.Lb": self.rods[i],
            }
        return found

    @property
    def usual_reach(self) -> float:
        """Radius (m) of the workspace."""
        return self.reach or 0.6 * float(self.radius.mean())

    def mechanism(self) -> Mechanism:
        limits = self.limits or tuple((-0.1, float(top)) for top in self.end_stops)
        stated = {} if self.scale is None else {"scale": self.scale.tolist()}
        stated |= _state_switches(self.end_stops, limits)
        mechanism = load_mechanism("linear_delta", direction=self.first, **stated)
        mechanism.parameters = mechanism.parameters.with_nominal(self.nominal)
        mechanism.joint_limits = limits
        return _set_home(mechanism, self, self.box or make_box(self.usual_reach))


@dataclass(frozen=True)
class Shoulders:
    """A rotary Delta; `angles` (rad) are the directions of its motors about z.

    `switches` (3,) are its joints at the end-stops (rad), by default the upper limits. The `box` is
    its workspace; without it, there is a bed at z = 0. `step` is the angle of a step, if it is
    known.
    """

    radius: float
    heights: Array
    arms: Array
    rods: Array
    angles: Array
    limits: tuple[tuple[float, float], ...] = ((-np.pi / 2, np.pi / 2),) * 3
    reach: float | None = None
    switches: Array | None = None
    box: Workspace | None = None
    step: Array | None = None

    @property
    def joint_unit(self) -> str:
        return "rad"

    @property
    def homed(self) -> Array:
        return np.array(self.limits)[:, 1] if self.switches is None else self.switches

    def joints(self, r: Array, R: Array | None = None) -> Array:
        cos, sin = np.cos(self.angles), np.sin(self.angles)
        out, across = r[:, :1] * cos + r[:, 1:2] * sin, r[:, 1:2] * cos - r[:, :1] * sin
        dx, dz = self.radius - out, self.heights - r[:, 2:]
        away = np.hypot(dx, dz)
        k = (self.rods**2 - self.arms**2 - away**2 - across**2) / (2 * self.arms)
        with np.errstate(invalid="ignore"):
            return np.arctan2(dz, dx) - np.arccos(k / away)

    @property
    def nominal(self) -> dict[str, float]:
        found: dict[str, float] = {}
        for i in range(3):
            found |= {
                f"chain{i + 1}.D_x": self.radius,
                f"chain{i + 1}.D_y": self.heights[i],
                f"chain{i + 1}.theta": self.angles[i],
                f"chain{i + 1}.La_x": self.arms[i],
                f"chain{i + 1}.La_y": 0.0,
                f"chain{i + 1}.Lb": self.rods[i],
            }
        return found

    @property
    def usual_reach(self) -> float:
        """Radius (m) of the workspace."""
        return self.reach or 0.6 * float(self.arms.min())

    def mechanism(self) -> Mechanism:
        mechanism = load_mechanism("delta24", **_state_switches(self.homed, self.limits))
        mechanism.parameters = mechanism.parameters.with_nominal(self.nominal)
        mechanism.joint_limits = self.limits
        return _set_home(mechanism, self, self.box or make_box(self.usual_reach))


def hang_shoulders(
    radius: float, arm: float, rod: float, homed: Array, unreachable: DatasetError
) -> Shoulders:
    """Return a rotary Delta with equal chains, which hangs below the plane z = 0 of its motors.

    `homed` (3,) are its joints at the end-stops (rad). Raise `unreachable` if the rods are too
    short for the middle of the workspace.
    """
    same, limits = np.ones(3), tuple((-np.pi / 2, float(top)) for top in homed)
    hung = Shoulders(radius, 0 * same, arm * same, rod * same, HANGING_ANGLES, limits)
    return place_below(hung, homed - BELOW_HOMED, unreachable)


def place_below(hung: Shoulders, middle: Array, unreachable: DatasetError) -> Shoulders:
    """Return a hanging Delta whose workspace is about the joints `middle` (3,) rad.

    Raise `unreachable` if its rods are too short for them.
    """
    z = float(np.mean(heights_on_axis(hung, middle)))
    if np.isnan(z):
        raise unreachable
    arm = float(hung.arms.min())
    return replace(hung, box=make_box(hung.usual_reach, z - arm / 4, z + arm / 4))


def heights_on_axis(hung: Shoulders, joints: Array) -> Array:
    """Return the heights (3,) m at which each arm (rad) holds the end point on the axis, below the
    arms; NaN where it does not reach."""
    out, up = hung.radius + hung.arms * np.cos(joints), hung.arms * np.sin(joints)
    with np.errstate(invalid="ignore"):
        return np.asarray(hung.heights + up - np.sqrt(hung.rods**2 - out**2))


def make_box(reach: float, low: float = 0.0, high: float = USED_HEIGHT_M) -> Workspace:
    """Return the workspace in a circle of radius `reach` between two heights (m)."""
    side = reach / 2**0.5
    return Workspace((-side, -side, low), (side, side, high))


def _state_switches(homed: Array, limits: Sequence[tuple[float, float]]) -> dict[str, list[float]]:
    """Return the option `switches` of joints that are not homed at their upper limits."""
    at_tops = np.array_equal(homed, [high for _, high in limits])
    return {} if at_tops else {"switches": homed.tolist()}


def compute_positions(formula: Formula, motors: Array, near: Array) -> Array:
    """Return the nozzle's positions (N, 3) in m by a firmware's formula with its motors (N, 3).

    `near` (N, 3) are starting values. NaN if the formula has no solution for these motors.
    """
    aside = DIFFERENCE * np.eye(3)[:, None]
    r, turns = np.array(near, float), np.broadcast_to(np.eye(3), (3 * len(near), 3, 3))
    R = turns[: len(near)]
    for k in range(MAX_STEPS):
        here = formula.joints(r, R)
        if k % STEPS_PER_SLOPES == 0:
            ahead = formula.joints((r + aside).reshape(-1, 3), turns).reshape(3, -1, 3)
            slopes = ((ahead - here) / DIFFERENCE).transpose(1, 2, 0)
            bad = ~np.isfinite(slopes).all(axis=(1, 2))
            slopes[bad] = np.eye(3)
            inverse = np.linalg.inv(slopes)
            inverse[bad] = np.nan
        step = np.einsum("nij,nj->ni", inverse, here - motors)
        r = r - step
        if not (np.abs(step) > CLOSE).any():
            return r
    return np.where(np.abs(step).max(axis=1, keepdims=True) > CLOSE, np.nan, r)


def end_stops(delta: Delta) -> dict[str, float]:
    """Return the joints at the end-stops as numbers of a Dataset's `configuration`.

    They are all that joints depend on if the controller counted the steps from the end-stops.
    """
    names = [name + END_STOP for name in JOINT_NAMES]
    return dict(zip(names, map(float, delta.homed), strict=True))


def are_counter_clockwise(angles: Array) -> bool:
    """Return whether three directions (rad about z) are counter-clockwise seen from above."""
    steps = np.roll(angles, -1) - angles
    return bool(np.sin(steps).sum() > FLAT)  # twice the area of the triangle on a unit circle


def check_reach(delta: Delta, stated: Settings, field: str) -> None:
    """Raise DatasetError at a field if the arms do not reach the middle of the bed."""
    if np.isnan(delta.joints(np.array([[0.0, 0.0, HOME_HEIGHT_M]]))).any():
        raise stated.error(
            field, f"lengths that reach {HOME_HEIGHT_M / MM:.0f} mm above the centre of the bed"
        )


def _set_home(mechanism: Mechanism, delta: Delta, box: Workspace) -> Mechanism:
    """Place home on the axis at half the height of a workspace, which shrinks to what the joints
    reach inside their limits."""
    height = (box.low[2] + box.high[2]) / 2
    at = np.array([0.0, 0.0, height])
    home = delta.joints(at[None])[0]
    mechanism.home = Home(tuple(map(float, home)), (0.0, 0.0, height))
    limits = np.array(mechanism.joint_limits)
    mechanism.workspace = shrink_workspace(box, at, delta.joints, limits)
    return mechanism


def make_configured_robot(
    delta: Delta,
    tip: Array,
    plate: tuple[float, float] = (0.0, 0.0),
    remarks: Sequence[str] = (),
    bed: float = 0.0,
) -> ConfiguredRobot:
    """Return the model of a printer with a probe and a bed.

    `tip` is the probe's tip in {P} (m). The bed is the plane z = bed + plate . (x, y).
    """
    at = {"tip": tuple(map(float, tip))} if np.any(tip) else {}
    probe = load_sensor("probe", height=bed, sigma=None, **at)
    model: Model = new_model(delta.mechanism(), sensors=[probe])
    values = model.values.copy()
    for axis, slope in (("rx", plate[1]), ("ry", -plate[0])):
        values[model.table.index_of(f"probe.plate.{axis}")] = slope
    return ConfiguredRobot(model.with_values(values), (NOT_STATED, *remarks), delta)
