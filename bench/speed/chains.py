"""Closed chains: robots of the shelf beside the same robots as `chain`, and MuJoCo beside `chain`
on the same files.

    .venv/bin/pip install mujoco && .venv/bin/parallel-cal bench chains

The equations of the shelf were derived by hand, without passive coordinates. A chain solves for all
passive joints. Both must agree before they are timed, on the same poses.

In MuJoCo, Newton's method closes the equality constraints of the file: its C code computes them and
their Jacobian (mj_fwdPosition), and NumPy the step. The last row of a table contains no step: it is
the C code alone, once. It is not a solution.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import chains
import linkage_files
import numpy as np

from bench.speed.timing import Row, processor_each, show
from parallel_cal.importing.closed_chain import chain
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.mechanism import poses_in_workspace
from parallel_cal.model.model import Model, new_model

AGREE = 1e-9  # m and rad
POSES, BATCH = 100, 20_000
STEPS = 6  # of Newton's method in MuJoCo
SHELF = {
    "five_bar": lambda model: chains.five_bar(),
    "planar_stewart": chains.from_planar_stewart,
    "rssr": chains.from_rssr,
    "delta54": chains.from_delta54,
    "stewart42": chains.from_stewart42,
}


def main() -> None:
    for title, rows in tables():
        show(title, rows)


def tables() -> Iterator[tuple[str, list[Row]]]:
    """Yield the title and the rows of every table."""
    for name, convert in SHELF.items():
        shelf = new_model(name)
        yield (
            f"{name} and the same robot as chain, direct problem",
            time_both(shelf, chains.make_chain(convert(shelf))),
        )
    for title, text, platform in (
        ("five-bar", linkage_files.FIVE_BAR_MJCF, "tip"),
        ("ankle with two rods", linkage_files.ANKLE_MJCF, "toe"),
        ("planar Stewart platform", planar_stewart_mjcf(new_model("planar_stewart")), "plate"),
    ):
        yield f"MJCF of a {title}, direct problem", time_on_file(text, platform)


def time_both(shelf: Model, same: Model) -> list[Row]:
    """Time one pose of a batch, and one public call, of both models."""
    poses = poses_in_workspace(shelf.mechanism, BATCH, np.random.default_rng(0))
    q = Kinematics(shelf).inverse(*poses).joints
    solvers = [Kinematics(model, compile=True) for model in (shelf, same)]
    one, other = (solver.direct(q) for solver in solvers)
    assert one.ok.all()
    assert other.ok.all()
    assert np.abs(one.position - other.position).max() < AGREE
    rows = []
    for label, solver in zip(("equations by hand", "chain"), solvers, strict=True):
        seconds = processor_each(lambda s=solver: s.direct(q), least=3) / len(q)
        rows.append(Row(f"{label}, one pose of {BATCH}", seconds))
    for label, solver in zip(("equations by hand", "chain"), solvers, strict=True):
        rows.append(Row(f"{label}, public call", processor_each(lambda s=solver: s.direct(q[0]))))
    return rows


def time_on_file(text: str, platform: str) -> list[Row]:
    """Time both programs on one MJCF, after they gave the same answers."""
    with TemporaryDirectory() as folder:
        path = Path(folder, "robot.xml")
        path.write_text(text)
        model = chain([path], platform=platform).model
    solver, m = Kinematics(model, compile=True), model.mechanism
    poses = poses_in_workspace(m, BATCH, np.random.default_rng(0))
    q = solver.inverse(*poses).joints
    q = q[solver.direct(q).ok]  # some of the workspace is beyond the limits of joints
    found = solver.direct(q)
    each = processor_each(lambda: solver.direct(q), least=3) / len(q)
    rows = [
        Row(f"chain, one pose of {len(q)}", each),
        Row("chain, public call", processor_each(lambda: solver.direct(q[0]))),
    ]
    newton, evaluation = f"MuJoCo, {STEPS} Newton steps", "MuJoCo, constraints and Jacobian once"
    try:
        peer = MuJoCo(text, model, platform)
    except ModuleNotFoundError:
        return [*rows, Row(newton, None), Row(evaluation, None)]
    worst = max(np.abs(peer.solve(q[k]) - found.position[k]).max() for k in range(POSES))
    assert worst < AGREE, f"MuJoCo differs by {worst:.1e} m"
    print(f"{POSES} answers differ from MuJoCo's by {worst:.0e} m at most")
    rows.append(Row(newton, processor_each(lambda: peer.solve(q[0]), least=300)))
    rows.append(Row(evaluation, processor_each(peer.evaluate)))
    return rows


class MuJoCo:
    """Newton's method on the equality constraints of an MJCF, for given driven joints."""

    def __init__(self, text: str, model: Model, platform: str):
        import mujoco

        spec = mujoco.MjSpec.from_string(text)
        spec.compiler.boundmass = spec.compiler.boundinertia = 1e-3  # some bodies have none
        self._mj, m = mujoco, spec.compile()
        m.opt.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
        m.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
        m.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_LIMIT
        self._model, self._data = m, mujoco.MjData(m)
        joints = [m.joint(name) for name in model.joints]
        self._driven = [int(joint.qposadr[0]) for joint in joints]
        known = {int(joint.dofadr[0]) for joint in joints}
        if m.jnt_type[0] == mujoco.mjtJoint.mjJNT_FREE:  # the base stays where it is
            known |= set(range(6))
        self._unknown = [k for k in range(m.nv) if k not in known]
        self._base = m.body(model.frames["base"]).id
        self._site = m.site(platform).id

    def evaluate(self) -> None:
        """Compute the constraints and their Jacobian."""
        self._mj.mj_fwdPosition(self._model, self._data)

    def solve(self, q: np.ndarray) -> np.ndarray:
        """Return the position (3,) of the platform's site in {B}."""
        mj, model, data = self._mj, self._model, self._data
        data.qpos[:] = model.qpos0
        data.qpos[self._driven] = q
        change = np.zeros(model.nv)
        for _ in range(STEPS):
            self.evaluate()
            J = data.efc_J.reshape(-1, model.nv)[: data.nefc, self._unknown]
            # Rows of a plane loop that leave its plane depend on the others.
            change[self._unknown] = -np.linalg.lstsq(J, data.efc_pos, rcond=1e-9)[0]
            mj.mj_integratePos(model, data.qpos, change, 1.0)
        mj.mj_kinematics(model, data)
        R = data.xmat[self._base].reshape(3, 3)
        return R.T @ (data.site_xpos[self._site] - data.xpos[self._base])


def planar_stewart_mjcf(model: Model) -> str:
    """Write a planar Stewart platform: three turning barrels with slides, pivots on the plate."""
    home = np.array([*model.mechanism.home.position[:2], 0.0])
    legs, actuators, loops = "", "", ""
    for k, leg in enumerate(model.joints):
        C, B = (
            np.array([*(model.value(f"{leg}.{end}_{axis}") for axis in "xy"), 0.0]) for end in "CB"
        )
        way = home + B - C
        angle, length = float(np.arctan2(way[1], way[0])), float(np.linalg.norm(way))
        reading = length - model.value(f"{leg}.L0")
        low, high = model.mechanism.joint_limits[k]
        plate = ""
        if k == 0:  # the first leg carries the platform
            plate = (
                f'<body name="plate" euler="0 0 {-angle!r}" pos="{_text(_back(angle, -B))}">'
                f'<joint type="hinge" axis="0 0 1" pos="{_text(B)}"/>{GEOM}'
                '<site name="plate"/></body>'
            )
        else:
            loops += f'<connect body1="slide{k}" body2="plate" anchor="0 0 0"/>'
        legs += (
            f'<body pos="{_text(C)}" euler="0 0 {angle!r}">{GEOM}<joint type="hinge" axis="0 0 1"/>'
            f'<body name="slide{k}" pos="{length!r} 0 0">{GEOM}<joint name="{leg}" type="slide" '
            f'axis="1 0 0" ref="{reading!r}" range="{low!r} {high!r}"/>{plate}</body></body>'
        )
        actuators += f'<motor joint="{leg}"/>'
    text = (
        f'<mujoco><compiler angle="radian"/><worldbody><body name="base">{GEOM}{legs}</body>'
        f"</worldbody><equality>{loops}</equality><actuator>{actuators}</actuator></mujoco>"
    )
    return text


GEOM = '<geom size="0.001" mass="1"/>'


def _back(angle: float, vector: np.ndarray) -> Any:
    """Express a vector of the base in a frame that is turned by an angle about z."""
    c, s = np.cos(angle), np.sin(angle)
    return [c * vector[0] + s * vector[1], c * vector[1] - s * vector[0], vector[2]]


def _text(vector: Any) -> str:
    return " ".join(f"{float(v):.17g}" for v in vector)


if __name__ == "__main__":
    main()
