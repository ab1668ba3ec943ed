"""A Delta, a hexapod and an arm as a camera or a tracker measures them, with true unseen poses."""

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import virtual_arm as va
import virtual_camera as vc
from arms import nominal
from scipy.optimize import least_squares

from parallel_cal.identification.position_uncertainty import compute_shape_covariance
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.model import Model, new_model
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.sensors.camera import Camera
from parallel_cal.virtual.machines import MACHINES
from parallel_cal.virtual.robot import SampleConditions, solve_true_pose, turn

ENCODER = {"delta": 1e-5, "stewart": 3e-6, "ur5": 1e-5}  # rad, m, rad
TRACKER = 30e-6  # m


@dataclass(frozen=True)
class Visits:
    """Joint readings (N, nq) without noise, directions (N, nq), true poses of the platform, and
    payloads (N,) in kg."""

    q: np.ndarray
    direction: np.ndarray
    r: np.ndarray
    R: np.ndarray
    payload: np.ndarray


@dataclass(frozen=True)
class Cell:
    """A built robot of one kind, `delta`, `stewart` or `ur5`, with hidden physics."""

    kind: str
    seed: int = 0
    effects: tuple[Any, ...] = ()  # of the virtual robots
    on_platform: bool = False
    lens: vc.Lens = field(default_factory=vc.Lens)
    board: vc.Board = field(default_factory=vc.Board)
    sigma: float = 0.3
    name: str = "camera"
    board_at: tuple[float, float, float] = (0.0, 0.0, 0.02)  # its middle on the platform, m
    payloads: tuple[float, ...] = ()  # kg, one after the other; empty: none, and none recorded

    @property
    def drawn(self) -> Model:
        if self.kind == "ur5":
            return nominal("ur5")
        return new_model({"delta": "delta54", "stewart": "stewart42"}[self.kind])

    def draw_poses(self, n: int, rng: np.random.Generator) -> Visits:
        """Draw poses in the workspace; every joint comes from either side."""
        if self.kind == "ur5":
            arm = va.arm("ur5", self.seed, hidden=self.effects)
            q = np.array(arm.home) + rng.uniform(-0.25, 0.25, (n, 6))
            direction = np.sign(np.diff(q, axis=0, prepend=np.array(arm.home)[None]))
            T = arm.reached(q, direction)
            return Visits(q, direction, T[:, :3, 3], T[:, :3, :3], np.zeros(n))
        robot = MACHINES[self.kind].make_built(self.seed)
        drawn = MACHINES[self.kind].make_nominal()
        if self.kind == "delta":
            q, _ = drawn.inverse(rng.uniform([-0.06, -0.06, 0.14], [0.06, 0.06, 0.26], (n, 3)))
            start = None
        else:
            r = rng.uniform([-0.04, -0.04, 0.27], [0.04, 0.04, 0.33], (n, 3))
            R = turn(rng.uniform(-0.17, 0.17, (n, 3)))
            q, *start = drawn.inverse(r, R)
            start = (r, R)
        direction = np.sign(np.diff(q, axis=0, prepend=q[-1:]))
        none, payload = np.zeros(n), np.resize(self.payloads or (0.0,), n)
        at = SampleConditions(none, none + 20.0, payload, direction)
        _, r, R = solve_true_pose(robot, self.effects, q, at, start)
        return Visits(q, direction, r, R, payload)

    def _record(self, at: Visits) -> dict[str, np.ndarray]:
        """Return the conditions that the controller records."""
        sides = {f"direction.{j}": at.direction[:, i] for i, j in enumerate(self.drawn.joints)}
        return sides | ({"payload": at.payload} if self.payloads else {})

    def camera(self) -> vc.Camera:
        """Place a camera 0.6 m from the board in the middle of the poses, tilted against it."""
        poses = Cell(self.kind, self.seed).draw_poses(40, np.random.default_rng(1))
        middle = poses.r.mean(axis=0)
        platform = poses.R[np.argmin(np.linalg.norm(poses.r - middle, axis=1))]
        size = np.array([self.board.columns, self.board.rows, 0]) * self.board.square / 2
        board_turn = turn(np.array([0.3, 0.2, 0.4]))
        if self.on_platform:
            pose = vc.frame(np.array([0.02, -0.03, 0.04]), turn(np.array([3.0, 0.2, 0.3])))
            # The board lies where the camera looks in the middle pose.
            centre = middle + platform @ (pose[:3, 3] + 0.6 * pose[:3, 2])
            flat = platform @ pose[:3, :3] @ board_turn
            return self._make(pose, vc.frame(centre - flat @ size, flat))
        eye = middle + [0.25, 0.1, 0.53]
        printed_up = board_turn @ turn(np.array([np.pi, 0.0, 0.0]))  # z points into the board
        mount = vc.frame(np.array(self.board_at) - printed_up @ size, printed_up)
        return self._make(vc.look_at(eye, middle, 0.1), mount)

    def _make(self, pose: np.ndarray, mount: np.ndarray) -> vc.Camera:
        return vc.Camera(pose, mount, self.lens, self.board, self.on_platform, self.sigma)

    def sensor(self, **options: Any) -> Camera:
        return Camera(
            self.board.columns,
            self.board.rows,
            self.board.square,
            self.lens.size,
            mounted="platform" if self.on_platform else "fixed",
            model="fisheye" if self.lens.fisheye else "pinhole",
            name=self.name,
            **options,
        )

    def seen_by_camera(self, n: int = 60, seed: int = 0) -> Dataset:
        rng = np.random.default_rng([seed, 5])
        at = self.draw_poses(n, rng)
        camera = self.camera()
        return self._dataset(at, rng, vc.as_conditions(camera.see(at.r, at.R, rng), self.name))

    def seen_by_tracker(self, n: int = 60, seed: int = 0) -> Dataset:
        """Positions of a target beside the platform's centre, in a frame of the tracker."""
        rng = np.random.default_rng([seed, 5])
        at = self.draw_poses(n, rng)
        r = at.r + at.R @ [0.02, -0.03, 0.05] + TRACKER * rng.standard_normal(at.r.shape)
        spin = turn(np.array([0.2, -0.4, 2.0]))
        return self._dataset(at, rng, {}, (r - [2.1, -1.3, 0.4]) @ spin)

    def _dataset(
        self, at: Visits, rng: np.random.Generator, readings: dict, r: np.ndarray | None = None
    ) -> Dataset:
        joints = self.drawn.joints
        return Dataset.from_arrays(
            joints,
            at.q + ENCODER[self.kind] * rng.standard_normal(at.q.shape),
            np.zeros((len(at.q), 3)) if r is None else r,
            measured=[r is not None] * 3 + [False] * 3,
            pose_cov=np.diag([TRACKER**2] * 3 + [1.0] * 3),
            joint_sigma=[ENCODER[self.kind]] * len(joints),
            conditions=readings | self._record(at),
            source="virtual camera" if r is None else "virtual tracker",
            frame="" if r is None else "tracker",
        )

    def error_at_unseen_poses(self, model: Model, n: int = 200) -> float:
        """Rms distance (m) of predicted and true positions of poses that no fit has seen, after the
        best frames of base and platform: no measurement of poses determines these."""
        return float(
            np.sqrt(np.mean(np.sum(self.errors_at_unseen_poses(model, n)[0] ** 2, axis=1)))
        )

    def moved_by_effects(self, n: int = 200) -> float:
        """Rms distance (m) by which the hidden physics displaces the platform at unseen poses."""
        poses = [
            cell.draw_poses(n, np.random.default_rng([self.seed, 99]))
            for cell in (self, replace(self, effects=()))
        ]
        apart = poses[0].r - poses[1].r
        return float(np.sqrt(np.mean(np.sum(apart**2, axis=1))))

    def errors_at_unseen_poses(
        self, model: Model, n: int = 200
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """Return these differences (n, 3) m, and the sigmas (n, 3) m that the model states."""
        at = self.draw_poses(n, np.random.default_rng([self.seed, 99]))
        recorded = self._record(at)
        reached = Kinematics(model).direct(at.q, recorded)

        def away(u: np.ndarray) -> np.ndarray:
            shown = (at.r + at.R @ u[6:]) @ turn(u[:3]).T + u[3:6]
            return (shown - reached.position).ravel()

        left = away(least_squares(away, np.zeros(9), x_scale="jac").x).reshape(-1, 3)
        spread = compute_shape_covariance(model, at.q, recorded)
        if spread is None:
            return left, None
        return left, np.sqrt(np.diagonal(spread, axis1=1, axis2=2))
