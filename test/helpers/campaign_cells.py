"""A campaign's cell without ROS: the virtual robot's messages, made samples as simply as can be."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
from camera_cells import Cell as PixelCell
from virtual_camera import as_conditions

from parallel_cal.campaign.cell import CellError, Sample, UnseenError
from parallel_cal.campaign.path_guard import Guard
from parallel_cal.campaign.targets import first_targets
from parallel_cal.campaign.trajectory import plan_trajectory
from parallel_cal.identification.fit import fit
from parallel_cal.model.file.modelfile import dump_model, parse_model, read_model
from parallel_cal.model.model import Noise, new_model
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.recordings.joining import join_datasets
from parallel_cal.virtual.cell import Cell
from parallel_cal.virtual.kinds import KINDS
from parallel_cal.virtual.tracker import Tracker

PRESETS = Path(__file__).parents[2] / "config"
SETTLING = 0.3  # s after which the robot rests
# What whoever drew it knows of it: parts may be printed or cast of polymers, 20e-6..90e-6 /K.
OF_POLYMERS = {"thermal_expansion.*.alpha": 50e-6}
MIN_CORNERS = 6  # of an image that shows a pose
REST, MOVING = 0.8, 4.0  # s a sample takes; sigmas of a reading by which a direction counts


def model_of(robot):
    """The model of the robot as drawn, with its instruments' accuracy and its drives' limits."""
    cell = Cell(robot)
    noise = cell.machine.noise
    if robot == "delta":
        model = read_model(PRESETS / "delta_mockup_nominal.yaml")
    else:
        name = {"stewart": "stewart42", "argos": "argos9", "linear_delta": "linear_delta"}[robot]
        model = new_model(name)
        given = cell.machine.nominal
        values = [given.get(n, v) for n, v in model.table.mapping(model.values).items()]
        model = model.with_values(np.array(values))
    position = noise.position if cell.machine.sees_position else None
    model = replace(
        model,
        noise=Noise(noise.joint, position, noise.orientation),
        tolerances=OF_POLYMERS if robot in KINDS["warmth"].machines else {},
    )
    limits = cell.machine.limits
    model.mechanism.joint_rates = ((limits.velocity, limits.acceleration),) * len(model.joints)
    return parse_model(dump_model(model))


class SimulatedCell:
    """Drives the virtual robot in its own time; a person does at once what is asked."""

    def __init__(self, robot="delta", seed=0, effects=(), **given):
        # Few poses, and those while it rests, are enough: solving them takes most of the time.
        given = {"period": 0.02, "tracker": Tracker(period=0.2)} | given
        self.cell = Cell(robot, seed, effects, **given)
        self.asked, self.sent, self.lines = [], [], []
        n = len(self.cell.machine.joints)
        self._furthest, self._direction = None, np.zeros(n)
        self._turned = None
        self._read(self.cell.advance(0.5))

    def joints(self):
        return self._q

    def move(self, trajectory, go_on):
        go_on()
        self.sent.append(trajectory)
        self.cell.follow(trajectory.time, trajectory.positions, trajectory.velocities)
        end = self.cell.time + trajectory.seconds + SETTLING
        while self.cell.time < end:
            self._read(self.cell.advance(self.cell.time + 0.2))
            go_on()

    def stop(self):
        self.cell.stop()
        self._read(self.cell.advance(self.cell.time + 0.5))

    def ask(self, words, conditions, go_on):
        go_on()
        self.asked.append(words)
        self.cell.change(**conditions)

    def sample(self, go_on):
        go_on()
        seen = self.cell.advance(self.cell.time + REST)
        self._read(seen)
        late = len(seen.r) // 4
        r, R = seen.r[late:], seen.R[late:]
        if not len(r):
            raise CellError("no pose was received while the robot rested")
        time = self.cell.time - REST / 2
        q = seen.q[len(seen.q) // 4 :].mean(axis=0)
        at = {
            "time": time,
            "payload": self.cell.now.payload,
            "temperature": float(self.cell.temperature(time)),
        }
        for i, joint in enumerate(self.cell.machine.joints):
            at[f"direction.{joint}"] = self._direction[i]
            at[f"travel.{joint}"] = q[i] - self._turned[i]
        noise = self.cell.machine.noise
        measured = np.array([self.cell.machine.sees_position] * 3 + [True] * 3)
        u, _, v = np.linalg.svd(R.mean(axis=0))
        sample = Dataset.from_arrays(
            self.cell.machine.joints,
            q[None],
            r.mean(axis=0)[None] * measured[:3],
            (u @ v)[None],
            measured=measured,
            joint_sigma=noise.joint,
            pose_cov=np.diag([noise.position**2] * 3 + [noise.orientation**2] * 3),
            conditions={key: [value] for key, value in at.items()},
            pose_id=[0],
        )
        return Sample(sample, 1)

    def _read(self, seen):
        """Joints, the signs of their last motion, and where each last turned back."""
        if not len(seen.q):
            return
        if self._furthest is None:
            self._furthest, self._turned = seen.q[0].copy(), seen.q[0].copy()
        clear = MOVING * self.cell.machine.noise.joint
        for q in seen.q:
            moved = q - self._furthest
            turned = (np.abs(moved) > clear) & (np.sign(moved) != self._direction)
            self._turned = np.where(turned, self._furthest, self._turned)
            self._direction = np.where(turned, np.sign(moved), self._direction)
            on = (moved * self._direction > 0) | turned
            self._furthest = np.where(on, q, self._furthest)
        self._q = seen.q[-1]


class CameraCell(SimulatedCell):
    """The virtual Delta before a camera: its samples are pixels of a board's corners."""

    def __init__(self, robot="delta", seed=0, effects=(), **given):
        seen = PixelCell(robot)
        self.camera, self.sensor = seen.camera(), seen.sensor()
        self._rng = np.random.default_rng([seed, 7])
        super().__init__(robot, seed, effects, **given)

    def sample(self, go_on):
        pose = super().sample(go_on)
        r, R = self.cell.true_pose()
        pixels = self.camera.see(r[None], R[None], self._rng)
        if np.isfinite(pixels).all(axis=2).sum() < MIN_CORNERS:
            raise UnseenError("the image shows fewer than 6 corners of the board")
        data = pose.dataset
        return Sample(
            Dataset.from_arrays(
                data.joint_names,
                data.q,
                np.zeros((1, 3)),
                measured=[False] * 6,
                joint_sigma=data.joint_sigma,
                conditions=dict(data.conditions) | as_conditions(pixels),
                pose_id=[0],
            ),
            1,
        )


def visit(cell, model, targets):
    """Samples of a cell at targets, without a campaign."""
    guard, samples = Guard.of(model), []
    for target in targets:
        path = guard.plan_path(cell.joints(), [np.array(target.joints)])
        cell.move(plan_trajectory(path, model.mechanism), lambda: None)
        samples.append(cell.sample(lambda: None).dataset)
    return join_datasets(samples, [1] * len(samples))


@cache
def calibrated(seed):
    """The text of the model of a virtual Delta that was calibrated at 40 poses."""
    model = model_of("delta")
    data = visit(SimulatedCell(seed=seed), model, first_targets(Guard.of(model), 50)[:40])
    result = fit(model, data, hold_out=0.0)
    return dump_model(replace(result.model, history=(result.history_entry(),)))
