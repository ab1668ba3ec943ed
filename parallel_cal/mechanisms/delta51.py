"""Delta robot described by the points of its joints: 51 parameters of Savoure et al. (2006, eqs
2-22), and 9 coordinates of the motor axes.

Like model 54, it describes the balls of an arm and of the platform, the lengths of the six rods
and the directions of the motor axes. One rotation per chain (of the arm about its own axis) is in
a_ij and in beta_i, so 48 of the 51 parameters are independent. It does not describe where the motor
axis passes through the base: eq. 13 includes that in the platform points, which is exact only if
the platform does not tilt. This model therefore has those nine coordinates p_i, too, fixed by
default. With them free, it describes the same robots as model 54 (`widen`, `from_delta54`).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import casadi as ca
import numpy as np

from parallel_cal.base.rotation import (
    exponential,
    rot_x,
    rot_y,
    rot_z,
    rotation_matrix,
    rotation_vector,
)
from parallel_cal.base.units import DEGREE, MM
from parallel_cal.mechanisms._delta import Delta, rod_pairs
from parallel_cal.mechanisms.delta54 import Delta54
from parallel_cal.model.closed_form import joint_angles, positions
from parallel_cal.model.drawing import Line, axis, ring
from parallel_cal.model.parameters import Named, Parameter, ParameterTable

# Eq. 10: direction of each motor axis u_i, as in the thesis' mock-up.
THETA = (-90 * DEGREE, 30 * DEGREE, 150 * DEGREE)
RODS = ("11", "12", "21", "22", "31", "32")
XYZ = ("x", "y", "z")
# The thesis' axes of an arm (x outwards, z along the motor axis) written in the paper's
# (u along the motor axis, v outwards, z).
AXES = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


def from_delta54(values: Mapping[str, float]) -> dict[str, float]:
    """Convert parameters of model 54 to joint points, axes and lengths, without loss.

    One rotation per chain is arbitrary. It is chosen so that both models have equal readings q.
    """
    result: dict[str, float] = {}
    for i in (1, 2, 3):
        c = {k.split(".")[1]: v for k, v in values.items() if k.startswith(f"chain{i}.")}
        T = _full(rot_z(c["theta"]) @ rot_x(c["alpha"]))
        axis = T @ _full(rot_x(c["dalpha"]) @ rot_y(c["dbeta"]))
        b, D, dC = (np.array([c[f"{n}_{k}"] for k in XYZ]) for n in ("b", "D", "dC"))
        _put(result, f"chain{i}.p", T @ (b + D))
        _put(result, f"chain{i}.beta", rotation_vector(axis @ AXES.T @ _frame(i).T))
        for j, sign in ((1, 1), (2, -1)):
            half = np.array([0, 0, c["d_z"]])
            arm = np.array([c["La_x"], c["La_y"], 0]) + sign * (half + dC)
            _put(result, f"rod{i}{j}.b", T @ (b + sign * half))
            _put(result, f"rod{i}{j}.a", AXES @ arm)
            result[f"rod{i}{j}.l"] = c["Lb"] + sign * c["dLb"]
    return result


def to_delta54(values: Mapping[str, float]) -> dict[str, float]:
    """Convert to parameters of model 54, without loss."""
    result: dict[str, float] = {}
    for i in (1, 2, 3):
        B1, B2 = _get(values, f"rod{i}1.b"), _get(values, f"rod{i}2.b")
        # theta and alpha turn z along the platform bar, whose half length is d_z.
        half = (B1 - B2) / 2
        theta, near = np.arctan2(half[0], -half[1]), THETA[i - 1] + np.pi / 2
        theta += 2 * np.pi * np.round((near - theta) / (2 * np.pi))
        alpha, d_z = np.arctan2(np.hypot(*half[:2]), half[2]), np.linalg.norm(half)
        T = _full(rot_z(theta) @ rot_x(alpha))
        u = rotation_matrix(_get(values, f"chain{i}.beta")) @ _frame(i)
        # local = Rx(dalpha) Ry(dbeta) Rz(gamma); gamma is an encoder offset, which the arm absorbs.
        local = T.T @ u @ AXES
        dalpha, dbeta = np.arctan2(-local[1, 2], local[2, 2]), np.arcsin(local[0, 2])
        gamma = np.arctan2(-local[0, 1], local[0, 0])
        arms = [_full(rot_z(gamma)) @ AXES.T @ _get(values, f"rod{i}{j}.a") for j in (1, 2)]
        slide, dT = sum(arms)[2] / 2, _full(rot_x(dalpha) @ rot_y(dbeta))
        hub = T.T @ _get(values, f"chain{i}.p") + dT @ np.array([0, 0, slide])
        b, La = T.T @ (B1 + B2) / 2, sum(arms) / 2
        _put(result, f"chain{i}.D", hub - b)
        _put(result, f"chain{i}.b", b)
        _put(result, f"chain{i}.dC", (arms[0] - arms[1]) / 2 - [0, 0, d_z])
        l1, l2 = values[f"rod{i}1.l"], values[f"rod{i}2.l"]
        names = "theta alpha La_x La_y Lb dalpha dbeta dLb d_z".split()
        numbers = [theta, alpha, La[0], La[1], (l1 + l2) / 2, dalpha, dbeta, (l1 - l2) / 2, d_z]
        result |= {f"chain{i}.{n}": float(v) for n, v in zip(names, numbers, strict=True)}
    return result


def _frame(i: int) -> np.ndarray:
    """P_i, the nominal frame (u, v, z) of chain i (eq. 10)."""
    return _full(rot_z(THETA[i - 1]))


def _full(matrix: Any) -> np.ndarray:
    return np.array(ca.DM(matrix))


def _put(result: dict[str, float], name: str, vector: np.ndarray) -> None:
    result |= {f"{name}_{k}": float(v) for k, v in zip(XYZ, vector, strict=True)}


def _get(values: Mapping[str, float], name: str) -> np.ndarray:
    return np.array([values[f"{name}_{k}"] for k in XYZ])


LABELS = {
    "b": "platform ball",
    "a": "arm ball",
    "l": "rod length",
    "beta": "arm's turn",
    "p": "motor axis' centre",
}
NOMINAL = from_delta54(Delta54.parameters.mapping(Delta54.parameters.nominal))


def _label(name: str) -> str:
    """`rod11.b_x` -> `platform ball, x`."""
    kind, _, axis = name.partition(".")[2].partition("_")
    return f"{LABELS[kind]}, {axis}" if axis else LABELS[kind]


def _table() -> ParameterTable:
    """Parameters in the order of eq. 20: platform point, arm point, length of rods; then axes."""
    rods = [f"rod{rod}.{n}" for rod in RODS for n in "b_x b_y b_z a_x a_y a_z l".split()]
    axes = [f"chain{i}.beta_{k}" for i in (1, 2, 3) for k in XYZ]
    base = [f"chain{i}.p_{k}" for i in (1, 2, 3) for k in XYZ]
    return ParameterTable(
        [
            *[Parameter(n, "m", NOMINAL[n], 0.5 * MM, "rods", label=_label(n)) for n in rods],
            *[Parameter(n, "rad", NOMINAL[n], 0.5 * DEGREE, "axes", label=_label(n)) for n in axes],
            *[Parameter(n, "m", NOMINAL[n], 1 * MM, "base", label=_label(n)) for n in base],
        ]
    )


BODIES = {
    "arms": ("*.a_?",),
    "rods": ("*.l",),
    "base": ("chain*.p_?", "rod*.b_?"),  # base and platform, as in model 54
}


class Delta51(Delta):
    """Delta robot, described by the end points of its six rods on the arms and on the platform.

    It has the 51 parameters of Savoure et al. (2006), and nine coordinates of the motor axes that
    are fixed by default. Position and orientation of the platform vary.

    Options: `switches` (rad), the readings at which the controller homes the joints (default: the
    upper limits).
    """

    parameters = _table()
    # An almost level platform hides the hubs, each arm's rotation about its axis, and shifts of a
    # rod along that axis. 42 parameters stay free, as in model 54.
    fixed = ("chain*.p_*", "rod*.a_x", "chain1.beta_y", "chain2.beta_x", "chain3.beta_x")
    bodies = BODIES

    def closure(self, q: Any, r: Any, R: Any, p: Named) -> Any:
        """Compute (|A B|^2 - l^2) / 2l of each rod (eq. 2), in metres."""
        return ca.vertcat(*[self._rod(rod, q, r, R, p) for rod in RODS])

    def rods(self, q: Any, p: Named) -> tuple[list[Any], list[Any], list[Any]]:
        """Return the six rods' ends in {B} and in {P}, (3, 1) each, and their lengths."""
        A, b, length = zip(*[self._ends(rod, q, p) for rod in RODS], strict=True)
        return list(A), list(b), list(length)

    def _rod(self, rod: str, q: Any, r: Any, R: Any, p: Named) -> Any:
        A, b, length = self._ends(rod, q, p)
        AB = r + R @ b - A
        return (ca.dot(AB, AB) - length**2) / (2 * length)

    @staticmethod
    def _ends(rod: str, q: Any, p: Named) -> tuple[Any, Any, Any]:
        """A_ij = p_i + exp(beta_i) P_i Q_i a_ij, b_ij and l_ij (eqs 6-11)."""
        i, c, k = int(rod[0]), p[f"chain{rod[0]}"], p[f"rod{rod}"]
        turn = exponential(c.vector("beta_x", "beta_y", "beta_z")) @ rot_z(THETA[i - 1])
        a, b = k.vector("a_x", "a_y", "a_z"), k.vector("b_x", "b_y", "b_z")
        return c.vector("p_x", "p_y", "p_z") + turn @ (rot_x(q[i - 1]) @ a), b, k.l

    def candidates(self, q: Any, p: Named) -> list[tuple[Any, Any]]:
        """Find both positions at which the pairs close on average, with a parallel platform."""
        return [(r, ca.DM.eye(3)) for r in positions(_Middle(), q, p)]

    def joint_candidates(self, r: Any, R: Any, p: Named) -> list[tuple[Any, ...]]:
        """Find both angles of each joint at which its two rods close on average."""
        return joint_angles(_Middle(), r, R, p)

    def drawing(self, q: Any, r: Any, R: Any, p: Named) -> list[Line]:
        """Draw motor axes, arms to the rods' balls, six rods and the platform."""
        rods, lines = self.rods(q, p), []
        chains = [p[f"chain{i}"] for i in (1, 2, 3)]
        hubs = [c.vector("p_x", "p_y", "p_z") for c in chains]
        for i, (hub, c) in enumerate(zip(hubs, chains, strict=True)):
            turn = exponential(c.vector("beta_x", "beta_y", "beta_z")) @ rot_z(THETA[i])
            one, other = rods[0][2 * i : 2 * i + 2]
            lines += [
                axis(hub, turn[:, 0], self.length, f"chain{i + 1}.beta_?"),
                Line("driven", (one, hub, other), (f"rod{i + 1}?.a_?",)),
            ]
        return [ring("base", hubs, "*.p_?"), *lines, *rod_pairs(rods, r, R)]

    def rod_lengths(self, p: Named) -> list[Any]:
        return [p[f"rod{rod}"].l for rod in RODS]

    def widen(self, values: Mapping[str, float]) -> tuple[str, dict[str, float]]:
        """Model 54 describes every robot that this model describes."""
        return "delta54", to_delta54(values)


class _Middle(Delta51):
    """The mean of each pair's two rows: three spheres if the platform does not tilt."""

    def closure(self, q: Any, r: Any, R: Any, p: Named) -> Any:
        return ca.vertcat(
            *[
                (self._rod(f"{i}1", q, r, R, p) + self._rod(f"{i}2", q, r, R, p)) / 2
                for i in (1, 2, 3)
            ]
        )
