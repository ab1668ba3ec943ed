"""A camera beside a robot that holds a printed board: where both are, and its images."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from parallel_cal.virtual.camera import Camera, FlatBoard, Grey
from parallel_cal.virtual.robot import Array, turn

LENS = (-0.18, 0.06, 4e-4, -3e-4)  # k1 k2 p1 p2
DISTANCE = 0.6  # m from the middle of the board
BELOW_PLATFORM = 0.05  # m
CAMERA_TURN = np.array([0.5, 0.15, 0.0])  # oblique: a board parallel to the image tells little
BOARD_TURN = np.array([0.02, -0.01, 0.3])


def usual_camera() -> Camera:
    """Return a camera of 1.3 Mpx with a distorted lens."""
    return Camera(focal=(1210.0, 1206.0), centre=(644.0, 508.0), distortion=LENS)


@dataclass(frozen=True, eq=False)
class BoardCamera:
    """A camera at (`r`, `R`) in {B}, and a board at (`board_r`, `board_R`) in {P}."""

    board: FlatBoard
    r: Array
    R: Array
    board_r: Array
    board_R: Array
    camera: Camera = field(default_factory=usual_camera)

    @classmethod
    def below(cls, board: FlatBoard, middle: Array) -> BoardCamera:
        """Place the board under the platform, and the camera obliquely below the middle of the
        workspace (3,), so that it sees the board there."""
        board_R = turn(BOARD_TURN)  # z points into the board, up to the platform
        width, height = board.size
        down = np.array([0.0, 0.0, -BELOW_PLATFORM])
        R = turn(CAMERA_TURN)
        eye = middle + down - R @ [0.0, 0.0, DISTANCE]
        board_r = down - board_R @ [width / 2, height / 2, 0.0]
        return cls(board, eye, R, board_r, board_R)

    def find_board(self, r: Array, R: Array) -> tuple[Array, Array]:
        """Return the pose of the board in the camera's frame, of a platform at (3,), (3, 3)."""
        position, rotation = r + R @ self.board_r, R @ self.board_R
        return self.R.T @ (position - self.r), self.R.T @ rotation

    def photograph(self, r: Array, R: Array, rng: Any = None) -> Grey:
        """Render the image of a platform at (3,), (3, 3)."""
        return self.camera.render(self.board, *self.find_board(r, R), rng)
