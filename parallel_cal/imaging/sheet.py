"""A sheet of paper with a board in true size, rulers to check the print, and the board's numbers.

The sheet is a list of black shapes in millimetres. It is written as SVG, or as PDF 1.4, whose few
operators need no library.
"""

from __future__ import annotations

import re
import zlib
from dataclasses import dataclass, field
from html import escape
from pathlib import Path

from parallel_cal.base.files import write_atomically
from parallel_cal.imaging.board import Board
from parallel_cal.imaging.opencv import ImageError

# Width and height of pages in mm (ISO 216, ANSI/ASME Y14.1).
PAGES = {
    "A5": (148.0, 210.0),
    "A4": (210.0, 297.0),
    "A3": (297.0, 420.0),
    "A2": (420.0, 594.0),
    "A1": (594.0, 841.0),
    "A0": (841.0, 1189.0),
    "letter": (215.9, 279.4),
    "legal": (215.9, 355.6),
    "tabloid": (279.4, 431.8),
}
MARGIN_MM = 5.0  # usual printers cannot print nearer to the edge
RULER_GAP_MM = 4.0  # white around the board
RULER_MM = 5.0  # length of the longest tick
TICK_STEP_MM = 5.0
LABEL_STEP_MM = 50.0
LINE_MM = 0.2
TEXT_MM = 2.4  # size of the letters
LETTER_MM = 0.55 * TEXT_MM  # usual width of a letter of Helvetica
POINT_MM = 25.4 / 72
# Of the scales along and across, if one size of the squares stands for both: an error of half of
# this, which a steel rule measures on a page.
MAX_PRINT_DIFFERENCE = 0.003
SQUARE_DECIMALS = 6  # of the size in m: 1 um

Shape = tuple[float, float, float, float]  # x, y, width, height from the top left corner, mm


@dataclass(frozen=True)
class Text:
    """A line of text that begins at x, y (mm); `upward` turns it by 90 degrees."""

    x: float
    y: float
    words: str
    upward: bool = False


@dataclass(frozen=True)
class Sheet:
    """Black rectangles and lines of text on a page of `width` x `height` mm."""

    width: float
    height: float
    board: list[Shape] = field(default_factory=list)
    rulers: list[Shape] = field(default_factory=list)
    texts: list[Text] = field(default_factory=list)

    def write(self, path: str | Path) -> None:
        """Write the sheet as the suffix states, .pdf or .svg; ImageError for another one."""
        formats = {".pdf": self.to_pdf, ".svg": lambda: self.to_svg().encode()}
        make = formats.get(Path(path).suffix.lower())
        if make is None:
            raise ImageError(f"{path}: expected a name that ends with {' or '.join(formats)}")
        write_atomically(path, make())

    def to_svg(self) -> str:
        """Return the sheet as SVG, in mm."""
        # One path for all black areas: separate ones would leave light seams where they touch.
        path = "".join(f"M{x:.6g} {y:.6g}h{w:.6g}v{h:.6g}h{-w:.6g}z" for x, y, w, h in self._areas)
        lines = []
        for text in self.texts:
            turned = f' transform="rotate(-90 {text.x:.6g} {text.y:.6g})"' if text.upward else ""
            lines.append(
                f'<text x="{text.x:.6g}" y="{text.y:.6g}"{turned}>{escape(text.words)}</text>'
            )
        size = f'width="{self.width:g}mm" height="{self.height:g}mm"'
        style = f'font-family="Helvetica, Arial, sans-serif" font-size="{TEXT_MM:g}"'
        return (
            f'<svg xmlns="http://www.w3.org/2000/svg" {size} '
            f'viewBox="0 0 {self.width:g} {self.height:g}">\n'
            f'<rect width="100%" height="100%" fill="#fff"/>\n<path d="{path}"/>\n'
            f"<g {style}>\n" + "\n".join(lines) + "\n</g>\n</svg>\n"
        )

    def to_pdf(self) -> bytes:
        """Return the sheet as PDF, in points from the bottom left corner."""
        scale = 1.0 / POINT_MM
        parts = [f"{scale:.8f} 0 0 {scale:.8f} 0 0 cm 0 g"]
        parts += [
            f"{x:.5f} {self.height - y - h:.5f} {w:.5f} {h:.5f} re" for x, y, w, h in self._areas
        ]
        parts.append("f")
        for text in self.texts:
            turn = "0 1 -1 0" if text.upward else "1 0 0 1"
            words = re.sub(r"([\\()])", r"\\\1", text.words)
            parts.append(
                f"BT /F1 {TEXT_MM:g} Tf {turn} {text.x:.5f} {self.height - text.y:.5f} Tm "
                f"({words}) Tj ET"
            )
        content = zlib.compress("\n".join(parts).encode("latin-1", "replace"))
        box = f"[0 0 {self.width * scale:.5f} {self.height * scale:.5f}]"
        objects = [
            b"<< /Type /Catalog /Pages 2 0 R /ViewerPreferences << /PrintScaling /None >> >>",
            b"<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
            f"<< /Type /Page /Parent 2 0 R /MediaBox {box} /Contents 4 0 R "
            "/Resources << /Font << /F1 5 0 R >> >> >>".encode(),
            b"<< /Length %d /Filter /FlateDecode >>\nstream\n%b\nendstream"
            % (len(content), content),
            b"<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica >>",
        ]
        file, places = bytearray(b"%PDF-1.4\n%\xe2\xe3\xcf\xd3\n"), []
        for number, each in enumerate(objects, 1):
            places.append(len(file))
            file += b"%d 0 obj\n%b\nendobj\n" % (number, each)
        positions = b"".join(b"%010d 00000 n \n" % place for place in places)
        count, start = len(objects) + 1, len(file)
        return bytes(file) + (
            b"xref\n0 %d\n0000000000 65535 f \n%btrailer\n<< /Size %d /Root 1 0 R >>\n"
            b"startxref\n%d\n%%%%EOF\n" % (count, positions, count, start)
        )

    @property
    def _areas(self) -> list[Shape]:
        return self.board + self.rulers


def page_size(page: str) -> tuple[float, float]:
    """Return width and height (mm) of a page by its name, or of a text such as `300x400`."""
    known = {name.lower(): size for name, size in PAGES.items()}
    if size := known.get(page.lower()):
        return size
    if found := re.fullmatch(r"(\d+(?:\.\d+)?)x(\d+(?:\.\d+)?)", page):
        return float(found[1]), float(found[2])
    raise ImageError(
        f"page={page}: expected one of {', '.join(PAGES)}, or WIDTHxHEIGHT in mm, such as 300x400"
    )


def make_sheet(board: Board, square: float, page: str = "A4") -> Sheet:
    """Return a sheet with a board whose squares measure `square` mm, upright or turned as it fits.

    ImageError if the board does not fit the page, or its modules are too small to print.
    """
    if not 1.0 <= square <= 1000.0:
        raise ImageError(f"square={square:g} mm: expected 1 to 1000 mm")
    width, height = board.columns * square, board.rows * square
    beside = MARGIN_MM + TEXT_MM + RULER_MM + RULER_GAP_MM  # on the left and below
    texts = _describe(board, square, width, height)
    below = beside + 1.5 * TEXT_MM * len(texts)
    needed = beside + width + MARGIN_MM, MARGIN_MM + height + below
    sizes = [page_size(page), page_size(page)[::-1]]
    fitting = [size for size in sizes if needed[0] <= size[0] and needed[1] <= size[1]]
    if not fitting:
        raise ImageError(_explain_misfit(board, square, page, needed))
    sheet = Sheet(*fitting[0])
    left = beside + (sheet.width - needed[0]) / 2
    top = MARGIN_MM + (sheet.height - needed[1]) / 2
    sheet.board.extend(
        (left + x * square, top + y * square, w * square, h * square)
        for x, y, w, h in board.black_areas()
    )
    _add_rulers(sheet, left, top, width, height)
    first = top + height + RULER_GAP_MM + RULER_MM + 2.5 * TEXT_MM
    start = max(MARGIN_MM, left - beside + MARGIN_MM)
    sheet.texts.extend(Text(start, first + 1.5 * TEXT_MM * k, line) for k, line in enumerate(texts))
    return sheet


def _describe(board: Board, square: float, width: float, height: float) -> list[str]:
    """Return the lines of text on the sheet."""
    from textwrap import wrap

    size = round(1e-3 * square, SQUARE_DECIMALS)
    lines = [
        f"ChArUco {board.columns} x {board.rows}, square {square:g} mm, marker "
        f"{board.marker * square:g} mm, dictionary {board.dictionary}. "
        f"import images: board={board.text}. Sensor: camera: {{columns: {board.columns}, "
        f"rows: {board.rows}, square: {size:g}}}.",
        f"Print at 100 % (actual size). The rulers are {width:g} and {height:g} mm long. If they "
        f"measure L and H mm, state square: {size:g} * (L / {width:g} + H / {height:g}) / 2 (m). "
        f"Print again if L / {width:g} and H / {height:g} differ by more than "
        f"{MAX_PRINT_DIFFERENCE:g}.",
    ]
    room = max(int(1.15 * width / LETTER_MM), 40)
    return [part for line in lines for part in wrap(line, room)]


def _add_rulers(sheet: Sheet, left: float, top: float, width: float, height: float) -> None:
    """Add a ruler below the board and one on its left, each as long as the board."""
    y, x = top + height + RULER_GAP_MM, left - RULER_GAP_MM
    sheet.rulers.append((left, y, width, LINE_MM))
    sheet.rulers.append((x - LINE_MM, top, LINE_MM, height))
    for length, horizontal in ((width, True), (height, False)):
        steps = int(length / TICK_STEP_MM + 1e-9)
        for at in sorted({*(TICK_STEP_MM * k for k in range(steps + 1)), length}):
            labelled = at in (0.0, length) or at % LABEL_STEP_MM == 0.0
            tick = RULER_MM if labelled else RULER_MM / 2
            # The ends of the ruler are the outer edges of its first and last tick.
            shift = min(max(at - LINE_MM / 2, 0.0), length - LINE_MM)
            if horizontal:
                sheet.rulers.append((left + shift, y, LINE_MM, tick))
            else:
                sheet.rulers.append((x - tick, top + shift, tick, LINE_MM))
            words = f"{at:g} mm" if at == length else f"{at:g}"
            wide = LETTER_MM * len(words)
            last = length - LETTER_MM * len(f"{length:g} mm")  # where the label of the end begins
            near_end = at < length and at + wide / 2 + TEXT_MM > last
            if not labelled or near_end:
                continue
            if horizontal:
                place = left + min(at - wide / 2, length - wide)
                sheet.texts.append(Text(place, y + RULER_MM + TEXT_MM, words))
            else:
                place = top + max(at + wide / 2, wide)
                sheet.texts.append(
                    Text(x - RULER_MM - 0.3 * TEXT_MM, min(place, top + height), words, True)
                )


def _explain_misfit(board: Board, square: float, page: str, needed: tuple[float, float]) -> str:
    """Return why a board does not fit a page, and what would."""
    fitting = [
        name
        for name, size in PAGES.items()
        if all(a <= b for a, b in zip(sorted(needed), sorted(size), strict=True))
    ]
    low, high = sorted(page_size(page))
    extra = max(needed[0] - board.columns * square, needed[1] - board.rows * square)
    wide, tall = sorted((board.columns, board.rows))
    largest = min((low - extra) / wide, (high - extra) / tall)
    cures = [f"--page {fitting[0]}"] if fitting else []
    cures += [f"--square {int(largest):d} or smaller"] if largest >= 1.0 else []
    return (
        f"a board of {board.columns} x {board.rows} squares of {square:g} mm with its rulers needs "
        f"{needed[0]:.0f} x {needed[1]:.0f} mm, but page {page} has {low:g} x {high:g} mm: "
        f"expected {' or '.join(cures) or 'fewer or smaller squares'}"
    )
