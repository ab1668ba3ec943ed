"""Closed chains of files in Pinocchio (URDF) and MuJoCo (MJCF): Newton's method closes their loops.

Both programs read the file and compute frames and Jacobians; nothing of the package is part of it,
but the names of the driven joints and the configuration at home from which a motion begins.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from scipy.optimize import least_squares

from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.model import Model

Array = np.ndarray

TRIES = 300  # random starts
PATH, NEWTON, CLOSED = 12, 30, 1e-12  # steps from home, of Newton's method; m and rad
LEAST_SINGULAR = 1e-8  # of the largest: redundant rows


class Peer:
    """A robot in another program. Joints are known (driven or locked) or follow from the loops.

    Loops that stay less than `left_open` (m or rad) open count as closed where the sum of the
    squares of their gaps is least: redundant loops of a robot that is not exactly as drawn.
    """

    unknown: list[int]  # columns of the Jacobian
    size: int
    start: Array
    home: Array
    left_open = 1e-10

    def state(self, x: Array, q: Array) -> Array:
        """Return a configuration with other readings."""
        raise NotImplementedError

    def column(self, name: str) -> int:
        """Return the column of a joint with one coordinate, or -1."""
        raise NotImplementedError

    def rows(self, x: Array) -> tuple[Array, Array]:
        """Return how far the loops are open, and the derivatives by all joints."""
        raise NotImplementedError

    def moved(self, x: Array, change: Array) -> Array:
        """Return a configuration changed along the columns of the Jacobian."""
        raise NotImplementedError

    def pose(self, x: Array) -> tuple[Array, Array]:
        """Return position and rotation of the platform in the base."""
        raise NotImplementedError

    def down(self, x: Array) -> Array:
        """Return the direction of gravity, in the base."""
        raise NotImplementedError

    def energy(self, x: Array) -> float:
        """Return the potential energy (J) of the weights of the links."""
        raise NotImplementedError

    def close(self, x: Array) -> Array:
        """Close the loops. ValueError if they stay open."""
        step = np.inf
        for _ in range(NEWTON):
            gap, J = self.rows(x)
            if np.abs(gap).max(initial=0) < CLOSED or step < CLOSED:
                break
            change = np.zeros(J.shape[1])
            found = np.linalg.lstsq(J[:, self.unknown], gap, rcond=LEAST_SINGULAR)[0]
            step = np.abs(found).max()
            change[self.unknown] = -found * min(1.0, 0.5 / max(step, 1e-300))
            x = self.moved(x, change)
        left = float(np.abs(self.rows(x)[0]).max(initial=0))
        if left > self.left_open or (left > 1e-10 and step > 1e-11):
            raise ValueError(f"the loops stay {left:.1e} open")
        return x

    def begin(self, model: Model) -> None:
        """Close the loops at home, in the assembly mode of the model: files draw some of them open,
        by up to half a turn."""
        home, rng = model.mechanism.home, np.random.default_rng(0)
        there = Kinematics(model).direct(self.home)
        known = {
            self.column(name): value
            for name, value in zip(model.mechanism.passive, home.passive, strict=True)
            if self.column(name) in self.unknown
        }
        drawn = self.state(self.start, self.home)
        rest = [column for column in self.unknown if column not in known]
        for k in range(-1, TRIES):  # first where it starts
            change = np.zeros(self.size)
            if k >= 0:
                change[[*known]] = [*known.values()]
                change[rest] = rng.uniform(-1, 1, len(rest)) * min(3.1, 0.3 * k)
            try:
                x = self.moved(drawn, change)
                x = self.close(self.nearer(x, rest) if k >= 0 else x)
            except ValueError:
                continue
            r, R = self.pose(x)
            if max(np.abs(r - there.position).max(), np.abs(R - there.rotation).max()) < 0.01:
                self.start = x
                return
        raise ValueError("no closed configuration near the home of the model was found")

    def nearer(self, x: Array, columns: list[int]) -> Array:
        """Return the configuration with the smallest gaps that changes of some joints reach: far
        from a solution, Newton's method alone leaves them."""

        def moved(step: Array) -> Array:
            change = np.zeros(self.size)
            change[columns] = step
            return self.moved(x, change)

        found = least_squares(lambda step: self.rows(moved(step))[0], np.zeros(len(columns)))
        return moved(found.x)

    def reach(self, q: Array) -> Array:
        """Follow the loops from home to readings (nq,), and return the configuration there."""
        x = self.start
        for share in np.linspace(0, 1, PATH + 1):
            x = self.close(self.state(x, self.home + share * (q - self.home)))
        return x

    def torque(self, x: Array, q: Array, load: float) -> Array:
        """Return the torques (nq,) of all weights, and of a load (kg), on the driven joints, by
        virtual work."""
        found, h = np.zeros(len(q)), 1e-5
        for k in range(len(q)):
            energy = []
            for sign in (1, -1):
                there = self.close(self.state(x, q + sign * h * np.eye(len(q))[k]))
                fall = self.down(there) @ self.pose(there)[0]
                energy.append(self.energy(there) - load * 9.81 * fall)
            found[k] = -(energy[0] - energy[1]) / (2 * h)
        return found


class Pinocchio(Peer):
    """A URDF with its loops (`robot.yaml`), as Pinocchio reads it."""

    def __init__(self, path: Path, model: Model, robot: Any):
        import pinocchio as pin

        said = yaml.safe_load((path.parent / "robot.yaml").read_text())
        kinds = dict(zip(said.get("joint_name", ()), said.get("joint_type", ()), strict=True))
        self._pin = pin
        self._model = m = with_kinds(pin, pin.buildModelFromUrdf(str(path)), kinds)
        self._data = m.createData()
        self._loops = [
            (*(m.getFrameId(name) for name in pair), kind.lower() == "6d")
            for pair, kind in zip(said["closed_loop"], said["type"], strict=True)
        ]
        driven = [m.getJointId(name) for name in model.joints]
        self._driven = [m.idx_qs[k] for k in driven]
        known = {*driven, *map(m.getJointId, (*said["name_mot"], *still_joints(model, robot)))}
        self.unknown = [
            m.idx_vs[k] + i for k in range(1, m.njoints) if k not in known for i in range(m.nvs[k])
        ]
        self.size = m.nv
        self._ends = [m.getFrameId(name) for name in (robot.base, robot.platform)]
        self.start, self.home = pin.neutral(m), np.array(model.mechanism.home.joints)
        self._keep_one_leg([m.idx_vs[k] for k in driven])

    def _keep_one_leg(self, driven: list[int]) -> None:
        """Keep the loops, and the unknown joints in them, that share joints with the driven ones:
        another leg of the file has no part in this one."""
        x = self._pin.integrate(
            self._model, self.start, np.random.default_rng(1).uniform(-1, 1, self.size)
        )
        found, rest, loops = {*driven}, {*self.unknown}, self._loops
        joints = []
        for loop in loops:
            self._loops = [loop]
            joints.append({*np.flatnonzero(np.abs(self.rows(x)[1]).max(axis=0)).tolist()})
        for _ in loops:
            for own in joints:
                found |= own if own & found & {*driven, *rest} else set()
        self._loops = [one for one, own in zip(loops, joints, strict=True) if own & found & rest]
        self.unknown = [k for k in self.unknown if k in found]

    def column(self, name: str) -> int:
        k = self._model.getJointId(name)
        return self._model.idx_vs[k] if k < self._model.njoints and self._model.nvs[k] == 1 else -1

    def state(self, x: Array, q: Array) -> Array:
        x = x.copy()
        x[self._driven] = q
        return x

    def rows(self, x: Array) -> tuple[Array, Array]:
        pin, m, d = self._pin, self._model, self._data
        pin.computeJointJacobians(m, d, x)
        pin.updateFramePlacements(m, d)
        gaps, rows = [], []
        for a, b, whole in self._loops:
            A, B = d.oMf[a], d.oMf[b]
            J_a, J_b = (
                pin.getFrameJacobian(m, d, k, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)
                for k in (a, b)
            )
            if whole:
                between = A.actInv(B)
                turn = pin.Jlog6(between)
                own = [pin.getFrameJacobian(m, d, k, pin.ReferenceFrame.LOCAL) for k in (a, b)]
                gaps.append(pin.log6(between).vector)
                rows.append(turn @ (own[1] - between.toActionMatrixInverse() @ own[0]))
            else:
                gaps.append(B.translation - A.translation)
                rows.append((J_b - J_a)[:3])
        return np.concatenate(gaps), np.vstack(rows)

    def moved(self, x: Array, change: Array) -> Array:
        return self._pin.integrate(self._model, x, change)

    def pose(self, x: Array) -> tuple[Array, Array]:
        self._pin.framesForwardKinematics(self._model, self._data, x)
        base, end = (self._data.oMf[k] for k in self._ends)
        found = base.actInv(end)
        return found.translation.copy(), found.rotation.copy()

    def energy(self, x: Array) -> float:
        return float(self._pin.computePotentialEnergy(self._model, self._data, x))

    def down(self, x: Array) -> Array:
        self._pin.framesForwardKinematics(self._model, self._data, x)
        return self._data.oMf[self._ends[0]].rotation.T @ np.array([0.0, 0.0, -1.0])


def still_joints(model: Model, robot: Any) -> list[str]:
    """Return the passive joints that do not move: locked ones, and idle ones, which would turn as
    soon as an error of the geometry lets them."""
    held = [name.partition(".")[0] for name in model.mechanism.held]
    return [*robot.locked, *dict.fromkeys(held)]


def with_kinds(pin: Any, model: Any, kinds: dict[str, str]) -> Any:
    """Return a Pinocchio model whose listed joints are balls or universal joints; without a list,
    those with `spherical` in their names are balls, as the tool has it that writes such files."""
    made = pin.Model()
    names = list(model.names)
    kinds = {get_close_matches(name, names, 1)[0]: kind for name, kind in kinds.items()}
    for k in range(1, model.njoints):
        name = model.names[k]
        kind = kinds.get(name, "SPHERICAL" if not kinds and "spherical" in name else "")
        joint = model.joints[k]
        if kind == "SPHERICAL":
            joint = pin.JointModelSpherical()
        elif kind.startswith("UJOINT"):
            joint = pin.JointModelComposite()
            for axis in kind[-2:]:
                joint.addJoint(getattr(pin, f"JointModelR{axis}")())
        made.addJoint(model.parents[k], joint, model.jointPlacements[k], name)
        made.appendBodyToJoint(k, model.inertias[k], pin.SE3.Identity())
    for frame in model.frames[1:]:
        made.addFrame(pin.Frame(frame.name, frame.parentJoint, frame.placement, frame.type))
    return made


class MuJoCo(Peer):
    """An MJCF, as MuJoCo reads it, without its meshes."""

    def __init__(self, path: Path, model: Model, robot: Any):
        import mujoco

        self._mj = mujoco
        spec = mujoco.MjSpec.from_string(without_shapes(path.read_text()))
        spec.compiler.boundmass = spec.compiler.boundinertia = 1e-3  # some bodies have none
        self._model = m = spec.compile()
        m.opt.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
        m.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
        m.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_LIMIT
        m.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_FRICTIONLOSS
        self._data = mujoco.MjData(m)
        joints = [m.joint(name) for name in model.joints]
        self._driven = [int(joint.qposadr[0]) for joint in joints]
        acted = {int(m.actuator_trnid[k, 0]) for k in range(m.nu)}
        known = {
            int(m.joint(name).dofadr[0]) for name in (*model.joints, *still_joints(model, robot))
        }
        known |= {int(m.jnt_dofadr[k]) for k in acted if robot.driven == ()}
        names = {m.site(k).name: ("site", k) for k in range(m.nsite)}
        names |= {m.body(k).name: ("body", k) for k in range(m.nbody)}
        self._ends = [names[name] for name in (robot.base, robot.platform)]
        kind, body = self._ends[0]
        body = int(m.site_bodyid[body]) if kind == "site" else body
        while body:  # the base stays where it is, also if it floats
            first = int(m.body_dofadr[body])
            known |= set(range(first, first + int(m.body_dofnum[body])))
            body = int(m.body_parentid[body])
        self.unknown = [k for k in range(m.nv) if k not in known]
        self.start = m.key_qpos[0].copy() if m.nkey else m.qpos0.copy()
        for name in robot.locked:
            self.start[int(m.joint(name).qposadr[0])] = 0.0
        self.home = np.array(model.mechanism.home.joints)
        self.size = m.nv

    def state(self, x: Array, q: Array) -> Array:
        x = x.copy()
        x[self._driven] = q
        return x

    def column(self, name: str) -> int:
        return -1  # MuJoCo starts from the keyframe of the file

    def rows(self, x: Array) -> tuple[Array, Array]:
        self._data.qpos[:] = x
        self._mj.mj_fwdPosition(self._model, self._data)
        n = self._data.nefc
        return self._data.efc_pos[:n].copy(), self._data.efc_J.reshape(-1, self._model.nv)[:n]

    def moved(self, x: Array, change: Array) -> Array:
        x = x.copy()
        self._mj.mj_integratePos(self._model, x, change, 1.0)
        return x

    def _frame(self, end: tuple[str, int]) -> tuple[Array, Array]:
        kind, k = end
        d = self._data
        place, turn = (d.site_xpos, d.site_xmat) if kind == "site" else (d.xpos, d.xmat)
        return place[k].copy(), turn[k].reshape(3, 3).copy()

    def pose(self, x: Array) -> tuple[Array, Array]:
        self._data.qpos[:] = x
        self._mj.mj_kinematics(self._model, self._data)
        (o, B), (p, R) = map(self._frame, self._ends)
        return B.T @ (p - o), B.T @ R

    def energy(self, x: Array) -> float:
        self._data.qpos[:] = x
        self._mj.mj_fwdPosition(self._model, self._data)
        self._mj.mj_energyPos(self._model, self._data)
        return float(self._data.energy[0])

    def down(self, x: Array) -> Array:
        self._data.qpos[:] = x
        self._mj.mj_kinematics(self._model, self._data)
        return self._frame(self._ends[0])[1].T @ np.array([0.0, 0.0, -1.0])


def without_shapes(text: str) -> str:
    """Return an MJCF without what refers to other files: meshes, and geometries made of them."""
    root = ET.fromstring(text)
    for parent in root.iter():
        for part in list(parent):
            if part.tag in {
                "asset",
                "geom",
                "mesh",
                "extension",
                "plugin",
                "visual",
                "contact",
                "sensor",
                "tendon",
                "material",
            }:
                parent.remove(part)
    for actuators in root.findall("actuator"):
        for part in list(actuators):
            if "tendon" in part.attrib:
                actuators.remove(part)
    return ET.tostring(root, encoding="unicode")
