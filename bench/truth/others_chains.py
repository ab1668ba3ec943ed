"""Closed chains from files of others: read, written back, moved by Pinocchio or MuJoCo, calibrated.

Put the repositories that `ROBOTS` names into one folder, each under its own name, and run

    .venv/bin/pip install mujoco pin
    .venv/bin/python -m bench.truth.others_chains FOLDER [NAME ...] [--hidden | --drawn]

For each robot, a model is made of its file, strays from the drawing by its tolerances, and is
written into a copy of the file. Pinocchio (URDF) or MuJoCo (MJCF) reads the copy: that is the true
robot (loop_peers.py). It must move as the model says. Then the position of its platform is
measured, and the model as drawn is calibrated with the measurements.

With `--hidden`, three more of these robots are diagnosed: one has a backlash of its first motor.
The others have a compliance of the motor that is loaded most: one under a payload and the weights
of its links, one under these weights alone.

With `--drawn`, only the motion of the file as it is drawn is compared.
"""

from __future__ import annotations

import re
import shutil
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import numpy as np
import typer

from bench.speed.loop_peers import MuJoCo, Peer, Pinocchio
from parallel_cal.base.errors import ParallelCalError
from parallel_cal.diagnosis.comparison import compare
from parallel_cal.diagnosis.diagnose import diagnose
from parallel_cal.exporting.export import export_into
from parallel_cal.identification.fit import fit
from parallel_cal.importing.closed_chain import chain
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.model import Model
from parallel_cal.recordings.dataset import Dataset

Array = np.ndarray

SHARE = 0.7  # of the tolerances, by which the true robot strays
POSES, UNSEEN, COMPARED = 80, 100, 200
# Noise of positions (m a coordinate) and readings (rad), and how far readings are from home (rad).
# Those of slides are these times the length of the model.
POSITION, READING, SPREAD = 1e-4, 3e-5, 0.3
BACKLASH, PAYLOAD = 4e-3, 10.0  # rad, kg
LOADED = ("joint_compliance", "own_weight_sag")  # effects of a compliance
GEPETTO, ANKLES = "example-parallel-robots/robots", "Parallel_Ankle_Joint"


@dataclass(frozen=True)
class Robot:
    """A file, and what `new --from` needs to know of it."""

    file: str
    base: str
    platform: str
    driven: Sequence[str] = ()
    locked: Sequence[str] = ()
    body: str = ""
    parallel: Sequence[str] = ()  # axes that are not tilted: plane loops do not close otherwise
    length_tolerance: float = 5e-4  # m
    angle_tolerance: float = float(np.radians(0.5))
    spread: float = SPREAD
    left_open: float = 1e-10  # m; by which redundant loops may stay open

    def read(self, path: Path) -> Model:
        """Make the model of a file of this robot."""
        more = {
            "driven": self.driven,
            "locked": self.locked,
            "length_tolerance": self.length_tolerance,
            "angle_tolerance": self.angle_tolerance,
        }
        return chain([path], self.base, self.platform, **more).model

    def copy(self, source: Path, folder: Path) -> Path:
        """Copy the file and its list of loops; a body that is the platform gets a site, where a
        reflector sits: the place of the body itself cannot be written."""
        for loops in source.parent.glob("*.yaml"):
            shutil.copy(loops, folder)
        text = source.read_text()
        if self.body:
            site = f'<site name="{self.platform}" pos="{SITE}"/>'
            text, count = re.subn(rf'(<body name=["\']{self.body}["\'][^>]*>)', rf"\1{site}", text)
            assert count == 1
        path = folder / source.name
        path.write_text(text)
        return path


SITE = "0.06 0.03 -0.05"  # m, in the body that is the platform
LEAF_SPRINGS = ("left-shin", "left-heel-spring")
ROBOTS = {
    name: Robot(f"{GEPETTO}/{name}/robot.urdf", base, platform, locked=locked)
    for name, base, platform, locked in (
        ("5bar_linkage", "built", "effector", ()),
        ("5bar_linkage_iso3d", "part_1", "effector", ()),
        ("5bar_linkage_iso6d", "part_1", "effector", ()),
        ("cassie_like", "pelvis", "foot", ()),
        ("digit_like", "torso", "foot", ()),
        ("talos_like", "buste", "foot", ()),
        ("battobot_6d", "hip_z_axis_2_leg_assembly", "foot_left", ()),
        ("digit_like_2legs", "torso", "foot", ()),
        ("disney_like", "hip_part", "foot", ("free_universal4",)),
        ("disney_robot", "torso", "right_foot", ()),
    )
} | {
    "wl16_like": Robot(f"{GEPETTO}/wl16_like/robot.urdf", "hip_part", "foot", spread=0.1),
    "kangaroo_like_2legs": Robot(  # short strokes
        f"{GEPETTO}/kangaroo_like_2legs/robot.urdf", "center_hip", "foot_right", spread=0.1
    ),
    "robot_delta": Robot(
        f"{GEPETTO}/robot_delta/robot.urdf", "built", "eff", parallel=("",), length_tolerance=1e-4
    ),
    "agility_cassie": Robot(
        "mujoco_menagerie/agility_cassie/cassie.xml",
        "cassie-pelvis",
        "reflector",
        locked=LEAF_SPRINGS,
        body="left-foot",
        parallel=("left-foot.",),
    ),
    "cassie of OSU": Robot(
        "cassie-mujoco-sim/model/cassie.xml",
        "cassie-pelvis",
        "reflector",
        locked=LEAF_SPRINGS,
        body="left-foot",
        left_open=0.01,
    ),
    "ankle of a G1": Robot(
        f"{ANKLES}/2_g1_ankle/urdf/23urdf311.xml", "base_link", "reflector", body="roll_link"
    ),
    "ankle of a Tiangong": Robot(
        f"{ANKLES}/5_tiangong/urdf/TG10-00.xml", "base_link", "reflector", body="foot_link"
    ),
    "orbita": Robot(
        "onshape-to-robot-examples/orbita_mujoco/robot.xml",
        "base",
        "reflector",
        body="platform",
        left_open=0.01,
    ),
    "spm": Robot(
        "placo-examples/models/spm/robot.xml",
        "moteur_bati",
        "reflector",
        driven=("m1", "m2", "m3"),
        body="4_supporthead",
        left_open=0.01,
    ),
    "planar-2dof": Robot("onshape-to-robot-examples/planar-2dof/robot.xml", "base", "effector"),
    "robotiq_2f85": Robot(
        "mujoco_menagerie/robotiq_2f85/2f85.xml",
        "base",
        "reflector",
        body="left_pad",
        driven=("left_driver_joint", "left_spring_link_joint"),
    ),
    "hexapod of raincut": Robot(
        "stewart_mujoco/stewart.xml", "base", "reflector", body="TOP_1", spread=0.1
    ),
    "five-bar of TumAro": Robot("5_bar/five_bar.xml", "world", "reflector", body="E1"),
    "leg of Charlotte-Nao": Robot(
        "wheel-leg-mujoco/model/leg.xml", "chassis", "reflector", body="link_BC"
    ),
}


@dataclass
class Case:
    """A model as drawn, a true robot, and readings that both can reach."""

    nominal: Model
    true: Model
    peer: Peer
    readings: Array
    robot: Robot

    @classmethod
    def make(cls, folder: Path, robot: Robot, seed: int, share: float = SHARE) -> Case:
        """Draw a true robot and write it into a copy of the file."""
        with TemporaryDirectory() as copy:
            path = robot.copy(folder / robot.file, Path(copy))
            return cls.written(path, robot, seed, share)

    @classmethod
    def written(cls, path: Path, robot: Robot, seed: int, share: float) -> Case:
        """Draw a true robot, which strays by a share of the tolerances, and write it into the
        file."""
        nominal = robot.read(path)
        rng = np.random.default_rng([seed, 1])
        step = rng.standard_normal(len(nominal.values)) * ~np.array(nominal.fixed)
        for k, name in enumerate(nominal.table.names):
            if name.endswith((".rx", ".ry")) and name.startswith(tuple(robot.parallel)):
                step[k] = 0.0
        true = nominal.with_values(nominal.values + share * nominal.table.tolerance * step)
        urdf = path.suffix == ".urdf"
        drawn = (Pinocchio if urdf else MuJoCo)(path, nominal, robot)
        drawn.left_open = robot.left_open
        drawn.begin(nominal)
        for remark in export_into(true, "urdf" if urdf else "mjcf", [path]).remarks:
            print(remark)
        peer = (Pinocchio if urdf else MuJoCo)(path, nominal, robot)
        peer.start, peer.left_open = drawn.start, robot.left_open
        peer.begin(true)
        low, high = np.transpose(nominal.mechanism.joint_limits)
        shifts = np.random.default_rng([seed, 2]).uniform(-1, 1, (800, len(low)))
        readings = np.clip(peer.home + robot.spread * unit_sizes(nominal) * shifts, low, high)
        return cls(nominal, true, peer, readings[Kinematics(nominal).direct(readings).ok], robot)

    def compared(self) -> tuple[float, float, int]:
        """Return the largest differences (m, rad) of the true model and the written file in the
        other program, and at how many configurations."""
        worst, n, solver = np.zeros(2), 0, Kinematics(self.true)
        for q in self.readings:
            found = solver.direct(q)
            try:
                r, R = self.peer.pose(self.peer.reach(q))
            except ValueError:
                continue
            if found.ok:
                apart = [np.abs(found.position - r).max(), np.abs(found.rotation - R).max()]
                worst, n = np.maximum(worst, apart), n + 1
            if n == COMPARED:
                break
        return float(worst[0]), float(worst[1]), n

    def session(self, seed: int, hidden: str = "") -> tuple[Dataset, Dataset]:
        """Visit poses twice with noise, and others once without."""
        rng = np.random.default_rng([seed, 3])
        made = list(self._visits(rng, hidden))
        visits, new = made[: 2 * POSES], made[2 * POSES :]
        return self._dataset(visits, rng, 1.0, hidden), self._dataset(new, rng, 0.0, hidden)

    def _visits(self, rng: np.random.Generator, hidden: str) -> Iterator[tuple[Any, ...]]:
        """Yield number, reading, position, rotation, sides of the last motions, payload."""
        done = 0
        play = BACKLASH * unit_sizes(self.nominal) * np.eye(len(self.nominal.joints))[0]
        loaded, compliance = 0, 0.0
        most = PAYLOAD if hidden == "joint_compliance" else 0.0
        if hidden in LOADED:
            loaded, compliance = self.compliance(most)
        for q in self.readings:
            visits = []
            try:
                x = self.peer.reach(q)
                for _ in range(2 if done < POSES else 1):
                    side, load, there = rng.choice([-1.0, 1.0], len(q)), 0.0, x
                    if hidden == "backlash":
                        there = self.peer.close(self.peer.state(x, q - side * play / 2))
                    elif hidden:
                        load = most * rng.random()
                        angle = q.copy()
                        for _ in range(3):  # the load depends on the deflection
                            there = self.peer.close(self.peer.state(there, angle))
                            torque = self.peer.torque(there, angle, load)[loaded]
                            angle = q.copy()
                            angle[loaded] += compliance * torque
                        there = self.peer.close(self.peer.state(there, angle))
                    visits.append((done, q, *self.peer.pose(there), side, load))
            except ValueError:  # out of reach, with the effect or without it
                continue
            yield from visits
            done += 1
            if done == POSES + UNSEEN:
                return
        raise ValueError(f"only {done} poses of {POSES + UNSEEN} can be reached")

    def compliance(self, payload: float) -> tuple[int, float]:
        """Return the number of the motor that a payload (kg) and the links load most, and a
        compliance that deflects it by the size of the backlash."""
        sizes = unit_sizes(self.nominal)
        loads = list[Array]()
        for q in self.readings:
            with suppress(ValueError):  # out of reach
                loads.append(self.peer.torque(self.peer.reach(q), q, payload))
            if len(loads) == 10:
                break
        usual = np.median(np.abs(loads), axis=0)  # Nm; N of a slide
        most = int(np.argmax(usual * sizes))
        return most, float(BACKLASH * sizes[most] / usual[most])

    def _dataset(
        self, visits: list[tuple[Any, ...]], rng: np.random.Generator, share: float, hidden: str
    ) -> Dataset:
        number, q, r, R, side, load = (np.array(part) for part in zip(*visits, strict=True))
        sigma = READING * unit_sizes(self.nominal)
        conditions = {"payload": load} if hidden == "joint_compliance" else {}
        if hidden == "backlash":
            sides = zip(self.nominal.joints, side.T, strict=True)
            conditions |= {f"direction.{joint}": each for joint, each in sides}
        return Dataset.from_arrays(
            self.nominal.joints,
            q + share * sigma * rng.standard_normal(q.shape),
            r + share * POSITION * rng.standard_normal(r.shape),
            R,
            measured=[True] * 3 + [False] * 3,
            pose_cov=np.diag([POSITION**2] * 3 + [1.0] * 3),  # orientations are not measured
            joint_sigma=sigma,
            pose_id=number,
            frame="base",
            conditions=conditions,
        )


def unit_sizes(model: Model) -> Array:
    """Return 1 rad for each turning joint and the length of the model for each slide."""
    m = model.mechanism
    return np.where(np.array(m.joint_units) == "m", m.length, 1.0)


def error(model: Model, data: Dataset) -> float:
    """Return the rms error of position of a model, um."""
    return 1e6 * float(np.sqrt(np.nanmean(compare(model, data).errors.norms("position") ** 2)))


def compare_drawn(name: str, folder: Path) -> None:
    """Print how far the model of a file and the file itself are apart."""
    case = Case.make(folder, ROBOTS[name], 0, share=0.0)
    apart, turned, n = case.compared()
    passive = len(case.nominal.mechanism.passive)
    print(f"{name}: {passive} passive coordinates, differs {apart:.0e} m {turned:.0e} at {n}")


def study(name: str, folder: Path, seed: int, hidden: bool) -> None:
    """Print a line for a robot."""
    begin = time.process_time()
    case = Case.make(folder, ROBOTS[name], seed)
    apart, turned, n = case.compared()
    print(f"{name} seed {seed}: written file differs {apart:.0e} m {turned:.0e} at {n}", flush=True)
    data, unseen = case.session(seed)
    result = fit(case.nominal, data)
    document = result.document()
    after, floor = (document[k] for k in ("held_out", "noise_floor"))
    print(
        f"| {name} | {len(case.nominal.values)} | "
        f"{error(case.nominal, unseen):.0f} um | {error(result.model, unseen):.0f} um | "
        f"{result.estimate.chi2_per_dof:.2f} | held out {1e6 * after['after']['position_rms']:.0f} "
        f"floor {1e6 * floor['position_rms']:.0f} | {time.process_time() - begin:.0f} s",
        flush=True,
    )
    for effect in ("backlash", *LOADED) if hidden else ():
        begin = time.process_time()
        data, _ = case.session(seed, effect)
        found = diagnose(case.nominal, data).document()
        print(
            f"  {name}: hidden {effect}: {found['verdict']}: {found['effects']} "
            f"{[c['effects'] for c in found['missing']]} {time.process_time() - begin:.0f} s",
            flush=True,
        )


def main(
    folder: Annotated[Path | None, typer.Argument(help="with the repositories of others")] = None,
    names: Annotated[list[str] | None, typer.Argument(help="robots; default: all")] = None,
    hidden: bool = False,
    drawn: bool = False,
    seeds: int = 1,
) -> None:
    """Compare and calibrate the robots of others."""
    if folder is None:
        print("not run: it needs the folder with the files of others")
        return
    for name in names or ROBOTS:
        for seed in range(seeds):
            try:
                if drawn:
                    compare_drawn(name, folder)
                else:
                    study(name, folder, seed, hidden)
            except (ParallelCalError, ValueError) as problem:
                print(f"{name} seed {seed}: {type(problem).__name__}: {problem}", flush=True)


if __name__ == "__main__":
    sys.exit(typer.run(main))
