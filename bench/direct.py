"""Direct and inverse problem: ours beside scipy's fsolve and a vectorised NumPy Newton.

All solve the same robot (table 5.18) at the same poses, and must agree before they are timed.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any

import numpy as np
from timing import Row, seconds_each, show

sys.path.insert(0, str(Path(__file__).parents[1] / "test"))
import virtual_robot as vr

from parallel_cal.compiled import Batch, Single, compiled
from parallel_cal.kinematics import Kinematics
from parallel_cal.model import Model, new_model
from parallel_cal.solvers.newton import newton_functions

N = 100_000


class NumpyNewton:
    """The hand-written peer: closure and its derivative for arrays of poses (eq. 3.12)."""

    def __init__(self, model: Model):
        self._p = model.table.mapping(model.values)

    def residual(self, q: np.ndarray, r: np.ndarray, R: np.ndarray) -> tuple[np.ndarray, ...]:
        rows, J = np.empty((len(q), 6)), np.empty((len(q), 6, 6))
        for i in range(3):
            c = {k.split(".")[1]: v for k, v in self._p.items() if k.startswith(f"chain{i + 1}.")}
            T = _turn(2, c["theta"]) @ _turn(0, c["alpha"])
            dT = _turn(0, c["dalpha"]) @ _turn(1, c["dbeta"])
            b, d = np.array([c["b_x"], c["b_y"], c["b_z"]]), np.array([0, 0, c["d_z"]])
            D = np.array([c["D_x"], c["D_y"], c["D_z"]])
            Q = _turns_z(q[:, i])
            La, dC = (
                np.array([c["La_x"], c["La_y"], 0]),
                np.array([c["dC_x"], c["dC_y"], c["dC_z"]]),
            )
            Tb, Td = R @ (T @ b), R @ (T @ d)
            CB = r + Tb - T @ (b + D) - (Q @ La) @ (T @ dT).T
            dd = Td - (d + Q @ dC) @ (T @ dT).T
            L, dL = c["Lb"], c["dLb"]
            rows[:, i] = (np.sum(CB**2 + dd**2, axis=1) - L**2 - dL**2) / (2 * L)
            rows[:, 3 + i] = (np.sum(CB * dd, axis=1) - L * dL) / L
            J[:, i, :3], J[:, 3 + i, :3] = CB / L, dd / L
            J[:, i, 3:] = (np.cross(Tb, CB) + np.cross(Td, dd)) / L
            J[:, 3 + i, 3:] = (np.cross(Tb, dd) + np.cross(Td, CB)) / L
        return rows, J

    def solve(self, q: np.ndarray, r: np.ndarray, iterations: int = 3) -> np.ndarray:
        R = np.broadcast_to(np.eye(3), (len(q), 3, 3))
        for _ in range(iterations):
            rows, J = self.residual(q, r, R)
            step = -np.linalg.solve(J, rows[:, :, None])[:, :, 0]
            r, R = r + step[:, :3], vr.turn(step[:, 3:]) @ R
        return r


def _turn(axis: int, angle: float) -> np.ndarray:
    return vr.turn(angle * np.eye(3)[axis][None])[0]


def _turns_z(angle: np.ndarray) -> np.ndarray:
    return vr.turn(angle[:, None] * np.array([0.0, 0, 1]))


def fsolve_peer(newton: NumpyNewton, q: np.ndarray, start: np.ndarray) -> Any:
    """scipy's fsolve with finite differences, as most people would write it."""
    from scipy.optimize import fsolve

    def residual(u: np.ndarray) -> np.ndarray:
        return newton.residual(q[None], u[None, :3], vr.turn(u[None, 3:]))[0][0]

    return lambda: fsolve(residual, np.concatenate([start, np.zeros(3)]), xtol=1e-12)


def buffer_rows(model: Model, problem: str, name: str, given: np.ndarray) -> list[Row]:
    """Single and batch solves through the compiled function's buffer."""
    functions = newton_functions(model.structure, problem)
    k = Single(functions.tables)(model.values)[0]
    rows = []
    for label, f in (
        ("virtual machine", functions.solve),
        ("compiled C", compiled(functions.solve)),
    ):
        single, batch = Single(f), Batch(f)
        arguments = (given[0], np.zeros(0), k)
        single(*arguments)
        rows.append(Row(f"{name}, {label}, buffer", seconds_each(single._evaluate)))
        many = (given, np.zeros((len(given), 0)), k)
        seconds = seconds_each(lambda b=batch, a=many: b(*a), least=3) / len(given)
        rows.append(Row(f"{name}, {label}, batch of {len(given)}", seconds))
    return rows


def public_rows(kinematics: Kinematics, q: np.ndarray, r: np.ndarray, name: str) -> list[Row]:
    return [
        Row(f"{name} direct, public call", seconds_each(lambda: kinematics.direct(q))),
        Row(f"{name} inverse, public call", seconds_each(lambda: kinematics.inverse(r))),
    ]


def main() -> None:
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    rows: list[Row] = []
    for name in ("delta54", "delta24"):
        names = new_model(name).table.names
        model = new_model(name, {k: v for k, v in vr.TABLE_5_18.items() if k in names})
        kinematics = Kinematics(model, compile=True)
        r = model.mechanism.sample(N, np.random.default_rng(0))
        answer = kinematics.inverse(r)
        q = answer.joints
        flat = np.concatenate([q, r, answer.rotation.reshape(-1, 9)], axis=1)
        for problem in ("direct", "inverse"):
            rows += buffer_rows(model, problem, f"{name} {problem}", flat)
        rows += public_rows(kinematics, q[0], r[0], name)
        if name == "delta54":
            newton = NumpyNewton(model)
            start = r + [1e-3, -1e-3, 1e-3]
            assert np.abs(newton.solve(q, start, 4) - r).max() < 1e-9
            peer = fsolve_peer(newton, q[0], start[0])
            assert np.abs(peer()[:3] - r[0]).max() < 1e-8
            rows += [
                Row("delta54 direct, scipy fsolve", seconds_each(peer, least=50)),
                Row(
                    "delta54 direct, NumPy Newton single",
                    seconds_each(lambda: newton.solve(q[:1], start[:1])),
                ),
                Row(
                    f"delta54 direct, NumPy Newton batch of {N}",
                    seconds_each(lambda: newton.solve(q, start), least=2) / N,
                ),
            ]
    show("Direct and inverse problem", rows)


if __name__ == "__main__":
    main()
