"""A ChArUco board: a chessboard whose white squares hold numbered markers.

A corner of the squares is identified by the markers beside it, so that a part of the board is
enough. Corner `row * (columns - 1) + column` is at ((column + 1) s, (row + 1) s, 0) in {board},
with the size s of a square. The origin is the outer corner of the first square.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from parallel_cal.base.errors import format_suggestion
from parallel_cal.imaging.opencv import ImageError, load_opencv

Array = NDArray[np.float64]

MIN_SQUARES = 3
MAX_SQUARES = 200
MIN_MARKER_SHARE, MAX_MARKER_SHARE = 0.3, 0.95  # of a square
BORDER_MODULES = 1  # black modules around the bits of a marker


@dataclass(frozen=True)
class Board:
    """A board of `columns` x `rows` squares with markers of a dictionary.

    `marker` is the size of a marker as a share of the square. A `legacy` board was made by OpenCV
    4.5 or older: with an even number of rows, its first square is white.

    ImageError for a board that does not exist.
    """

    columns: int = 8
    rows: int = 6
    dictionary: str = "5X5_100"
    marker: float = 0.75
    legacy: bool = False

    def __post_init__(self) -> None:
        for name in ("columns", "rows"):
            if not MIN_SQUARES <= getattr(self, name) <= MAX_SQUARES:
                raise ImageError(
                    f"{name}={getattr(self, name)}: expected {MIN_SQUARES} to {MAX_SQUARES} squares"
                )
        if not MIN_MARKER_SHARE <= self.marker <= MAX_MARKER_SHARE:
            raise ImageError(
                f"marker={self.marker:.3g} of a square: expected {MIN_MARKER_SHARE} to "
                f"{MAX_MARKER_SHARE}; about 0.75 is usual"
            )
        contained = len(self._dictionary.bytesList)
        if self.markers > contained:
            raise ImageError(
                f"a board of {self.columns} x {self.rows} squares needs {self.markers} markers, "
                f"but the dictionary {self.dictionary} contains {contained}: expected a larger "
                f"dictionary, such as {self.dictionary.split('_')[0]}_1000"
            )

    @property
    def text(self) -> str:
        """The board as `read_board` accepts it, for example `8x6:5X5_100`."""
        words = [f"{self.columns}x{self.rows}", self.dictionary]
        words += [f"{self.marker:.4g}"] if self.marker != Board.marker else []
        words += ["legacy"] if self.legacy else []
        return ":".join(words)

    @property
    def markers(self) -> int:
        """The number of markers."""
        return len(self.marker_squares)

    @property
    def corner_count(self) -> int:
        """The number of inner corners."""
        return (self.columns - 1) * (self.rows - 1)

    @property
    def first_is_white(self) -> bool:
        """Whether the first square is white and holds the first marker."""
        return self.legacy and self.rows % 2 == 0

    @property
    def marker_squares(self) -> NDArray[np.int64]:
        """Column and row (n, 2) of the square of each marker."""
        return marker_squares(self.columns, self.rows, self.first_is_white)

    @property
    def corners(self) -> Array:
        """Positions (n, 2) of the inner corners in {board}, in squares."""
        row, column = np.divmod(np.arange(self.corner_count), self.columns - 1)
        return np.stack([column + 1.0, row + 1.0], axis=1)

    @property
    def gap(self) -> float:
        """Distance between a marker and the edge of its square, in squares."""
        return (1.0 - self.marker) / 2

    def black_areas(self) -> list[tuple[float, float, float, float]]:
        """Return the black rectangles as (x, y, width, height) in {board}, in squares."""
        white = {tuple(at) for at in self.marker_squares.tolist()}
        areas = [
            (float(column), float(row), 1.0, 1.0)
            for row in range(self.rows)
            for column in range(self.columns)
            if (column, row) not in white
        ]
        size = self._dictionary.markerSize + 2 * BORDER_MODULES
        module = self.marker / size
        for number, (column, row) in enumerate(self.marker_squares.tolist()):
            image = self._dictionary.generateImageMarker(number, size, borderBits=BORDER_MODULES)
            for j, line in enumerate(image == 0):
                edges = np.flatnonzero(np.diff(np.concatenate([[0], line.astype(int), [0]])))
                for start, end in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
                    x, y = column + self.gap + start * module, row + self.gap + j * module
                    areas.append((x, y, (end - start) * module, module))
        return areas

    def raster(self, per_square: int) -> Array:
        """Return the board as an image (h, w) from 0 (black) to 1 (white).

        A square has `per_square` px. ImageError if a module of a marker is not a whole number of
        pixels.
        """
        size = self._dictionary.markerSize + 2 * BORDER_MODULES
        for part in (self.gap * per_square, self.marker * per_square / size):
            if abs(part - round(part)) > 1e-6:
                raise ImageError(
                    f"per_square={per_square}: a module of a marker would be "
                    f"{self.marker * per_square / size:.3g} px and the gap beside it "
                    f"{self.gap * per_square:.3g} px; expected whole numbers"
                )
        image = np.ones((self.rows * per_square, self.columns * per_square))
        for area in self.black_areas():
            x, y, width, height = (round(edge * per_square) for edge in area)
            image[y : y + height, x : x + width] = 0.0
        return image

    def opencv(self) -> Any:
        """Return the board of OpenCV, with squares of size 1."""
        board = load_opencv().aruco.CharucoBoard(
            (self.columns, self.rows), 1.0, self.marker, self._dictionary
        )
        board.setLegacyPattern(self.legacy)
        return board

    @cached_property
    def _dictionary(self) -> Any:
        aruco = load_opencv().aruco
        known = list_dictionaries()
        if self.dictionary not in known:
            raise ImageError(
                f"dictionary={self.dictionary}: expected one of {', '.join(known)}"
                f"{format_suggestion(self.dictionary, known)}"
            )
        return aruco.getPredefinedDictionary(getattr(aruco, f"DICT_{self.dictionary}"))


def list_dictionaries() -> list[str]:
    """Return the names of the dictionaries of markers."""
    names = (name.removeprefix("DICT_") for name in dir(load_opencv().aruco) if "DICT_" in name)
    return sorted({name for name in names if name == name.upper()})


def read_board(text: str) -> Board:
    """Return the board of a text such as `8x6`, `8x6:5X5_100`, `8x6:0.7` or `8x6:5X5_100:legacy`.

    A number is the size of a marker as a share of the square. ImageError for a text of another
    form.
    """
    size, *words = text.strip().split(":")
    found = re.fullmatch(r"(\d+)x(\d+)", size)
    if found is None:
        raise ImageError(
            f"board={text}: expected COLUMNSxROWS, then the dictionary if it is not "
            f"{Board.dictionary}, as in 8x6 or 8x6:{Board.dictionary}"
        )
    options: dict[str, Any] = {}
    for word in words:
        if word == "legacy":
            options["legacy"] = True
        elif re.fullmatch(r"0?\.\d+", word):
            options["marker"] = float(word)
        else:
            options["dictionary"] = word
    return Board(int(found[1]), int(found[2]), **options)


def marker_squares(columns: int, rows: int, first_is_white: bool = False) -> NDArray[np.int64]:
    """Return column and row (n, 2) of the square of each marker, in the order of their numbers."""
    row, column = np.divmod(np.arange(columns * rows), columns)
    white = (row + column) % 2 == (0 if first_is_white else 1)
    return np.stack([column[white], row[white]], axis=1)
