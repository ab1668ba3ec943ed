"""Images of a board in the hands of a virtual camera, with the true pixels of its corners."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from parallel_cal.imaging.board import Board
from parallel_cal.virtual.camera import Camera, FlatBoard

SQUARE = 0.03
LENS = (-0.2, 0.05, 0.001, -0.0005, 0.0)


def printed(board=None, square=SQUARE):
    """The board as it is printed, in true size."""
    return FlatBoard((board or Board()).raster(56), square / 56)


def corners_in_camera(board, r, R, square=SQUARE):
    """The board's corners (n, 3) in the camera's frame, m."""
    flat = np.c_[square * board.corners, np.zeros(board.corner_count)]
    return flat @ R.T + r


@dataclass(frozen=True)
class Shot:
    """An image, and where the corners of its board truly are in it."""

    image: np.ndarray
    pixels: np.ndarray


def poses(n, seed=0, tilt=0.5, near=0.45, far=0.75):
    """Poses of the board in front of the camera, its middle near the axis, tilted by `tilt`."""
    rng = np.random.default_rng(seed)
    for _ in range(n):
        R = Rotation.from_rotvec(rng.uniform(-tilt, tilt, 3)).as_matrix()
        middle = np.array([4 * SQUARE, 3 * SQUARE, 0.0])
        yield rng.uniform([-0.1, -0.08, near], [0.1, 0.08, far]) - R @ middle, R


def shots(n, camera=None, board=None, seed=0, noisy=True, **where):
    """n shots of a board at random poses."""
    camera, board = camera or Camera(distortion=LENS), board or Board()
    rng, flat = np.random.default_rng([seed, 1]), printed(board)
    for r, R in poses(n, seed, **where):
        image = camera.render(flat, r, R, rng if noisy else None)
        yield Shot(image, camera.project(corners_in_camera(board, r, R)))
