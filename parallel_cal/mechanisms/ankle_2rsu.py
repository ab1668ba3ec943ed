"""Ankle of a legged robot: two servo cranks with rods move a foot in pitch and roll (2-RSU)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi as ca

from parallel_cal.base.errors import ModelError
from parallel_cal.base.rotation import rot_x, rot_y, rot_z
from parallel_cal.base.units import DEGREE, MM
from parallel_cal.mechanisms._controller import read_one_per_joint, read_switches
from parallel_cal.mechanisms._servo_legs import BODIES, ServoLegs, servo_leg
from parallel_cal.mechanisms._size import read_limits, read_numbers
from parallel_cal.model.drawing import Line, axis
from parallel_cal.model.mechanism import POSE, Home, Workspace
from parallel_cal.model.parameters import Named, Parameter, ParameterTable

MOTORS, CRANK, SIDE, BEHIND, SOLE = (0.25, 0.2), 0.04, 0.035, 0.05, 0.05  # m
ORDERS = {"pitch": ("y", "x"), "roll": ("x", "y")}  # axis of the shank, axis of the foot
LIMIT = 60 * DEGREE


class Ankle2Rsu(ServoLegs):
    """Ankle of a legged robot (2-RSU): two cranks and two rods move the foot in pitch and roll.

    The foot hangs on a universal joint. Its first axis is fixed in the shank, whose frame is {B},
    and its second axis in the foot, whose frame is {P}. The x axis points forwards, y to the left,
    z up. The origin of {B} is the centre of the ankle, that of {P} is on the sole below it.

    - First axis: `a = Rz(a_z) Rx(a_x) (0, 1, 0)` in {B}. Second axis:
      `b = Rz(b_z) Ry(b_y) (1, 0, 0)` in {P}. `ankle.angle` is the angle between them.
    - The axes cross at c in {B} and f in {P}, `r + R f = c + offset n`. `ankle.offset` is their
      distance along the common normal `n = a x R b / sin(angle)`, 0 if they meet.
    - Each leg gives `|r + R B - C| = rod`, as for `stewart_rss`. The cranks turn about axes across
      the leg and point backwards at reading zero. A positive reading raises a crank, and with it
      the heel.

    The foot only turns about the ankle. Readings and poses therefore do not determine how far a leg
    is from it: the same leg with another size moves the foot alike. The lengths of the rods are
    known by default, measure them on the bench.

    Options, in m: `motors`, the heights of the left and the right crank axis above the ankle
    (0.25 and 0.2); `crank` (0.04); `behind` and `side`, the distances of the rods' joints on the
    foot from the ankle, backwards and to each side (0.05 and 0.035); `sole`, the height of the
    ankle above the sole (0.05); `tolerance` of all lengths (0.5 mm). At home the cranks are level
    and the rods vertical, so that their lengths are `motors`. `limits` of the readings in rad
    (-1.05 to 1.05); `first`, the axis that is fixed in the shank: `pitch` (default) or `roll` (then
    `a = Rz(a_z) Ry(a_y) (1, 0, 0)` and `b = Rz(b_z) Rx(b_x) (0, 1, 0)`).

    `switches` (rad) are the readings at which the controller homes the joints (default: the upper
    limits).
    """

    joints = ("left", "right")
    moves = POSE
    controls = ("rx", "ry")
    fixed = ("*.rod",)

    def __init__(
        self,
        motors: Sequence[float] = MOTORS,
        crank: float = CRANK,
        behind: float = BEHIND,
        side: float = SIDE,
        sole: float = SOLE,
        first: str = "pitch",
        limits: Sequence[float] = (-LIMIT, LIMIT),
        tolerance: float = 0.5 * MM,
        switches: Sequence[float] | None = None,
    ):
        stated = {"crank": crank, "behind": behind, "side": side, "sole": sole}
        size = read_numbers({**stated, "tolerance": tolerance}, may_be_zero=("sole",))
        heights = read_one_per_joint("motors", motors, 2, "crank")
        if not min(heights) > 0:
            raise ModelError(f"motors is {motors!r}: expected two heights above 0 m")
        if first not in ORDERS:
            raise ModelError(f"first is {first!r}, expected pitch or roll")
        self.axes = ORDERS[first]
        back, low = -size["behind"], -size["sole"]
        legs = [
            parameter
            for leg, y, z in zip(self.joints, (size["side"], -size["side"]), heights, strict=True)
            for parameter in servo_leg(
                leg,
                hub=(back + size["crank"], y, z),
                direction=180 * DEGREE,
                crank=size["crank"],
                rod=z,
                ball=(back, y, -low),
                tolerance=size["tolerance"],
            )
        ]
        self.parameters = ParameterTable([*self._joint(-low, size["tolerance"]), *legs])
        self.home = Home((0.0, 0.0), (0.0, 0.0, low))
        self.workspace = Workspace((-15 * DEGREE, -25 * DEGREE), (15 * DEGREE, 25 * DEGREE))
        self.joint_limits = (read_limits(limits, "rad"),) * 2
        self.switches = read_switches(switches, 2, "crank")
        self.length = size["behind"]
        self.bodies = {**BODIES, "base": ("*.D_?", "*.c_?"), "platform": ("*.B_?", "*.f_?")}

    def _joint(self, sole: float, tolerance: float) -> list[Parameter]:
        """Make the parameters of the universal joint."""
        shank, foot = self.axes
        points = [("c", zero, f"crossing's {zero} in the shank") for zero in "xyz"]
        points += [("f", zero, f"crossing's {zero} in the foot") for zero in "xyz"]
        lengths = [
            Parameter(f"ankle.{n}_{i}", "m", sole if n + i == "fz" else 0.0, tolerance, label=label)
            for n, i, label in points
        ]
        turns = [
            ("a_z", "first axis' turn about z"),
            (f"a_{foot}", f"first axis' turn about {foot}"),
        ]
        turns += [("b_z", "second axis' turn about z")]
        turns += [(f"b_{shank}", f"second axis' turn about {shank}")]
        return [
            *lengths,
            *[Parameter(f"ankle.{n}", "rad", 0.0, 0.5 * DEGREE, label=label) for n, label in turns],
            Parameter("ankle.angle", "rad", 90 * DEGREE, 0.5 * DEGREE, label="angle of the axes"),
            Parameter("ankle.offset", "m", 0.0, tolerance, label="distance of the axes"),
        ]

    def closure(self, q: Any, r: Any, R: Any, p: Named) -> Any:
        """Compute the length errors of both rods, then the errors of the universal joint: its
        centre (m) and its angle (rad, near 90 degrees)."""
        u = p.ankle
        a, b = self.joint_axes(R, u)
        normal = ca.cross(a, b) / ca.sin(u.angle)
        centre = r + R @ u.vector("f_x", "f_y", "f_z") - u.vector("c_x", "c_y", "c_z")
        rods = self.rod_errors(q, r, R, p)
        return ca.vertcat(rods, centre - u.offset * normal, ca.dot(a, b) - ca.cos(u.angle))

    def joint_axes(self, R: Any, u: Named) -> tuple[Any, Any]:
        """Return the axes of the universal joint in {B}: the one of the shank, that of the foot."""
        tilt = {"x": rot_x, "y": rot_y}
        shank, foot = self.axes
        a = rot_z(u.a_z) @ tilt[foot](u[f"a_{foot}"])[:, "xy".index(shank)]
        b = rot_z(u.b_z) @ tilt[shank](u[f"b_{shank}"])[:, "xy".index(foot)]
        return a, R @ b

    def drawing(self, q: Any, r: Any, R: Any, p: Named) -> list[Line]:
        """Draw the shank, the axes of the ankle, cranks, rods and the foot."""
        u = p.ankle
        c, f = u.vector("c_x", "c_y", "c_z"), r + R @ u.vector("f_x", "f_y", "f_z")
        a, b = self.joint_axes(R, u)
        hubs = [p[leg].vector("D_x", "D_y", "D_z") for leg in self.joints]
        B = self.rod_ends(q, r, R, p)[1]
        return [
            Line("base", (hubs[0], c, hubs[1]), ("*.D_?", "ankle.c_?")),
            axis(c, a, self.length, "ankle.a_?", "ankle.angle"),
            axis(f, b, self.length, "ankle.b_?", "ankle.offset"),
            *self.drawn_legs(q, r, R, p),
            Line("platform", (B[0], f, B[1], B[0]), ("*.B_?",)),
            Line("platform", (f, r), ("ankle.f_?",)),
        ]
