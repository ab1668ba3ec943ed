"""Direct and inverse problem: ours beside scipy's fsolve and a vectorised NumPy Newton.

All solve the same robot (table 5.18) at the same poses, and must agree before they are timed.
"""

from __future__ import annotations

import math
import os
from typing import Any

import numpy as np

from bench.speed.timing import Row, processor_each, show
from parallel_cal.base.compiled import Batch, Single, compile_function
from parallel_cal.base.rotation import rotation_matrix
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.kinematics.newton import newton_functions
from parallel_cal.model.model import Model, new_model
from parallel_cal.virtual import robot as vr

N = 100_000


class NumpyNewton:
    """The hand-written peer: six rods between points, residual and derivative as arrays."""

    def __init__(self, parameters: dict[str, float]):
        self._robot = vr.Delta(parameters)
        self._B = self._robot.platform_points(np.zeros(3), np.eye(3))
        self._L = self._robot.lengths(np.zeros(3))

    def arms(self, q: np.ndarray) -> np.ndarray:
        """Ball centres on the arms, (N, 6, 3): the same in every iteration."""
        return self._robot.joint_points(q)

    def residual(self, C: np.ndarray, r: np.ndarray, R: np.ndarray) -> tuple[np.ndarray, ...]:
        RB = self._B @ R.swapaxes(-1, -2)
        d = r[..., None, :] + RB - C
        phi = ((d * d).sum(axis=-1) - self._L**2) / (2 * self._L)
        return phi, d, RB

    def solve(self, q: np.ndarray, r: np.ndarray, iterations: int = 3) -> np.ndarray:
        R, C = np.broadcast_to(np.eye(3), (len(q), 3, 3)), self.arms(q)
        for _ in range(iterations):
            phi, d, RB = self.residual(C, r, R)
            x, y, z = np.moveaxis(RB, -1, 0)
            u, v, w = np.moveaxis(d, -1, 0)
            turned = np.stack([y * w - z * v, z * u - x * w, x * v - y * u], axis=-1)
            J = np.concatenate([d, turned], axis=-1) / self._L[:, None]
            step = -np.linalg.solve(J, phi[:, :, None])[:, :, 0]
            r, R = r + step[:, :3], rotation_matrix(step[:, 3:]) @ R
        return r


def fsolve_peer(newton: NumpyNewton, q: np.ndarray, start: np.ndarray) -> Any:
    """scipy's fsolve with finite differences, as most people would write it."""
    from scipy.optimize import fsolve

    def turn(w: np.ndarray) -> np.ndarray:
        angle = math.sqrt(w @ w) + 1e-300
        x, y, z = w / angle
        K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        return np.eye(3) + math.sin(angle) * K + (1 - math.cos(angle)) * (K @ K)

    def solve() -> np.ndarray:
        C = newton.arms(q)
        return fsolve(
            lambda u: newton.residual(C, u[:3], turn(u[3:]))[0],
            np.concatenate([start, np.zeros(3)]),
            xtol=1e-12,
        )

    return solve


def buffer_rows(model: Model, problem: str, name: str, given: np.ndarray) -> list[Row]:
    """Single and batch solves through the compiled function's buffer."""
    functions = newton_functions(model.structure, problem)
    k = Single(functions.tables)(model.values)[0]
    rows = []
    for label, f, batch in (
        ("virtual machine", functions.solve, Batch(functions.solve)),
        ("compiled C", compile_function(functions.solve), Batch(functions.solve, compile_after=0)),
    ):
        single = Single(f)
        arguments = (given[0], np.zeros(0), k)
        single(*arguments)
        rows.append(Row(f"{name}, {label}, buffer", processor_each(single.evaluate)))
        many = (given, np.zeros((len(given), 0)), k)
        seconds = processor_each(lambda b=batch, a=many: b(*a), least=3) / len(given)
        rows.append(Row(f"{name}, {label}, batch of {len(given)}", seconds))
    return rows


def public_rows(kinematics: Kinematics, q: np.ndarray, r: np.ndarray, name: str) -> list[Row]:
    return [
        Row(f"{name} direct, public call", processor_each(lambda: kinematics.direct(q))),
        Row(f"{name} inverse, public call", processor_each(lambda: kinematics.inverse(r))),
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
            newton = NumpyNewton(vr.TABLE_5_18)
            start = r + [1e-3, -1e-3, 1e-3]
            assert np.abs(newton.solve(q, start, 4) - r).max() < 1e-9
            peer = fsolve_peer(newton, q[0], start[0])
            assert np.abs(peer()[:3] - r[0]).max() < 1e-8
            rows += [
                Row("delta54 direct, scipy fsolve", processor_each(peer, least=50)),
                Row(
                    "delta54 direct, NumPy Newton single",
                    processor_each(lambda: newton.solve(q[:1], start[:1])),
                ),
                Row(
                    f"delta54 direct, NumPy Newton batch of {N}",
                    processor_each(lambda: newton.solve(q, start), least=2) / N,
                ),
            ]
    show("Direct and inverse problem", rows)


if __name__ == "__main__":
    main()
