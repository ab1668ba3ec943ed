"""What the camera of the virtual cell sees. This module does not use ROS, as another process runs
it: rendering would hold up the threads of a node."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from parallel_cal.imaging.board import Board
from parallel_cal.imaging.drawing import encode_jpeg
from parallel_cal.virtual.board_camera import BoardCamera
from parallel_cal.virtual.camera import FlatBoard
from parallel_cal.virtual.robot import Array

BOARD, SQUARE_M = Board(8, 6), 0.03
PIXELS_PER_SQUARE = 56  # of the printed pattern: whole pixels per module of a marker
JPEG_QUALITY = 95  # its errors are below the noise of a sensor

Point = tuple[float, ...]


def render(middle: Point, pose: tuple[Array, Array] | None, seed: tuple[int, ...]) -> bytes:
    """Return the image of the board on a platform at a pose (3,), (3, 3) as JPEG; black without a
    pose.

    `middle` is the middle of the workspace, at which the camera looks.
    """
    view = make_view(middle)
    width, height = view.camera.size
    image = np.full((height, width), int(view.camera.imager.black), np.uint8)
    if pose is not None:
        image = view.photograph(*pose, np.random.default_rng(seed))
    return encode_jpeg(image, JPEG_QUALITY)


@lru_cache(maxsize=1)
def make_view(middle: Point) -> BoardCamera:
    """Return camera and board of a cell; the rays of its pixels are computed once."""
    flat = FlatBoard(BOARD.raster(PIXELS_PER_SQUARE), SQUARE_M / PIXELS_PER_SQUARE)
    return BoardCamera.below(flat, np.array(middle))
