"""Delta 54, Argos 27 and Stewart 42 beside MuJoCo's kinematics: the same answers, at what cost.

    .venv/bin/pip install -e '.[peers]' && .venv/bin/parallel-cal bench peers

MuJoCo is a cross-check only. Each robot is six rods between its arms (or the base) and its
platform: the balls of Argos lie on circles, that is at given distances from two points of the
circle's axis. Newton's method closes the rods with MuJoCo's site positions and Jacobians. The
geometry is that of the tests' virtual robots, so no formula of the package takes part.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from timing import Row, seconds_each, show

sys.path.insert(0, str(Path(__file__).parents[1] / "test"))
from parallel_cal.base.errors import SolveError
from parallel_cal.kinematics import solving
from parallel_cal.kinematics.kinematics import Kinematics, Solutions
from parallel_cal.model.mechanism import poses_in_workspace
from parallel_cal.model.model import Model, new_model
from parallel_cal.virtual import argos as va
from parallel_cal.virtual import robot as vr
from parallel_cal.virtual import stewart as vs

AGREE = 1e-9  # m and rad
POSES = 100
# options with which a solver is exact
SOLVERS = {
    "delta54": ("newton", "cascaded:half_steps=7", "fixed_newton:steps=7", "homotopy"),
    "argos27": (
        "newton",
        "cascaded_circles:half_steps=24",
        "fixed_newton:steps=12",
        "three_circles",
    ),
    "stewart42": ("newton", "fixed_newton:steps=8,update=true", "homotopy", "closed_form"),
}


@dataclass(frozen=True)
class Rods:
    """Six rods: ends (6, 3) m at q = 0 on hinges `on` (6,) (-1: the base), balls (6, 3) m of the
    platform; hinges by a point and an axis (n, 3)."""

    points: np.ndarray
    axes: np.ndarray
    on: Sequence[int]
    ends: np.ndarray
    balls: np.ndarray
    lengths: np.ndarray

    def mjcf(self) -> str:
        """The robot as MuJoCo XML: hinged arms and a floating platform, sites for balls."""
        sites = [f'<site name="c{k}" pos="{_text(end)}"/>' for k, end in enumerate(self.ends)]
        held = [
            "".join(s for s, on in zip(sites, self.on, strict=True) if on == h)
            for h in range(-1, len(self.axes))
        ]
        geom = '<geom size=".001" mass="1"/>'
        arms = "".join(
            f'<body><joint type="hinge" pos="{_text(p)}" axis="{_text(a)}"/>{geom}{inside}</body>'
            for p, a, inside in zip(self.points, self.axes, held[1:], strict=True)
        )
        balls = "".join(f'<site name="b{k}" pos="{_text(b)}"/>' for k, b in enumerate(self.balls))
        platform = f"<body><freejoint/>{geom}{balls}</body>"
        return f"<mujoco><worldbody>{held[0]}{arms}{platform}</worldbody></mujoco>"


def delta(parameters: dict[str, float]) -> Rods:
    robot, zero = vr.Delta(parameters), np.zeros(3)
    balls = robot.platform_points(zero, np.eye(3))
    ends = robot.joint_points(zero)
    return Rods(robot.hub, robot.axis, (0, 1, 2) * 2, ends, balls, robot.rods)


def argos(parameters: dict[str, float]) -> Rods:
    robot = va.Argos(parameters)
    centres, axes = robot.hinges(np.zeros(3))
    ends = np.concatenate([centres, centres + va.SPHERE * axes.along])
    lengths = np.concatenate([robot.radius, np.hypot(robot.radius, va.SPHERE)])
    balls = np.tile(robot.balls, (2, 1))
    return Rods(robot.motors.point, robot.motors.along, (0, 1, 2) * 2, ends, balls, lengths)


def stewart(parameters: dict[str, float]) -> Rods:
    robot, none = vs.Stewart(parameters), np.empty((0, 3))
    return Rods(none, none, (-1,) * 6, robot.base, robot.platform, robot.offset)


class MuJoCo:
    """Newton's method on the lengths of six rods."""

    def __init__(self, rods: Rods):
        import mujoco

        self._mj, self._arms = mujoco, len(rods.axes)
        self._model = mujoco.MjModel.from_xml_string(rods.mjcf())
        self._data = mujoco.MjData(self._model)
        self._sites = [[self._model.site(f"{side}{k}").id for k in range(6)] for side in "cb"]

    def solve(
        self, lengths: np.ndarray, q: np.ndarray, pose: Any, unknown: list[int], steps: int = 8
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """q, r and R that close the rods; `unknown` among q, r, and turns of the platform."""
        mj, model, data, n = self._mj, self._model, self._data, self._arms
        data.qpos[:n], data.qpos[n : n + 3] = q, pose[0]
        mj.mju_mat2Quat(data.qpos[n + 3 :], np.ravel(pose[1]))
        change, R = np.zeros(model.nv), np.zeros(9)
        for _ in range(steps):
            found, J = self.rods()
            change[unknown] = np.linalg.solve(J[:, unknown], lengths - found)
            mj.mj_integratePos(model, data.qpos, change, 1.0)
        mj.mju_quat2Mat(R, data.qpos[n + 3 :])
        return data.qpos[:n].copy(), data.qpos[n : n + 3].copy(), R.reshape(3, 3)

    def rods(self) -> tuple[np.ndarray, np.ndarray]:
        """Lengths (6,) and their derivatives (6, nv)."""
        mj, model, data = self._mj, self._model, self._data
        mj.mj_kinematics(model, data)
        mj.mj_comPos(model, data)
        J = np.zeros((2, 6, 3, model.nv))
        for side, sites in zip(J, self._sites, strict=True):
            for jacobian, site in zip(side, sites, strict=True):
                mj.mj_jacSite(model, data, jacobian, None, site)
        rod = data.site_xpos[self._sites[1]] - data.site_xpos[self._sites[0]]
        length = np.linalg.norm(rod, axis=1)
        return length, np.einsum("ki,kij->kj", rod / length[:, None], J[1] - J[0])


def _text(vector: np.ndarray) -> str:
    return " ".join(f"{v:.17g}" for v in vector)


@dataclass(frozen=True)
class Case:
    """A robot here and there, and poses that both solve."""

    model: Model
    rods: Rods
    truth: Solutions

    def peer_solve(self, peer: MuJoCo, pose: Solutions, problem: str) -> Any:
        """MuJoCo's answer from a start that is off in everything unknown."""
        m, n = self.model.mechanism, len(self.rods.axes)
        driven = n > 0  # else the joints are the rods' lengths themselves
        lengths = self.rods.lengths if driven else self.rods.lengths + pose.joints
        q, r, R = pose.joints[:n], pose.position, pose.rotation
        off = vr.turn(np.array([0.01, -0.02, 0.01])) @ R
        if problem == "direct":
            return peer.solve(lengths, q, (r + 1e-3, off), [n + i for i in range(6)])
        passive = [i for i in range(6) if i not in m.controlled]
        start = (r + 1e-3 * np.isin(range(3), passive), off if 3 in passive else R)
        return peer.solve(lengths, q + 0.02, start, [*range(n), *(n + i for i in passive)])


def case(name: str, rods: Any, parameters: dict[str, float]) -> Case:
    model = new_model(name, parameters)
    asked = poses_in_workspace(model.mechanism, 2 * POSES, np.random.default_rng(0))
    found = Kinematics(model).inverse(*asked)
    return Case(model, rods(parameters), found[found.ok][:POSES])


def strayed(name: str) -> dict[str, float]:
    """A robot off its nominal by one tolerance."""
    t, rng = new_model(name).table, np.random.default_rng(1)
    return t.mapping(t.nominal + t.tolerance * rng.standard_normal(len(t)))


def disagreement(case: Case, peer: MuJoCo, problem: str) -> float:
    """The largest difference (m or rad) over all poses."""
    worst = 0.0
    for pose in case.truth:
        q, r, R = case.peer_solve(peer, pose, problem)
        pairs = (q - pose.joints[: len(q)], r - pose.position, R - pose.rotation)
        worst = max(worst, *(float(np.abs(d).max(initial=0)) for d in pairs))
    return worst


def ours(case: Case, problem: str) -> list[Row]:
    """One public call, and every solver that serves, on a batch with its set-up."""
    kinematics, truth, one = Kinematics(case.model, compile=True), case.truth, case.truth[0]
    direct = problem == "direct"
    given = (one.joints,) if direct else (one.position, one.rotation)
    call = kinematics.direct if direct else kinematics.inverse
    rows = [Row("parallel_cal, compiled, public call", seconds_each(lambda: call(*given)))]
    table = (truth.joints,) if direct else (truth.position, truth.rotation)
    solve = solving.direct if direct else solving.inverse
    for solver in SOLVERS[case.model.mechanism.name]:
        try:
            found = solve(case.model, *table, {}, solver=solver)
        except SolveError:
            continue
        assert np.abs(found.joints - truth.joints).max() < 1e-7, solver
        assert np.abs(found.position - truth.position).max() < 1e-7, solver
        run = lambda s=solver: solve(case.model, *table, {}, solver=s)  # noqa: E731
        seconds = seconds_each(run, least=1, repeats=3) / len(truth)
        rows.append(Row(f"--solver {solver}, {len(truth)} at a time", seconds))
    return rows


def main() -> None:
    cases = [
        case("delta54", delta, vr.TABLE_5_18),
        case("argos27", argos, strayed("argos27")),
        case("stewart42", stewart, strayed("stewart42")),
    ]
    for one in cases:
        for problem in ("direct", "inverse"):
            rows = ours(one, problem) + peers(one, problem)
            show(f"{one.model.mechanism.name}, {problem} problem", rows)


def peers(case: Case, problem: str) -> list[Row]:
    """MuJoCo, after it has given the same answers; none where it is not installed."""
    if problem == "inverse" and not len(case.rods.axes):
        return []  # a Stewart platform's inverse is six distances
    try:
        peer = MuJoCo(case.rods)
    except ModuleNotFoundError:
        print("mujoco is not installed: no peer (pip install -e '.[peers]')")
        return []
    worst = disagreement(case, peer, problem)
    assert worst < AGREE, f"MuJoCo differs by {worst:.1e}"
    print(f"{len(case.truth)} answers differ from MuJoCo's by {worst:.0e} m or rad at most")
    pose = case.truth[0]
    seconds = seconds_each(lambda: case.peer_solve(peer, pose, problem), least=300)
    return [Row("MuJoCo, eight Newton steps", seconds)]


if __name__ == "__main__":
    main()
