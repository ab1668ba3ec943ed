"""The images of a folder, with the corners of a board in each or the reason why it is unusable."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from parallel_cal.base.progress import Progress, ignore_progress
from parallel_cal.base.threads import single_threaded
from parallel_cal.imaging.board import Array, Board
from parallel_cal.imaging.detection import Corners, Detector, read_image
from parallel_cal.imaging.opencv import ImageError

SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".pgm", ".ppm")
# An image is blurred if its edges are wider than those of the other images by both measures.
MAX_BLUR_RATIO = 1.5
MIN_BLUR_PX = 1.0

NO_CORNERS = np.zeros(0, np.int64), np.zeros((0, 2))


@dataclass(frozen=True)
class BoardImage:
    """An image file and the corners in it."""

    path: Path
    corners: Corners

    @property
    def name(self) -> str:
        return self.path.name


def list_images(folder: Path) -> list[Path]:
    """Return the image files of a folder; numbers in their names count as numbers.

    ImageError if there are none.
    """
    if not folder.is_dir():
        raise ImageError(f"{folder}: expected a folder of images")
    found = [path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES]
    if not found:
        raise ImageError(f"{folder}: no image in it, expected files {', '.join(SUFFIXES)}")
    return sorted(found, key=_natural_order)


def _natural_order(path: Path) -> list[tuple[int, int, str]]:
    words = re.split(r"(\d+)", path.name)
    return [(0, int(w), "") if k % 2 else (1, 0, w) for k, w in enumerate(words)]


@single_threaded()
def detect_in_files(
    paths: Sequence[Path],
    board: Board,
    max_edge_width: float | None = None,
    progress: Progress = ignore_progress,
) -> list[BoardImage]:
    """Return the corners in image files of one camera.

    Images whose edges are wider than `max_edge_width` px are unusable; by default, those whose
    edges are much wider than in the other images. ImageError if no image is usable.
    """
    detector, found = Detector(board), list[BoardImage]()
    for k, path in enumerate(paths):
        progress("detecting corners", k / len(paths))
        image = read_image(path)
        if image is None:
            corners = Corners(*NO_CORNERS, (0, 0), problem="the file is not an image")
        else:
            corners = detector.detect(image)
        found.append(BoardImage(path, corners))
    found = _check_sizes(found)
    found = _check_blur(found, max_edge_width)
    if all(one.corners.problem for one in found):
        problems = Counter(one.corners.problem for one in found)
        (first, count), *_ = problems.most_common()
        raise ImageError(
            f"{paths[0].parent}: none of {len(found)} images shows the board {board.text}; "
            f"{count} of them: {first}"
        )
    return found


def find_blur_limit(widths: Array) -> float:
    """Return the edge width (px) above which an image is blurred, from those of all images."""
    usual = float(np.nanmedian(widths))
    return max(MAX_BLUR_RATIO * usual, usual + MIN_BLUR_PX)


def _check_sizes(images: list[BoardImage]) -> list[BoardImage]:
    """Mark images whose size differs from that of most images."""
    sizes = Counter(one.corners.size for one in images if not one.corners.problem)
    if len(sizes) < 2:
        return images
    (usual, _), *_ = sizes.most_common()
    return [
        one
        if one.corners.size == usual or one.corners.problem
        else _reject(
            one,
            "another size than most images",
            "{} x {} px, usual are {} x {} px".format(*one.corners.size, *usual),
        )
        for one in images
    ]


def _check_blur(images: list[BoardImage], limit: float | None) -> list[BoardImage]:
    """Mark blurred images."""
    widths = np.array([one.corners.edge_width for one in images])
    if not np.isfinite(widths).any():
        return images
    usual = float(np.nanmedian(widths))
    limit = find_blur_limit(widths) if limit is None else limit
    return [
        _reject(one, "blurred", f"its edges are {width:.1f} px wide, usual are {usual:.1f} px")
        if width > limit
        else one
        for one, width in zip(images, widths, strict=True)
    ]


def _reject(one: BoardImage, problem: str, detail: str) -> BoardImage:
    numbers, pixels = NO_CORNERS
    corners = replace(one.corners, numbers=numbers, pixels=pixels, excluded={})
    return replace(one, corners=replace(corners, problem=problem, detail=detail))
