"""Common parts of the Delta models: table, home, workspace, rod pairs (tables 3.10, 5.12)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import casadi as ca
import numpy as np

from parallel_cal.base.errors import ModelError
from parallel_cal.base.units import DEGREE, MM
from parallel_cal.mechanisms._controller import read_switches
from parallel_cal.mechanisms._size import read_limits, read_numbers
from parallel_cal.model.drawing import Line, ring
from parallel_cal.model.mechanism import Home, Mechanism, Workspace
from parallel_cal.model.parameters import Named, Parameter, ParameterTable

Entry = tuple[str, float, float, str]
# name: unit, nominal value (table 5.12), tolerance of a real robot (1 sigma), label.
# In a chain's frame x points outwards, y up and z along the motor's axis (figure 3.9).
POSITION = {
    "D_x": ("m", 76 * MM, 1 * MM, "radius of the base minus that of the platform"),
    "D_y": ("m", -16.5 * MM, 1 * MM, "motor axis' height"),
    "D_z": ("m", 0.0, 1 * MM, "shift along the motor axis"),
    "theta": ("rad", 0.0, 0.5 * DEGREE, "chain's direction about z"),
    "alpha": ("rad", 90 * DEGREE, 0.5 * DEGREE, "motor axis' tilt"),
    "La_x": ("m", 119.963 * MM, 0.5 * MM, "arm length"),
    "La_y": ("m", -3 * MM, 1 * MM, "encoder offset, stated as a length across the arm"),
    "Lb": ("m", 240 * MM, 0.5 * MM, "rod length"),
}


class Delta(Mechanism):
    """Three driven arms that move a platform; common to all Delta models."""

    joints = ("joint1", "joint2", "joint3")
    controls = ("x", "y", "z")
    home = Home(joints=(30.65 * DEGREE,) * 3, position=(0.0, 0.0, 0.2))
    workspace = Workspace(low=(-0.06, -0.06, 0.14), high=(0.06, 0.06, 0.26))
    joint_limits = ((-30 * DEGREE, 135 * DEGREE),) * 3  # section 2.3.2: mechanical stops
    length = 24 * MM  # half the bar of a rod pair

    def __init__(self, switches: Sequence[float] | None = None):
        self.switches = read_switches(switches, len(self.joints))


class SizedDelta(Delta):
    """A Delta whose size may be stated in a few numbers; its subclasses describe the options."""

    def __init__(
        self,
        base: float | None = None,
        platform: float | None = None,
        arm: float | None = None,
        rod: float | None = None,
        direction: float = 0.0,
        home: float | None = None,
        below: bool = False,
        limits: Sequence[float] | None = None,
        switches: Sequence[float] | None = None,
    ):
        super().__init__(switches)
        stated = {"base": base, "platform": platform, "arm": arm, "rod": rod}
        stated = {name: value for name, value in stated.items() if value is not None}
        if not stated and not direction and home is None and not below and limits is None:
            return
        size = {"base": 100 * MM, "platform": 24 * MM, "arm": 120 * MM, "rod": 240 * MM}
        size |= read_numbers(stated, may_be_zero=("platform",))
        side, out = -1 if below else 1, size["base"] - size["platform"]
        numbers = {"D_x": out, "R": out, "D_y": 0.0, "La_y": 0.0, "Lb": size["rod"]}
        numbers |= {"La_x": size["arm"], "La": size["arm"], "b_x": size["platform"]}
        nominal = {f"chain{i + 1}.theta": float(direction) + i * 120 * DEGREE for i in range(3)}
        nominal |= {
            name: numbers[last]
            for name in self.parameters.names
            if (last := name.rpartition(".")[2]) in numbers
        }
        self.parameters = self.parameters.with_nominal(nominal)
        angle = side * Delta.home.joints[0] if home is None else float(home)
        z = find_home_height(size, angle, side)
        self.home = Home(joints=(angle,) * 3, position=(0.0, 0.0, z))
        reach = size["arm"] * np.array([0.4, 0.4, 0.25])
        self.workspace = Workspace.around(np.array([0.0, 0.0, z]), reach)
        low, high = sorted(side * limit for limit in Delta.joint_limits[0])
        self.joint_limits = ((low, high) if limits is None else read_limits(limits, "rad"),) * 3


def find_home_height(size: Mapping[str, float], angle: float, side: int) -> float:
    """Return z (m) of the platform with all arms at `angle` (rad), on the `side` (1 or -1) of the
    elbows; ModelError if the rods do not reach."""
    elbow = size["base"] - size["platform"] + size["arm"] * np.cos(angle)
    drop = size["rod"] ** 2 - elbow**2
    if not drop > 0:
        raise ModelError(
            f"rod is {size['rod']:g} m: too short for the elbows at home, which are "
            f"{abs(elbow):.6g} m from the axis; expected a longer rod, or another angle home"
        )
    return round(float(size["arm"] * np.sin(angle) + side * np.sqrt(drop)), 13)


def chain_parameters(groups: dict[str, dict[str, Entry]], n: int = 3) -> ParameterTable:
    """Make the table of n equal chains all around z (theta is the thesis' vartheta)."""
    return ParameterTable(
        Parameter(
            f"chain{i + 1}.{name}",
            unit,
            nominal + (i * 360 * DEGREE / n if name == "theta" else 0.0),
            tolerance,
            group,
            label=label,
        )
        for i in range(n)
        for group, members in groups.items()
        for name, (unit, nominal, tolerance, label) in members.items()
    )


def pair_errors(rods: tuple[list[Any], list[Any], list[Any]], r: Any, R: Any, p: Named) -> Any:
    """Compute G1 and G2 of eq. 3.12, divided by 2 Lb and Lb, three rows each, in metres.

    They are mean and half difference of the length errors of a rod pair. `rods`: C in {B}, B in {P}
    and length.
    """
    # G1 is half the sum of |CB + dd|^2 and |CB - dd|^2, G2 a quarter of their difference.
    errors = [ca.sumsqr(r + R @ B - C) - L**2 for C, B, L in zip(*rods, strict=True)]
    first, second = ca.vertcat(*errors[::2]), ca.vertcat(*errors[1::2])
    to_metres = 0.25 / ca.vertcat(*[p[f"chain{i + 1}"].Lb for i in range(3)])
    return ca.vertcat((first + second) * to_metres, (first - second) * to_metres)


def rod_pairs(rods: tuple[list[Any], list[Any], list[Any]], r: Any, R: Any) -> list[Line]:
    """Draw the bars of three pairs, their six rods and the platform; `rods` as in `pair_errors`."""
    C, tops = rods[0], [r + R @ B for B in rods[1]]
    lines = []
    for i, k in enumerate((0, 2, 4), start=1):
        own, length = f"chain{i}.", (f"chain{i}.Lb", f"chain{i}.dLb", f"rod{i}?.l")
        lines += [
            Line("driven", (C[k], C[k + 1]), (f"{own}dC_?", f"{own}dalpha", f"{own}dbeta")),
            Line("rod", (C[k], tops[k]), length),
            Line("rod", (C[k + 1], tops[k + 1]), length),
        ]
    return [*lines, ring("platform", tops, "*.b_?", "*.d_?")]


def pair_lengths(p: Named) -> list[Any]:
    """Return Lb + dLb and Lb - dLb of each pair."""
    chains = [p[f"chain{i + 1}"] for i in range(3)]
    return [c.Lb + side * c.dLb for c in chains for side in (1, -1)]
