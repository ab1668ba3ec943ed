"""The camera of the virtual cell: renders an image whenever the robot rests."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from typing import Any

import numpy as np
from rclpy.node import Node
from sensor_msgs.msg import CompressedImage

from parallel_cal.base.errors import ParallelCalError
from parallel_cal.base.worker import Worker
from parallel_cal.nodes.calibrate import CELL_IMAGES
from parallel_cal.nodes.parameters import RELIABLE
from parallel_cal.nodes.rendering import render
from parallel_cal.virtual.cell import Cell

SETTLING_TIME_S = 0.25  # s of rest before the first image
PERIOD_S = 2.0  # s between the first two images of one rest
# The next image comes when the rest has lasted so many times as long as at the one before: a robot
# that waits for a computation needs few, and rendering would slow the computation down.
REST_GROWTH = 2.0


class Photographer:
    """Publishes `camera/image_raw/compressed`, stamped by the robot's clock.

    An image takes a tenth of a second of processor time. Another process renders it, and it comes
    that much later than its stamp, as the images of a slow camera do.
    """

    def __init__(self, node: Node, cell: Cell, seed: int, stamp: Callable[[float], Any]):
        middle, _ = cell.true_pose()
        self._middle = tuple(middle.tolist())
        self._cell, self._stamp, self._seed, self._count = cell, stamp, seed, 0
        self._worker = Worker()
        # A raw image of 1.3 MB fills the buffers of the network, so that joint states are late.
        self._images = node.create_publisher(CompressedImage, CELL_IMAGES, RELIABLE)
        self._waiting = ThreadPoolExecutor(1, thread_name_prefix="camera")
        self._rendering: Future[None] | None = None
        self._rested, self._taken = 0.0, -np.inf  # times in the cell, s

    def watch(self) -> None:
        """Take an image if it is time for one; call it after each step of the cell."""
        now = self._cell.time
        if not self._cell.idle:
            self._rested, self._taken = now, -np.inf
            return
        busy = self._rendering is not None and not self._rendering.done()
        if busy or now < self._find_next_time():
            return
        self._taken = now
        pose = None if self._cell.now.lost_target else self._cell.true_pose()
        self._rendering = self._waiting.submit(self._render, now, pose)

    def _find_next_time(self) -> float:
        """Return when the next image of this rest is due, s."""
        if self._taken == -np.inf:
            return self._rested + SETTLING_TIME_S
        return self._taken + max(PERIOD_S, (REST_GROWTH - 1) * (self._taken - self._rested))

    def close(self) -> None:
        """End the process that renders; the node is destroyed next."""
        self._worker.end()
        self._waiting.shutdown(wait=True, cancel_futures=True)

    def _render(self, time: float, pose: tuple[Any, Any] | None) -> None:
        self._count += 1
        seed = (self._seed, 61, self._count)
        try:
            image = self._worker.work(render, self._middle, pose, seed)
        except ParallelCalError:  # the node ends
            return
        message = CompressedImage(format="mono8; jpeg compressed", data=image)
        message.header.stamp, message.header.frame_id = self._stamp(time), "camera"
        with suppress(Exception):  # the node may be destroyed meanwhile
            self._images.publish(message)
