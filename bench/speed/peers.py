"""Every peer in one run: MuJoCo, Pinocchio, FIGAROH, scipy and ODRPACK give the same answers, at
what cost.

    .venv/bin/pip install -e '.[peers]' figaroh && .venv/bin/parallel-cal bench peers

The first row of a table of kinematics is the limit: the generated C of one solution, without any
Python around it. A peer that is not installed has a row that says so.

MuJoCo is a cross-check only. Each robot is six rods between its arms (or the base) and its
platform: the balls of Argos lie on circles, that is at given distances from two points of the
circle's axis. Newton's method closes the rods with MuJoCo's site positions and Jacobians. The
geometry is that of the tests' virtual robots, so no formula of the package takes part.

The arm is built in MuJoCo and Pinocchio from its rows of Denavit and Hartenberg; Pinocchio also
reads the URDF that this program exports of it. It has no identification, and no direct problem of a
closed chain. FIGAROH identifies serial chains: from the exported URDF, it fits the positions that a
tracker saw of the arm, and must be as exact at poses of another session.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from warnings import catch_warnings, simplefilter

import arms
import numpy as np
import virtual_arm

from bench.speed.direct import NumpyNewton, fsolve_peer
from bench.speed.fit import beside_odr, beside_scipy
from bench.speed.timing import Row, processor_each, show
from parallel_cal.base.compiled import Single, compile_function
from parallel_cal.base.errors import SolveError
from parallel_cal.base.threads import single_threaded
from parallel_cal.diagnosis.comparison import compare
from parallel_cal.exporting.export import export
from parallel_cal.identification.fit import fit
from parallel_cal.kinematics import solving
from parallel_cal.kinematics.kinematics import Kinematics, Solutions
from parallel_cal.kinematics.newton import newton_functions
from parallel_cal.kinematics.problem import Problem
from parallel_cal.kinematics.solutions import MAX_SETTLED_STEP_M
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


def _text(vector: np.ndarray | Sequence[float]) -> str:
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


def compiled_limit(model: Model, one: Solutions, problem: str) -> Row:
    """One solution by the generated C, from buffer to buffer: with further iterations where the
    first do not arrive, as a public call makes them."""
    functions = newton_functions(model.structure, problem)
    k_and_limits = Problem(model, problem, True).k_and_limits
    single = Single(compile_function(functions.solve))
    given = np.concatenate([one.joints, one.position, one.rotation.ravel()])
    x, step, *_ = single(given, np.zeros(0), k_and_limits)
    seconds = processor_each(single.evaluate)
    if step.item() >= MAX_SETTLED_STEP_M:
        further = Single(compile_function(functions.refine))
        further(x, np.zeros(0), k_and_limits)
        seconds += processor_each(further.evaluate)
    return Row("limit: compiled C, buffer to buffer", seconds)


def ours(case: Case, problem: str) -> list[Row]:
    """One public call whose answer is read, and every solver that serves, on a batch with its
    set-up."""
    kinematics, truth, one = Kinematics(case.model, compile=True), case.truth, case.truth[0]
    direct = problem == "direct"
    given = (one.joints,) if direct else (one.position, one.rotation)
    if direct:
        call = lambda: kinematics.direct(*given).position  # noqa: E731
    else:
        call = lambda: kinematics.inverse(*given).joints  # noqa: E731
    rows = [
        compiled_limit(case.model, one, problem),
        Row("parallel_cal, compiled, public call", processor_each(call)),
    ]
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
        seconds = processor_each(run, least=1, repeats=3) / len(truth)
        rows.append(Row(f"--solver {solver}, {len(truth)} at a time", seconds))
    return rows


def main() -> None:
    for title, rows in tables():
        show(title, rows)


def tables() -> Iterator[tuple[str, list[Row]]]:
    """Yield the title and the rows of every table."""
    cases = [
        case("delta54", delta, vr.TABLE_5_18),
        case("argos27", argos, strayed("argos27")),
        case("stewart42", stewart, strayed("stewart42")),
    ]
    for one in cases:
        for problem in ("direct", "inverse"):
            rows = ours(one, problem) + peers(one, problem)
            if one is cases[0] and problem == "direct":
                rows += array_peers(one)
            yield f"{one.model.mechanism.name}, {problem} problem", rows
    yield "arm of six joints (UR5), direct problem", arm_rows()
    yield "identification of a Delta", beside_scipy()
    with single_threaded():
        yield "identification of one chain", beside_odr()
        yield "identification of the arm, 120 positions", arm_fit_rows()


def array_peers(case: Case) -> list[Row]:
    """The Delta of table 5.18 in NumPy and scipy, as in bench/speed/direct.py."""
    newton, one = NumpyNewton(vr.TABLE_5_18), case.truth[0]
    q, start = one.joints, one.position + [1e-3, -1e-3, 1e-3]
    scipy = fsolve_peer(newton, q, start)
    for found in (newton.solve(q[None], start[None], 4)[0], scipy()[:3]):
        assert np.abs(found - one.position).max() < 1e-8
    return [
        Row("NumPy, Newton's method", processor_each(lambda: newton.solve(q[None], start[None]))),
        Row("scipy fsolve, finite differences", processor_each(scipy, least=50)),
    ]


def arm_rows() -> list[Row]:
    """A UR5, which Pinocchio and MuJoCo compute from the same rows of Denavit and Hartenberg."""
    model = arms.nominal("ur5")
    kinematics = Kinematics(model, compile=True)
    q = np.array(virtual_arm.HOME["ur5"])
    one = kinematics.direct(q)
    rows = [
        compiled_limit(model, one, "direct"),
        Row(
            "parallel_cal, compiled, public call",
            processor_each(lambda: kinematics.direct(q).position),
        ),
    ]
    builders: dict[str, Callable[[], Any]] = {
        "Pinocchio": lambda: pinocchio_arm(virtual_arm.UR5),
        "Pinocchio, from the exported URDF": lambda: pinocchio_exported(model),
        "MuJoCo": lambda: mujoco_arm(virtual_arm.UR5),
    }
    for name, build in builders.items():
        try:
            peer = build()
        except ModuleNotFoundError:
            rows.append(Row(name, None))
            continue
        position, rotation = peer(q)
        assert np.abs(position - one.position).max() < AGREE, name
        assert np.abs(rotation - one.rotation).max() < AGREE, name
        rows.append(Row(name, processor_each(lambda f=peer: f(q))))
    return rows


def arm_fit_rows() -> list[Row]:
    """Geometry, device frame and target of a UR5, from positions; by FIGAROH from the same file."""
    robot, model = virtual_arm.arm("ur5", 4), arms.nominal("ur5")
    known, unseen = (virtual_arm.session(robot, n, seed) for n, seed in ((120, 5), (60, 6)))
    data = arms.seen(known, False, "tracker")
    found = fit(model, data, hold_out=0)
    again = compare(found.model, arms.seen(unseen, False, "tracker"))
    error = again.errors.summary.position_rms
    assert error is not None
    rows = [
        Row(
            f"fit(hold_out=0): {1e6 * error:.1f} um at 60 poses of another session",
            processor_each(lambda: fit(model, data, hold_out=0), least=1, repeats=3),
        )
    ]
    try:
        import figaroh  # noqa: F401
    except ModuleNotFoundError:
        return [*rows, Row("FIGAROH", None)]
    with TemporaryDirectory() as folder, redirect_stdout(StringIO()), catch_warnings():
        simplefilter("ignore")
        peer = figaroh_fit(Path(folder), model, known)
        theirs = peer()(unseen)
        assert 0.9 < theirs / error < 1.1, f"{theirs} m, ours {error} m"
        seconds = processor_each(peer, least=1, repeats=3)
    rows.append(Row(f"FIGAROH: {1e6 * theirs:.1f} um at the same poses", seconds))
    return rows


def figaroh_fit(folder: Path, model: Model, session: virtual_arm.Session) -> Callable[[], Any]:
    """Return a function that calibrates the UR5 by FIGAROH. It returns a function of a session: the
    rms position error (m) of the calibrated arm."""
    import yaml
    from figaroh.calibration.base_calibration import BaseCalibration
    from figaroh.calibration.calibration_tools import calc_updated_fkm

    names = ["x1", "y1", "z1", *model.joints]
    table = np.hstack([session.r, session.q])
    np.savetxt(folder / "data.csv", table, delimiter=",", header=",".join(names), comments="")
    task = {
        "type": "kinematic_calibration",
        "kinematics": {"base_frame": "universe", "tool_frame": model.frames["platform"]},
        "measurements": {"markers": [{"measurable_dof": [True] * 3 + [False] * 3}]},
        "data": {"source_file": str(folder / "data.csv"), "number_of_samples": len(table)},
    }
    config = {"robot": {"name": "ur5"}, "tasks": {"calibration": task}}
    (folder / "config.yaml").write_text(yaml.safe_dump(config))

    class Positions(BaseCalibration):  # type: ignore[misc]
        def predict(self, var: np.ndarray, q: np.ndarray) -> np.ndarray:
            settings = {**self.calib_config, "NbSample": len(q)}
            return np.asarray(calc_updated_fkm(self.model, self.data, var, q, settings))

        def cost_function(self, var: np.ndarray) -> np.ndarray:
            return np.asarray(self.PEE_measured - self.predict(var, self.q_measured))

    def calibrate() -> Callable[[virtual_arm.Session], float]:
        calibration = Positions(exported_robot(model), str(folder / "config.yaml"))
        calibration.calib_config |= {"known_baseframe": False, "known_tipframe": False}
        calibration.initialize()
        found = calibration.solve(enable_logging=False).x

        def error(other: virtual_arm.Session) -> float:
            left = calibration.predict(found, other.q).reshape(3, -1).T - other.r
            return float(np.sqrt(np.mean(np.sum(left**2, axis=1))))

        return error

    return calibrate


def after_joint(row: tuple[float, float, float]) -> tuple[np.ndarray, np.ndarray]:
    """Rotation and translation (m) from a joint's frame to the next one's: along z by d, along x by
    a, then about x by alpha."""
    a, d, alpha = row
    s, c = np.sin(alpha), np.cos(alpha)
    return np.array([[1, 0, 0], [0, c, -s], [0, s, c]]), np.array([a, 0.0, d])


def pinocchio_robot(table: Sequence[tuple[float, float, float]]) -> Any:
    """Return the arm in Pinocchio, with the end as its last frame, `tool`."""
    import pinocchio as pin

    model, joint, placement = pin.Model(), 0, pin.SE3.Identity()
    for k, row in enumerate(table):
        joint = model.addJoint(joint, pin.JointModelRZ(), placement, f"joint{k + 1}")
        placement = pin.SE3(*after_joint(row))
    model.addFrame(pin.Frame("tool", joint, placement, pin.FrameType.OP_FRAME))
    model.lowerPositionLimit, model.upperPositionLimit = np.full((2, model.nq), [[-3.0], [3.0]])
    return pin.RobotWrapper(model)


def pinocchio_arm(table: Sequence[tuple[float, float, float]]) -> Any:
    """Return a function q -> (position, rotation) of Pinocchio's forward kinematics."""
    import pinocchio as pin

    robot = pinocchio_robot(table)
    model, data, tool = robot.model, robot.data, robot.model.getFrameId("tool")

    def solve(q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        pin.forwardKinematics(model, data, q)
        found = pin.updateFramePlacement(model, data, tool)
        return found.translation, found.rotation

    return solve


def exported_robot(model: Model) -> Any:
    """Return the robot that Pinocchio reads from the exported URDF."""
    import pinocchio as pin

    with TemporaryDirectory() as folder:
        export(model, "urdf", Path(folder))
        (path,) = Path(folder).glob("*.urdf")
        return pin.RobotWrapper.BuildFromURDF(str(path))


def pinocchio_exported(model: Model) -> Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]:
    """Return a function q -> (position, rotation) of the exported URDF; joints go by name."""
    import pinocchio as pin

    robot = exported_robot(model)
    peer, data = robot.model, robot.data
    places = [peer.joints[peer.getJointId(name)].idx_q for name in model.joints]
    base, platform = (peer.getFrameId(model.frames[end]) for end in ("base", "platform"))

    def solve(q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        stood = pin.neutral(peer)
        stood[places] = q
        pin.framesForwardKinematics(peer, data, stood)
        found = data.oMf[base].inverse() * data.oMf[platform]
        return found.translation, found.rotation

    return solve


def mujoco_arm(table: Sequence[tuple[float, float, float]]) -> Any:
    """Return a function q -> (position, rotation) of MuJoCo's kinematics."""
    import mujoco

    geom, place = '<geom size=".01" mass="1"/>', 'pos="0 0 0"'
    bodies, ends = "", ""
    for row in table:
        bodies += f'<body {place}><joint type="hinge" axis="0 0 1"/>{geom}'
        ends += "</body>"
        half, (_, shift) = row[2] / 2, after_joint(row)
        place = f'pos="{_text(shift)}" quat="{_text([np.cos(half), np.sin(half), 0, 0])}"'
    text = f'<mujoco><worldbody>{bodies}<site name="end" {place}/>{ends}</worldbody></mujoco>'
    model = mujoco.MjModel.from_xml_string(text)
    data, end = mujoco.MjData(model), model.site("end").id

    def solve(q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        return data.site_xpos[end], data.site_xmat[end].reshape(3, 3)

    return solve


def peers(case: Case, problem: str) -> list[Row]:
    """MuJoCo, after it has given the same answers; None where it is not installed."""
    if problem == "inverse" and not len(case.rods.axes):
        return []  # a Stewart platform's inverse is six distances
    try:
        peer = MuJoCo(case.rods)
    except ModuleNotFoundError:
        return [Row("MuJoCo, eight Newton steps", None)]
    worst = disagreement(case, peer, problem)
    assert worst < AGREE, f"MuJoCo differs by {worst:.1e}"
    print(f"{len(case.truth)} answers differ from MuJoCo's by {worst:.0e} m or rad at most")
    pose = case.truth[0]
    seconds = processor_each(lambda: case.peer_solve(peer, pose, problem), least=300)
    return [Row("MuJoCo, eight Newton steps", seconds)]


if __name__ == "__main__":
    main()
