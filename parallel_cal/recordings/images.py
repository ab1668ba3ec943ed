"""The corners of a board in the images of a recording, as readings over time.

Only images that were taken while the robot stood still are used. Of each standstill, the sharpest
few are searched for the board, as they are read: no more images are kept in memory.
"""

from __future__ import annotations

import heapq
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from parallel_cal.base.errors import BagError
from parallel_cal.imaging.board import read_board
from parallel_cal.imaging.detection import Corners, Detector, Grey
from parallel_cal.imaging.folder import find_blur_limit
from parallel_cal.imaging.messages import decode_image
from parallel_cal.imaging.opencv import ImageError, load_opencv
from parallel_cal.recordings.dwells import still_intervals
from parallel_cal.recordings.options import ReadOptions
from parallel_cal.recordings.pose_messages import stamp_of
from parallel_cal.recordings.recording import Dropped, Recording, ScalarStream
from parallel_cal.recordings.samples import max_gap
from parallel_cal.recordings.sampling import find_tolerance

MAX_IMAGES_PER_DWELL = 3  # more cost time and add little: their errors are alike
MAX_WIDTH_FOR_SHARPNESS = 640  # px; a smaller image shows as well which one is sharpest


def camera_topics(images: str | Iterable[str]) -> dict[str, str]:
    """Return the topic of each camera: `camera`, `camera2`, ... in the order of the topics."""
    topics = [images] if isinstance(images, str) else list(images)
    return {
        "camera" if k == 0 else f"camera{k + 1}": topic
        for k, topic in enumerate(filter(None, topics))
    }


@dataclass
class ImageReader:
    """Takes the images of one camera in their order, and keeps the corners of a board.

    `recording` tells when the robot stood still.
    """

    camera: str
    topic: str
    recording: Recording
    options: ReadOptions
    found: list[tuple[float, Corners]] = field(default_factory=list)
    problems: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))
    count: int = 0
    at_rest: int = 0

    def __post_init__(self) -> None:
        self._detector = Detector(read_board(self.options.board))
        # The calm part of each standstill, s.
        joints, options = self.recording.joints, self.options
        tolerance = find_tolerance(joints, options)
        intervals = still_intervals(
            joints.time, joints.position, tolerance, options.min_dwell / 3, max_gap(joints, options)
        )
        starts = [joints.time[one.first] + options.trim_start for one in intervals]
        ends = [joints.time[one.last] - options.trim_end for one in intervals]
        self._starts, self._ends = np.array(starts, float), np.array(ends, float)
        self._dwell, self._order = -1, 0
        self._sharpest: list[tuple[float, int, float, Grey]] = []

    def take(self, log: int, message: Any) -> None:
        """Take an image message and its log time (ns)."""
        self.count += 1
        stamp = log if self.options.stamps == "log" else stamp_of(message) or log
        time = (stamp - self.recording.start_ns) * 1e-9
        dwell = int(np.searchsorted(self._starts, time, side="right")) - 1
        if dwell < 0 or time > self._ends[dwell]:
            return
        self.at_rest += 1
        try:
            image = decode_image(message)
        except ImageError as error:
            self.problems[str(error)].append(time)
            return
        if dwell != self._dwell:
            self._search()
            self._dwell = dwell
        self._order += 1
        entry = _sharpness(image), self._order, time, image
        if len(self._sharpest) < MAX_IMAGES_PER_DWELL:
            heapq.heappush(self._sharpest, entry)
        else:
            heapq.heappushpop(self._sharpest, entry)

    def add_problem(self, reason: str, log: int) -> None:
        """Count a message that cannot be used, by its log time (ns)."""
        self.problems[reason].append((log - self.recording.start_ns) * 1e-9)

    def finish(self) -> tuple[dict[str, ScalarStream], list[Dropped], list[str]]:
        """Return the pixels of each corner over time, unusable images, and notes.

        BagError if no image shows the board.
        """
        self._search()
        searched = len(self.found)
        self._reject_blurred()
        usable = [(time, one) for time, one in self.found if not one.problem]
        for time, one in self.found:
            if one.problem:
                self.problems[one.problem].append(time)
        if not usable:
            reasons = "; ".join(f"{why} ({len(at)})" for why, at in self.problems.items())
            raise BagError(
                f"{self.topic}: none of {self.count} images can be used; {self.at_rest} were taken "
                f"while the robot stood still ({reasons or 'none of them shows the board'}). "
                f"The board {self._detector.board.text} was stated: check --data board=, and that "
                "images are stamped by the clock of the joints (--data stamps=log)"
            )
        values: dict[str, tuple[list[float], list[float]]] = defaultdict(lambda: ([], []))
        for time, one in sorted(usable, key=lambda item: item[0]):
            for number, pixel in zip(one.numbers.tolist(), one.pixels.tolist(), strict=True):
                for axis, value in zip("uv", pixel, strict=True):
                    times, pixels = values[f"{self.camera}.{number}.{axis}"]
                    times.append(time)
                    pixels.append(value)
        streams = {
            name: ScalarStream(self.topic, np.array(times), np.array(pixels))
            for name, (times, pixels) in sorted(values.items(), key=_by_number)
        }
        dropped = [
            Dropped(at[0], f"{self.camera}: {why}", f"{len(at)} images of {self.topic}", len(at))
            for why, at in self.problems.items()
        ]
        excluded = sum(len(one.excluded) for _, one in usable)
        width, height = usable[0][1].size
        note = (
            f"{self.camera}: {self.topic} has {self.count} images of {width} x {height} px; "
            f"{self.at_rest} at rest, of which the {searched} sharpest were searched and "
            f"{len(usable)} are used"
        )
        if excluded:
            note += f"; {excluded} corners were excluded, because the others contradict them"
        return streams, dropped, [note]

    def _search(self) -> None:
        """Search the sharpest images of the present standstill."""
        for _, _, time, image in sorted(self._sharpest, key=lambda item: item[2]):
            self.found.append((time, self._detector.detect(image)))
        self._sharpest = []

    def _reject_blurred(self) -> None:
        widths = np.array([one.edge_width for _, one in self.found])
        if not np.isfinite(widths).any():
            return
        limit = find_blur_limit(widths)
        self.found = [
            (time, replace(one, problem="blurred", detail=f"edges {width:.1f} px wide"))
            if width > limit and not one.problem
            else (time, one)
            for (time, one), width in zip(self.found, widths, strict=True)
        ]


def _sharpness(image: Grey) -> float:
    """Return the variance of the second derivative, relative to the mean grey level."""
    cv2 = load_opencv()
    scale = min(1.0, MAX_WIDTH_FOR_SHARPNESS / image.shape[1])
    if scale < 1.0:
        image = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return float(cv2.Laplacian(image, cv2.CV_32F).var()) / max(float(image.mean()), 1.0) ** 2


def _by_number(item: tuple[str, Any]) -> tuple[int, str]:
    _, number, axis = item[0].split(".")
    return int(number), axis
