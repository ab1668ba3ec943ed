"""Model 54's direct problem beside MuJoCo's closed loops: the same poses, and what each costs.

    .venv/bin/pip install mujoco && .venv/bin/parallel-cal bench peers

MuJoCo is a cross-check only: three hinged arms, a floating platform and six rods as tendons,
closed by Newton's method with MuJoCo's own lengths and Jacobians.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
from timing import Row, seconds_each, show

sys.path.insert(0, str(Path(__file__).parents[1] / "test"))
import virtual_robot as vr

from parallel_cal import solving
from parallel_cal.kinematics import Kinematics
from parallel_cal.model import new_model
from parallel_cal.rotation import matrix_to_quaternion

SOLVERS = ("newton", "cascaded", "fixed_newton", "homotopy")


def rod_ends(parameters: dict[str, float]) -> Any:
    """Arm axes and anchors, ball centres on the arms at q = 0, on the platform, and lengths."""
    robot = vr.Delta(parameters)
    arms = robot.joint_points(np.zeros(3))
    turned = [robot.joint_points(np.full(3, angle)) for angle in (np.pi / 2, np.pi)]
    balls = robot.platform_points(np.zeros(3), np.eye(3))
    return arms, turned, balls, robot.lengths(np.zeros(3))


def axis_of(points: np.ndarray, half: np.ndarray, quarter: np.ndarray) -> tuple[Any, Any]:
    """Anchor and axis of a hinge from where it takes a point in a quarter and a half turn."""
    middle = (points + half) / 2
    axis = np.cross(points - middle, quarter - middle)
    return middle, axis / np.linalg.norm(axis)


def mjcf(parameters: dict[str, float]) -> tuple[str, np.ndarray]:
    """The robot as MuJoCo XML, and its rods' lengths in the order of its tendons."""
    arms, (quarter, half), balls, lengths = rod_ends(parameters)
    flat = [np.reshape(a, (-1, 3)) for a in (arms, quarter, half, balls)]
    pairs = len(flat[0]) // 3
    bodies, rods = "", ""
    order = _by_arm(flat[0], flat[1], flat[2])
    for chain, members in enumerate(order):
        anchor, axis = axis_of(flat[0][members[0]], flat[2][members[0]], flat[1][members[0]])
        sites = "".join(f'<site name="c{k}" pos="{_text(flat[0][k])}"/>' for k in members)
        bodies += (
            f'<body name="arm{chain}"><joint name="q{chain}" type="hinge" pos="{_text(anchor)}" '
            f'axis="{_text(axis)}"/><geom size=".001" mass="1"/>{sites}</body>'
        )
    assert pairs == 2
    sites = "".join(f'<site name="b{k}" pos="{_text(ball)}"/>' for k, ball in enumerate(flat[3]))
    platform = f'<body name="p"><freejoint/><geom size=".001" mass="1"/>{sites}</body>'
    for k in range(len(flat[0])):
        rods += f'<spatial><site site="c{k}"/><site site="b{k}"/></spatial>'
    world = f"<worldbody>{bodies}{platform}</worldbody>"
    return f"<mujoco>{world}<tendon>{rods}</tendon></mujoco>", np.ravel(lengths)


def _by_arm(points: np.ndarray, quarter: np.ndarray, half: np.ndarray) -> list[list[int]]:
    """Indices of the two balls of each arm: they turn about the same axis."""
    axes = [axis_of(p, h, q)[1] for p, q, h in zip(points, quarter, half, strict=True)]
    groups: list[list[int]] = []
    for k, axis in enumerate(axes):
        for group in groups:
            if axis @ axes[group[0]] > 0.999:
                group.append(k)
                break
        else:
            groups.append([k])
    return groups


def _text(vector: np.ndarray) -> str:
    return " ".join(f"{v:.17g}" for v in vector)


class MuJoCo:
    """Newton's method on six tendon lengths."""

    def __init__(self, parameters: dict[str, float]):
        import mujoco

        self._mj = mujoco
        xml, self._lengths = mjcf(parameters)
        self._model = mujoco.MjModel.from_xml_string(xml)
        self._data = mujoco.MjData(self._model)

    def direct(self, q: np.ndarray, start: np.ndarray, steps: int = 5) -> tuple[Any, Any]:
        mj, model, data = self._mj, self._model, self._data
        data.qpos[:3], data.qpos[3:6], data.qpos[6:] = q, start, (1, 0, 0, 0)
        change = np.zeros(model.nv)
        for _ in range(steps):
            mj.mj_fwdPosition(model, data)
            J = data.ten_J.reshape(model.ntendon, model.nv)[:, 3:]
            change[3:] = np.linalg.solve(J, self._lengths - data.ten_length)
            mj.mj_integratePos(model, data.qpos, change, 1.0)
        w, x, y, z = data.qpos[6:]
        return data.qpos[3:6].copy(), np.array([x, y, z, w])


def main() -> None:
    model = new_model("delta54", vr.TABLE_5_18)
    kinematics = Kinematics(model, compile=True)
    targets = model.mechanism.sample(200, np.random.default_rng(0))
    solved = kinematics.inverse(targets)
    one = solved.joints[0]
    rows = [
        Row("parallel_cal, compiled, public call", seconds_each(lambda: kinematics.direct(one)))
    ]
    for name in SOLVERS:
        many = 1 if name == "homotopy" else 2000
        q = np.tile(one, (many, 1))
        call = lambda q=q, name=name: solving.direct(model, q, {}, solver=name)  # noqa: E731
        seconds = seconds_each(call, least=3, repeats=3) / many
        rows.append(Row(f"--solver {name}, {many} at a time, with set-up", seconds))
    try:
        peer = MuJoCo(vr.TABLE_5_18)
    except ModuleNotFoundError:
        print("mujoco is not installed: no peer (pip install mujoco)")
    else:
        for q, pose in zip(solved.joints, solved, strict=True):
            r, quaternion = peer.direct(q, pose.position + [1e-3, -1e-3, 1e-3])
            assert np.abs(r - pose.position).max() < 1e-9
            turned = matrix_to_quaternion(pose.rotation) - quaternion * np.sign(quaternion[3])
            assert np.abs(turned).max() < 1e-8
        print(f"{len(solved)} poses agree with MuJoCo to 1e-9 m")
        rows.append(
            Row(
                "MuJoCo, five Newton steps", seconds_each(lambda: peer.direct(one, targets[0]), 500)
            )
        )
    show("Direct problem of model 54", rows)


if __name__ == "__main__":
    main()
