"""The corners of a printed board in live images that were taken while the robot rests."""

from __future__ import annotations

import math
import time
from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from threading import Lock
from typing import Any

import numpy as np

from parallel_cal.imaging.board import read_board
from parallel_cal.imaging.detection import Corners, Detector, Grey
from parallel_cal.imaging.folder import find_blur_limit
from parallel_cal.imaging.messages import decode_image
from parallel_cal.recordings.pose_messages import stamp_of

MAX_RESTS = 1000  # standstills that are remembered: minutes, however late an image comes
# Relative to a joint's range: coarse, because the dwells of the samples decide afterwards.
REST_SHARE = 1e-3
DEFAULT_REST_TOLERANCE = 2e-3  # rad or m, without a model
JOINT_STATE_WAIT_S = 1.0  # s until the joint states of an image's time must have come
POLL_INTERVAL_S = 0.01
# A stamp that is further from the joint states belongs to another clock.
MAX_STAMP_DISTANCE_S = 60.0
# In one standstill, an image is searched when it has lasted so many times as long as at the one
# before: early in a short rest, seldom in a long one.
REST_GROWTH = 1.8
MIN_IMAGES_FOR_BLUR = 5

Message = tuple[Any, dict[str, int]]  # a message, and when the middleware received it


class RestMemory:
    """Remembers when the robot stood still, from joint states in the order of their stamps."""

    def __init__(self, joints: Callable[[], Sequence[str] | None], tolerance: Callable[[], Any]):
        """`joints` are the names of the robot's joints; `tolerance` is how far they may deviate."""
        self._joints, self._tolerance = joints, tolerance
        self._names: tuple[str, ...] = ()
        self._level: np.ndarray | None = None  # readings at the beginning of this rest
        self._rests: deque[list[float]] = deque(maxlen=MAX_RESTS)  # first and last stamp of each
        self._lock = Lock()

    @property
    def latest(self) -> float | None:
        """The stamp (s) of the newest joint state; None before the first one."""
        return self._rests[-1][1] if self._rests else None

    def add(self, message: Any) -> None:
        """Take a joint state; those of other joints are ignored."""
        wanted = self._joints() or self._names or tuple(message.name)
        if not set(wanted) <= set(message.name):
            return
        names = list(message.name)
        q = np.array([message.position[names.index(name)] for name in wanted])
        stamp = 1e-9 * stamp_of(message)
        with self._lock:
            self._names = tuple(wanted)
            if self._rests and stamp < self._rests[-1][1] - 1.0:  # another clock, or a new run
                self._rests.clear()
            level = self._level
            if (
                not self._rests
                or level is None
                or level.shape != q.shape
                or (np.abs(q - level) > self._tolerance()).any()
            ):
                self._level = q
                self._rests.append([stamp, stamp])
            else:
                self._rests[-1][1] = max(stamp, self._rests[-1][1])

    def find_rest(self, stamp: float) -> tuple[float, float] | None:
        """Return when the rest at a time began, and its last known time (s); None in motion."""
        with self._lock:
            found = [(a, b) for a, b in self._rests if a <= stamp <= b]
        return found[-1] if found else None


@dataclass(frozen=True)
class SeenBoard:
    """The corners in an image of one camera, as a message that the collector takes.

    `message` is the image on `topic`, `received` when it arrived (ns), and `stamp` its time (ns).
    """

    camera: str
    corners: Corners
    stamp: int
    received: int
    topic: str
    message: Any = field(repr=False)


@dataclass(frozen=True)
class Look:
    """An image that was searched for the board, and in words what it showed."""

    camera: str
    image: Grey
    corners: Corners
    words: str


class LiveImages:
    """Searches the images of one camera, in the thread that calls `take`.

    `on_board` takes the corners of an image that can be used. `on_unusable` takes the time of
    reception (ns) and the reason, if the robot rested and the image shows too little. `on_look`
    takes every image that was searched.
    """

    def __init__(
        self,
        camera: str,
        topic: str,
        board: str,
        rests: RestMemory,
        settling_time: Callable[[], float],
        on_board: Callable[[SeenBoard], None],
        on_unusable: Callable[[int, str], None],
        on_look: Callable[[Look], None],
    ):
        self.camera, self.topic = camera, topic
        self._detector = Detector(read_board(board))
        self._rests, self._settling_time = rests, settling_time
        self._on_board, self._on_unusable, self._on_look = on_board, on_unusable, on_look
        self._searched = (-math.inf, 0.0)  # begin of the rest searched last, and its length then
        self._widths: list[float] = []
        self.counts: Counter[str] = Counter()
        self.reasons: Counter[str] = Counter()
        self.last = "no image received yet"

    def take(self, received: Sequence[Message]) -> None:
        """Search those images that were taken while the robot rested."""
        for message, info in received:
            self.counts["received"] += 1
            arrived = info.get("received_timestamp") or time.time_ns()
            stamp = stamp_of(message) or arrived
            rest = self._wait_for_rest(1e-9 * stamp)
            if rest is None or rest[1] < self._settling_time():
                self.counts["in motion"] += 1
                continue
            begin, length = rest
            if begin == self._searched[0] and length < REST_GROWTH * self._searched[1]:
                self.counts["not needed: the rest has others"] += 1
                continue
            self._searched = begin, length
            self._search(message, stamp, arrived)

    def _wait_for_rest(self, stamp: float) -> tuple[float, float] | None:
        """Return when the rest at a time (s) began and how long it had lasted; None in motion."""
        end = time.monotonic() + JOINT_STATE_WAIT_S
        while (latest := self._rests.latest) is None or latest < stamp:
            apart = 0.0 if latest is None else stamp - latest
            if time.monotonic() > end or apart > MAX_STAMP_DISTANCE_S:
                break
            time.sleep(POLL_INTERVAL_S)
        if latest is None:
            self._refuse("no joint states were received: it is not known whether the robot rested")
        elif abs(stamp - latest) > MAX_STAMP_DISTANCE_S:
            self._refuse(
                f"its stamp is {stamp - latest:+.0f} s from the joint states: the camera needs the "
                "clock of the joints"
            )
        elif found := self._rests.find_rest(stamp):
            return found[0], stamp - found[0]
        return None

    def _search(self, message: Any, stamp: int, arrived: int) -> None:
        self.counts["searched"] += 1
        try:
            image = decode_image(message)
            corners = self._detector.detect(image)
        except Exception as error:  # OpenCV may raise anything, and the thread must not end
            self._refuse(str(error))
            self._on_unusable(arrived, self.last)
            return
        problem = corners.problem or self._explain_blur(corners.edge_width)
        words = problem or (
            f"{len(corners.numbers)} of {self._detector.board.corner_count} corners, edges "
            f"{corners.edge_width:.1f} px wide"
        )
        corners = replace(corners, problem=problem)
        if corners.excluded:
            words += f"; {len(corners.excluded)} corners excluded, because the others contradict"
        if problem:
            self._refuse(words)
            self._on_unusable(arrived, self.last)
        else:
            self.counts["used"] += 1
            self.last = f"{self.camera}: {words}"
            self._on_board(SeenBoard(self.camera, corners, stamp, arrived, self.topic, message))
        self._on_look(Look(self.camera, image, corners, words))

    def _explain_blur(self, width: float) -> str:
        """Return why an image is blurred, compared with those before it; empty if it is not."""
        if not math.isfinite(width):
            return ""
        self._widths.append(width)
        if len(self._widths) < MIN_IMAGES_FOR_BLUR:
            return ""
        limit = find_blur_limit(np.array(self._widths))
        usual = float(np.median(self._widths))
        return (
            f"blurred: its edges are {width:.1f} px wide, usual are {usual:.1f} px"
            if width > limit
            else ""
        )

    def _refuse(self, why: str) -> None:
        self.counts["not used"] += 1
        self.reasons[why.partition(":")[0]] += 1
        self.last = f"{self.camera}: image not used: {why}"

    def items(self) -> dict[str, str]:
        """Return counts and reasons as text, for diagnostics."""
        counts = {f"images {what}": str(n) for what, n in self.counts.items()}
        reasons = {f"not used: {why}": str(n) for why, n in self.reasons.items()}
        return {"topic": self.topic, **counts, **reasons, "last image": self.last}

    @property
    def warning(self) -> str:
        """Say that no image can be used, if several came and none can; else empty."""
        if self.counts["used"] or self.counts["received"] < MIN_IMAGES_FOR_BLUR:
            return ""
        if not (self.counts["searched"] or self.reasons):
            return (
                f"{self.camera}: {self.counts['received']} images on {self.topic}, none while the "
                "robot rested: let it rest, or state still_tolerance"
            )
        return f"{self.camera}: none of {self.counts['received']} images can be used; {self.last}"
