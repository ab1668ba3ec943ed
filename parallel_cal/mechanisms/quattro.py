"""Delta with four arms and an articulated platform that turns about z (Par4), 37 parameters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import casadi as ca
import numpy as np

from parallel_cal.base.rotation import rot_x, rot_z
from parallel_cal.base.units import DEGREE, MM
from parallel_cal.mechanisms._controller import read_switches
from parallel_cal.mechanisms._delta import POSITION, chain_parameters, find_home_height
from parallel_cal.mechanisms._size import read_limits, read_numbers
from parallel_cal.mechanisms.delta24 import Delta24
from parallel_cal.model.closed_form import joint_angles
from parallel_cal.model.drawing import Line, axis, ring
from parallel_cal.model.mechanism import Home, Mechanism, Workspace
from parallel_cal.model.parameters import Named, Parameter, ParameterTable

SIZE = {"base": 0.275, "platform": 0.1, "arm": 0.35, "rod": 0.8, "bar": 0.12, "gear": 1.0}
CHAINS = ("chain1", "chain2", "chain3", "chain4")
HALVES = ("a", "a", "b", "b")  # the half of the platform that a chain carries
BODIES = {
    "arms": ("*.La_?",),
    "rods": ("*.Lb",),
    "base": ("*.D_?",),
    "platform": ("platform.a_?", "platform.b_?"),
}


class Quattro(Mechanism):
    """Delta with four arms whose articulated platform also turns about z (Par4, Quattro).

    The platform consists of two halves, which two parallel bars connect. Chains 1 and 2 carry one
    half, chains 3 and 4 the other one. The halves cannot rotate. If one is moved relative to the
    other, the bars turn, and with them the tool. Each parallelogram acts as one rod, and each chain
    gives one equation, `|r + Rz(w / gear) h - C| = Lb`.

    - C is the end of the arm, as for `delta24`: `C = T (D + Rz(q) (La_x, La_y, 0))` with
      `T = Rz(theta) Rx(alpha)`. D is the vector to the motor axis from the rods' joint on the
      platform's half, moved so that the hinge of this half is at the origin.
    - h is the hinge of the half, in {P}: `platform.a_x`, `platform.a_y` for chains 1 and 2,
      `platform.b_x`, `platform.b_y` for chains 3 and 4. w is the rotation of the tool about z.
    - `platform.gear` are the turns of the tool per turn of the bars. It is counted, not measured,
      and therefore fixed.

    Options, in m: `base` and `platform`, the distances of the motor axes and of the rods' joints
    on the platform from the centre (0.275 and 0.1); `arm` and `rod`, the lengths (0.35 and 0.8);
    `bar`, the distance of the hinges of the two halves (0.12). `gear` (1); `direction` of the first
    motor about z in rad, measured from x (0.785), the others follow at 90, 180 and 270 degrees;
    `home`, the angle in rad of all arms at home, positive towards +z (-0.35); `limits` of these
    angles in rad (-1.75 to 0.87). The platform is on the -z side of the arms. Home and workspace
    follow from the size.

    `switches` (rad) are the readings at which the controller homes the joints (default: the upper
    limits).
    """

    joints = ("joint1", "joint2", "joint3", "joint4")
    moves = controls = ("x", "y", "z", "rz")
    fixed = ("platform.gear",)
    closed_forms = ("inverse",)
    bodies = BODIES
    parts = ("arm", "rod")

    def __init__(
        self,
        base: float = SIZE["base"],
        platform: float = SIZE["platform"],
        arm: float = SIZE["arm"],
        rod: float = SIZE["rod"],
        bar: float = SIZE["bar"],
        gear: float = SIZE["gear"],
        direction: float = 45 * DEGREE,
        home: float = -20 * DEGREE,
        limits: Sequence[float] = (-100 * DEGREE, 50 * DEGREE),
        switches: Sequence[float] | None = None,
    ):
        stated = {"base": base, "platform": platform, "arm": arm, "rod": rod, "bar": bar}
        size = read_numbers({**stated, "gear": gear}, may_be_zero=("platform",))
        angle, turn = float(home), float(direction)
        # The bars lie across the direction from half to half: else the tool would not turn.
        across = turn + 45 * DEGREE
        half = size["bar"] / 2 * np.array([np.cos(across), np.sin(across)])
        nominal = {"La_x": size["arm"], "La_y": 0.0, "Lb": size["rod"], "D_y": 0.0}
        numbers = {f"{c}.{name}": value for c in CHAINS for name, value in nominal.items()}
        for i, (chain, side) in enumerate(zip(CHAINS, (1, 1, -1, -1), strict=True)):
            theta = turn + i * 90 * DEGREE
            out, left = np.array([np.cos(theta), np.sin(theta)]), [-np.sin(theta), np.cos(theta)]
            numbers |= {
                f"{chain}.theta": theta,
                f"{chain}.D_x": round(
                    float(size["base"] - size["platform"] + side * half @ out), 13
                ),
                f"{chain}.D_z": round(float(-side * half @ left), 13) + 0.0,
            }
        hinges = [
            Parameter(
                f"platform.{name}_{axis}",
                "m",
                round(float(side * value), 13) + 0.0,
                0.2 * MM,
                label=f"hinge of the half of chains {pair}: {axis}",
            )
            for name, side, pair in (("a", 1, "1 and 2"), ("b", -1, "3 and 4"))
            for axis, value in zip("xy", half, strict=True)
        ]
        gearing = Parameter("platform.gear", "1", size["gear"], 1e-3 * size["gear"], label="gear")
        chains = chain_parameters({"position": POSITION}, 4).with_nominal(numbers)
        self.parameters = ParameterTable([*chains, *hinges, gearing])
        z = find_home_height(size, angle, -1)
        self.home = Home(joints=(angle,) * 4, position=(0.0, 0.0, z))
        reach = size["arm"] * np.array([0.4, 0.4, 0.25])
        swing = 30 * DEGREE * size["gear"]
        self.workspace = Workspace.around(np.array([0.0, 0.0, z]), reach, (swing,))
        self.joint_limits = (read_limits(limits, "rad"),) * 4
        self.switches = read_switches(switches, 4)
        self.length = size["bar"] / 2

    def closure(self, q: Any, r: Any, R: Any, p: Named) -> Any:
        """Compute (|B - C|^2 - Lb^2) / 2 Lb: length error of each rod, in metres."""
        hinges = self.hinges(r, R, p)
        return ca.vertcat(
            *[
                Delta24.rod(q[i], hinges[half], p[chain])
                for i, (chain, half) in enumerate(zip(CHAINS, HALVES, strict=True))
            ]
        )

    @staticmethod
    def hinges(r: Any, R: Any, p: Named) -> dict[str, Any]:
        """Return the hinges (3, 1) of both halves in {B}."""
        u = p.platform
        turned = rot_z(ca.atan2(R[1, 0], R[0, 0]) / u.gear)
        return {h: r + turned @ ca.vertcat(u[f"{h}_x"], u[f"{h}_y"], 0) for h in "ab"}

    def rod_ends(self, q: Any, r: Any, R: Any, p: Named) -> list[tuple[Any, Any, Any]]:
        """Return hub, C and B (3, 1) of each chain in {B}, with the motor axes moved inwards by
        the size of the platform."""
        hinges = self.hinges(r, R, p)
        return [
            (*Delta24.arm(q[i], p[chain]), hinges[half])
            for i, (chain, half) in enumerate(zip(CHAINS, HALVES, strict=True))
        ]

    def rod_lengths(self, p: Named) -> list[Any]:
        """Return Lb for both rods of each pair."""
        return [p[chain].Lb for chain in CHAINS for _ in range(2)]

    def centres(self, q: Any, r: Any, R: Any, p: Named) -> Mapping[str, list[Any]]:
        """Return the middles of arms and rods, up to constant shifts."""
        parts = self.rod_ends(q, r, R, p)
        rods = [(C + B) / 2 for _, C, B in parts for _ in range(2)]
        return {"arm": [(hub + C) / 2 for hub, C, _ in parts], "rod": rods}

    def drawing(self, q: Any, r: Any, R: Any, p: Named) -> list[Line]:
        """Draw motor axes, arms, rods, and the bar between both halves; the halves have no size."""
        parts, lines = self.rod_ends(q, r, R, p), []
        for chain, (hub, C, B) in zip(CHAINS, parts, strict=True):
            c = p[chain]
            along = (rot_z(c.theta) @ rot_x(c.alpha))[:, 2]
            lines += [
                axis(hub, along, self.length, f"{chain}.theta", f"{chain}.alpha"),
                Line("driven", (hub, C), (f"{chain}.La_?",)),
                Line("rod", (C, B), (f"{chain}.Lb",)),
            ]
        ends = self.hinges(r, R, p)
        return [
            ring("base", [hub for hub, _, _ in parts], "*.D_?"),
            *lines,
            Line("platform", (ends["a"], r), ("platform.a_?",)),
            Line("platform", (r, ends["b"]), ("platform.b_?",)),
        ]

    def joint_candidates(self, r: Any, R: Any, p: Named) -> list[tuple[Any, ...]]:
        """Find both solutions of each joint-angle problem (eqs 6.27-6.30)."""
        return joint_angles(self, r, R, p)
