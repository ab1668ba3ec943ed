"""Detect the corners of a board in an image, to a fraction of a pixel.

OpenCV detects markers and corners. Each corner is then refined in a window that ends before the
nearest marker. A corner far from where the others expect it is excluded: the others determine a
plane in perspective with radial lens distortion.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from parallel_cal.imaging.board import MIN_SQUARES, Array, Board, marker_squares
from parallel_cal.imaging.opencv import load_opencv

Grey = NDArray[np.uint8]
Numbers = NDArray[np.int64]

MIN_CORNERS = 6  # a pose has six coordinates; fewer corners could not contradict it
MIN_CORNERS_FOR_DISTORTION = 14
WINDOW_SHARE = 0.7  # of the distance to the nearest marker
MIN_WINDOW_PX, MAX_WINDOW_PX = 2, 30
REFINEMENT = (50, 1e-4)  # steps, and the last step in px
# A corner is excluded if its residual exceeds both limits. Usual residuals are 0.02 to 0.3 px.
MIN_OUTLIER_PX = 1.0
MIN_OUTLIER_SIGMAS = 6.0
ROBUST_SCALE_PX = 0.3  # residuals above it count less in the fit
MAD_TO_SIGMA = 1.4826
EDGE_PLACE = 0.25  # squares from a corner along an edge, where its profile is taken
PROFILE_STEP_PX = 0.25
MIN_CONTRAST = 10.0  # grey levels
# A board of other size puts markers elsewhere; lens distortion moves them by less than this.
MAX_MARKER_ERROR = 0.45  # squares
MIN_MARKERS_FOR_SIZE = 8  # four markers agree with any arrangement
MIN_AGREEMENT = 0.9  # share of markers; a few may be misread
MAX_COLUMNS_SEARCHED = 40
DARK_LEVEL, BRIGHT_LEVEL = 20, 250


@dataclass(frozen=True)
class Corners:
    """The corners of a board in an image.

    Attributes
    ----------
    numbers : array of int (n,)
    pixels : array (n, 2)
        u, v in px; the centre of the top left pixel is (0, 0).
    size : tuple of int
        Width and height of the image, px.
    excluded : dict of float
        Residual (px) of each corner that was excluded, by its number.
    edge_width : float
        Contrast of the edges divided by their steepest slope, px; the larger of the two directions
        of the board. NaN if it was not measured.
    problem : str
        Why the image cannot be used; empty if it can. Images with the same problem have the same
        words.
    detail : str
        What is particular to this image of that problem.
    """

    numbers: Numbers
    pixels: Array
    size: tuple[int, int]
    excluded: dict[int, float] = field(default_factory=dict)
    edge_width: float = np.nan
    problem: str = ""
    detail: str = ""


def read_image(path: Path) -> Grey | None:
    """Read an image file as grey levels (h, w); None if it is not an image."""
    cv2 = load_opencv()
    content = np.frombuffer(path.read_bytes(), np.uint8)
    if not len(content):
        return None
    image = cv2.imdecode(content, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
    return None if image is None else np.asarray(image, np.uint8)


class Detector:
    """Detects one board in any number of images."""

    def __init__(self, board: Board) -> None:
        self.board, self._cv2 = board, load_opencv()
        self._charuco = self._cv2.aruco.CharucoDetector(board.opencv())

    def detect(self, image: Grey) -> Corners:
        """Return the corners in an image (h, w) of grey levels, and the problem if there is one."""
        size = image.shape[1], image.shape[0]
        pixels, numbers, marker_pixels, markers = self._charuco.detectBoard(image)

        def unusable(problem: str, detail: str = "") -> Corners:
            nothing = np.zeros(0, np.int64), np.zeros((0, 2))
            return Corners(*nothing, size, problem=problem, detail=detail)

        if markers is None or not len(markers):
            remark = _light(image) or self._explain_mirror(image)
            return unusable(f"no marker of the dictionary {self.board.dictionary} in it{remark}")
        centres = np.array([np.reshape(m, (4, 2)).mean(axis=0) for m in marker_pixels], float)
        if other := explain_other_board(self.board, markers.ravel().astype(np.int64), centres):
            return unusable(other)
        count = 0 if numbers is None else len(numbers)
        if count < MIN_CORNERS:
            return unusable("too few corners", f"{count} found, expected at least {MIN_CORNERS}")
        order = np.argsort(numbers.ravel())
        numbers = numbers.ravel()[order].astype(np.int64)
        pixels = pixels.reshape(-1, 2)[order].astype(float)
        plane = _Plane.through(self._cv2, self.board.corners[numbers], pixels)
        if plane is None:
            return unusable("too few corners", f"{count} found, all on one line")
        pixels = self._refine(image, numbers, pixels, plane)
        residuals = _fit_residuals(self.board.corners[numbers], pixels, plane, size)
        sigma = MAD_TO_SIGMA * float(np.median(residuals)) if len(residuals) else 0.0
        wrong = residuals > max(MIN_OUTLIER_PX, MIN_OUTLIER_SIGMAS * sigma)
        if (~wrong).sum() < MIN_CORNERS:
            return unusable(
                "too few corners",
                f"{int((~wrong).sum())} of {count} agree with each other, expected at least "
                f"{MIN_CORNERS}",
            )
        excluded = {int(n): float(e) for n, e in zip(numbers[wrong], residuals[wrong], strict=True)}
        numbers, pixels = numbers[~wrong], pixels[~wrong]
        width = self._edge_width(image, numbers, pixels, plane)
        return Corners(numbers, pixels, size, excluded, width)

    def _explain_mirror(self, image: Grey) -> str:
        """Return a remark if the mirrored image shows markers; else empty."""
        markers = self._charuco.detectBoard(self._cv2.flip(image, 1))[3]
        if markers is None or not len(markers):
            return ""
        return "; it is mirrored: switch off the mirroring of the camera or its driver"

    def _refine(self, image: Grey, numbers: Numbers, pixels: Array, plane: _Plane) -> Array:
        """Return the corners (n, 2) refined, each in a window that the nearest marker limits."""
        at, gap = self.board.corners[numbers], self.board.gap
        diagonals = [plane.step(at, (x * gap, y * gap)) for x in (-1, 1) for y in (-1, 1)]
        reach = np.min([np.abs(step).max(axis=1) for step in diagonals], axis=0)
        windows = np.clip(np.round(WINDOW_SHARE * reach), MIN_WINDOW_PX, MAX_WINDOW_PX).astype(int)
        cv2 = self._cv2
        end = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, *REFINEMENT)
        refined = pixels.copy()
        for window in np.unique(windows):
            chosen = windows == window
            start = np.ascontiguousarray(pixels[chosen, None, :], np.float32)
            done = cv2.cornerSubPix(image, start, (int(window), int(window)), (-1, -1), end)
            refined[chosen] = done.reshape(-1, 2)
        return refined

    def _edge_width(self, image: Grey, numbers: Numbers, pixels: Array, plane: _Plane) -> float:
        """Return contrast / steepest slope (px) of the edges, of the blurrier of two directions."""
        at, widths = self.board.corners[numbers], []
        for along, across in (((1.0, 0.0), (0.0, 1.0)), ((0.0, 1.0), (1.0, 0.0))):
            half = WINDOW_SHARE * self.board.gap * np.linalg.norm(plane.step(at, across), axis=1)
            found = []
            for side in (-EDGE_PLACE, EDGE_PLACE):
                edge = plane.step(at, (side * along[0], side * along[1]))
                normal = np.stack([-edge[:, 1], edge[:, 0]], axis=1)
                normal /= np.linalg.norm(normal, axis=1)[:, None]
                for place, turn, reach in zip(pixels + edge, normal, half, strict=True):
                    steps = np.arange(-reach, reach + 1e-9, PROFILE_STEP_PX)
                    found.append(_profile_width(image, place + steps[:, None] * turn))
            if measured := [width for width in found if np.isfinite(width)]:
                widths.append(float(np.median(measured)))
        return max(widths, default=np.nan)


def explain_other_board(board: Board, markers: Numbers, centres: Array) -> str:
    """Return why markers (n,) at pixels (n, 2) are not those of a board; empty if they may be."""
    stated = f"the board {board.text} was stated"
    last = int(markers.max())
    if len(markers) < MIN_MARKERS_FOR_SIZE:
        if last < board.markers:
            return ""
        return f"marker {last} is in it, but {stated}, whose last marker is {board.markers - 1}"
    if _agreement(board.marker_squares, markers, centres) >= MIN_AGREEMENT:
        return ""
    agreements = {}
    for columns in range(MIN_SQUARES, MAX_COLUMNS_SEARCHED + 1):
        rows = 2 * (last + 1) // columns + 2
        for white in (False, True):
            squares = marker_squares(columns, rows, white)
            agreements[columns, white] = _agreement(squares, markers, centres), squares
    (columns, white), (share, squares) = max(agreements.items(), key=lambda item: item[1][0])
    if share < MIN_AGREEMENT:
        return ""  # a bent board or a strong lens: the corners decide
    first = ", whose first square is white (:legacy)" if white else ""
    rows = int(squares[markers, 1].max()) + 1
    return f"a board of {columns} columns and at least {rows} rows is in it{first}, but {stated}"


def _agreement(squares: Numbers, markers: Numbers, centres: Array) -> float:
    """Return the share of markers whose centres are in their squares (n, 2) of a flat board."""
    known = markers < len(squares)
    if known.mean() < MIN_AGREEMENT:
        return 0.0
    target = squares[markers[known]] + 0.5
    _, agrees = load_opencv().findHomography(
        centres[known], target, load_opencv().RANSAC, MAX_MARKER_ERROR
    )
    return 0.0 if agrees is None else float(agrees.sum()) / len(markers)


@dataclass(frozen=True)
class _Plane:
    """The homography from {board}, in squares, to pixels."""

    matrix: Array

    @classmethod
    def through(cls, cv2: Any, at: Array, pixels: Array) -> _Plane | None:
        """Return the plane through corners, a few of which may be wrong; None if they are on a
        line."""
        if np.linalg.matrix_rank(at - at.mean(axis=0)) < 2:
            return None
        square = np.median(np.linalg.norm(np.diff(pixels, axis=0), axis=1))
        matrix, _ = cv2.findHomography(at, pixels, cv2.RANSAC, max(0.1 * float(square), 2.0))
        return None if matrix is None else cls(np.asarray(matrix, float))

    def step(self, at: Array, by: tuple[float, float]) -> Array:
        """Return the change in pixels (n, 2) from points (n, 2) of the board by some squares."""
        return _map(self.matrix, at + np.array(by)) - _map(self.matrix, at)


def _map(matrix: Array, points: Array) -> Array:
    mapped = np.column_stack([points, np.ones(len(points))]) @ matrix.T
    return np.asarray(mapped[:, :2] / mapped[:, 2:])


def _fit_residuals(at: Array, pixels: Array, plane: _Plane, size: tuple[int, int]) -> Array:
    """Return the distance (n,) in px of each corner from where the others expect it.

    Their model is a plane in perspective, and with enough corners two coefficients of radial
    distortion about the middle of the image.
    """
    from scipy.optimize import least_squares

    middle, scale = (np.array(size) - 1) / 2, float(max(size)) / 2
    bends = 2 if len(at) >= MIN_CORNERS_FOR_DISTORTION else 0
    shift = np.eye(3)
    shift[:2, 2] = -middle / scale
    start = shift @ np.diag([1 / scale, 1 / scale, 1.0]) @ plane.matrix
    start = (start / start[2, 2]).ravel()[:8]

    def compute_offsets(p: Array) -> Array:
        flat = _map(np.append(p[:8], 1.0).reshape(3, 3), at)
        s = np.sum(flat**2, axis=1)[:, None]
        bent = flat * (1 + sum(k * s ** (i + 1) for i, k in enumerate(p[8:])))
        return np.asarray(scale * bent + middle - pixels)

    found = least_squares(
        lambda p: compute_offsets(p).ravel(),
        np.append(start, np.zeros(bends)),
        loss="soft_l1",
        f_scale=ROBUST_SCALE_PX,
        x_scale="jac",
        max_nfev=100,
    )
    return np.asarray(np.linalg.norm(compute_offsets(found.x), axis=1))


def _profile_width(image: Grey, points: Array) -> float:
    """Return contrast / steepest slope (px) along a line of pixels (n, 2); NaN without contrast."""
    height, width = image.shape
    low, high = points.min(axis=0), points.max(axis=0)
    if (low < 0).any() or high[0] > width - 2 or high[1] > height - 2 or len(points) < 3:
        return np.nan
    whole = np.floor(points).astype(int)
    (u, v), (a, b) = whole.T, (points - whole).T
    grey = (image[v, u] * (1 - a) + image[v, u + 1] * a) * (1 - b) + (
        image[v + 1, u] * (1 - a) + image[v + 1, u + 1] * a
    ) * b
    contrast = float(np.ptp(grey))
    if contrast < MIN_CONTRAST:
        return np.nan
    step = round(1.0 / PROFILE_STEP_PX)  # noise has less weight in a difference over 1 px
    slopes = np.abs(grey[step:] - grey[:-step])
    return contrast / max(float(slopes.max(initial=0.0)), 1e-9)


def _light(image: Grey) -> str:
    """Return a remark about an image that is too dark or too bright; else empty."""
    if np.quantile(image, 0.99) < DARK_LEVEL:
        return f"; it is dark (99 % of it below grey level {DARK_LEVEL})"
    if np.median(image) > BRIGHT_LEVEL:
        return f"; it is overexposed (half of it above grey level {BRIGHT_LEVEL})"
    return ""
