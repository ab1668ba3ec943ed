"""Boards to print: the pattern is OpenCV's, the sheet has its true size, errors say what to do."""

import json
import re
import shutil
import subprocess
import sys
import zlib
from itertools import pairwise

import numpy as np
import pytest

from parallel_cal.cli import main as cli

cv2 = pytest.importorskip("cv2", reason="OpenCV is not installed (extra camera)")

from parallel_cal.imaging.board import Board, read_board  # noqa: E402
from parallel_cal.imaging.opencv import ImageError  # noqa: E402
from parallel_cal.imaging.sheet import LETTER_MM, make_sheet  # noqa: E402

PER_MM = 12  # pixels of a rasterised sheet


@pytest.mark.parametrize("rows", [5, 6])
@pytest.mark.parametrize("legacy", [False, True])
def test_the_pattern_and_the_numbers_of_the_corners_are_those_of_opencv(rows, legacy):
    board = Board(8, rows, legacy=legacy)
    drawn = board.opencv().generateImage((8 * 56, rows * 56), marginSize=0, borderBits=1)
    assert np.array_equal(255 * board.raster(56), drawn)
    assert np.allclose(board.corners, board.opencv().getChessboardCorners()[:, :2])


def test_a_corner_is_numbered_row_by_row_from_the_first_square():
    board = Board(8, 6)
    assert board.corner_count == 35
    for row, column in ((0, 0), (1, 5), (4, 6)):
        assert board.corners[row * 7 + column].tolist() == [column + 1, row + 1]


def rasterise_pdf(content):
    """The black rectangles of a page in true size, PER_MM pixels per mm, and its size in mm."""
    stream = re.search(rb"stream\n(.*?)\nendstream", content, re.S)[1]
    commands = zlib.decompress(stream).decode("latin-1")
    box = re.search(rb"/MediaBox \[0 0 (\S+) (\S+)\]", content)
    width, height = (float(side) * 25.4 / 72 for side in box.groups())
    scale = float(re.match(r"(\S+) 0 0 \1 0 0 cm", commands)[1]) * 25.4 / 72
    image = np.full((round(height * PER_MM), round(width * PER_MM)), 255, np.uint8)
    for line in commands.splitlines():
        if line.endswith(" re"):
            x, y, w, h = (scale * float(word) for word in line.split()[:4])
            edges = (height - y - h, height - y, x, x + w)
            top, bottom, left, right = (round(PER_MM * edge) for edge in edges)
            image[top:bottom, left:right] = 0
    return image, (width, height)


def measured_size(board, image, per_mm):
    """Size (mm) of the squares along x and y in a picture of a sheet, from the detected corners."""
    corners, numbers, _, _ = cv2.aruco.CharucoDetector(board.opencv()).detectBoard(image)
    assert len(numbers) == board.corner_count
    place = np.c_[board.corners[numbers.ravel()], np.ones(len(numbers))]
    linear = np.linalg.lstsq(place, corners.reshape(-1, 2) / per_mm, rcond=None)[0]
    assert np.abs(linear[[0, 1], [1, 0]]).max() < 1e-3
    return linear[0, 0], linear[1, 1]


@pytest.mark.parametrize(("board", "square"), [(Board(), 30.0), (Board(5, 7, "4X4_50"), 25.0)])
def test_a_printed_pdf_shows_the_board_in_its_true_size(board, square):
    sheet = make_sheet(board, square)
    image, size = rasterise_pdf(sheet.to_pdf())
    assert sorted(size) == pytest.approx([210.0, 297.0], abs=1e-3)
    assert measured_size(board, image, PER_MM) == pytest.approx((square, square), abs=0.01)


def test_the_rulers_are_as_long_as_the_board():
    sheet = make_sheet(Board(), 30.0)
    x, _, w, h = np.array(sheet.rulers).T
    for size, across, length in ((w, h, 240.0), (h, w, 180.0)):
        line = np.argmax(size)
        assert size[line] == pytest.approx(length)
        assert across[line] < 0.5
    ends = np.array(sheet.board)
    assert x.max() + 0.2 == pytest.approx((ends[:, 0] + ends[:, 2]).max(), abs=1e-9)
    assert any("square: 0.03" in text.words for text in sheet.texts)


@pytest.mark.parametrize("square", [20.0, 21.0, 24.0, 26.0, 30.0])
def test_labels_of_a_ruler_do_not_touch(square):
    """On a board of 160 mm, the labels 150 and 160 mm were one word."""
    sheet = make_sheet(Board(), square)
    labels = [text for text in sheet.texts if re.fullmatch(r"\d+( mm)?", text.words)]
    for upward, length in ((False, 8 * square), (True, 6 * square)):
        ruler = [text for text in labels if text.upward == upward]
        spans = sorted(
            (text.y - LETTER_MM * len(text.words), text.y)
            if upward
            else (text.x, text.x + LETTER_MM * len(text.words))
            for text in ruler
        )
        assert f"{length:g} mm" in [text.words for text in ruler]
        assert all(after[0] - before[1] > 1.0 for before, after in pairwise(spans))


@pytest.mark.wide
def test_a_browser_draws_the_svg_in_its_true_size(tmp_path):
    browser = shutil.which("chromium")
    if browser is None:
        pytest.skip("chromium is not installed")
    sheet = make_sheet(Board(), 30.0)
    sheet.write(tmp_path / "board.svg")
    command = [browser, "--headless", "--no-sandbox", "--disable-gpu", "--window-size=1300,1000"]
    command += [f"--user-data-dir={tmp_path / 'profile'}", "--force-device-scale-factor=2"]
    command += [f"--screenshot={tmp_path / 'shot.png'}", (tmp_path / "board.svg").as_uri()]
    subprocess.run(command, check=True, capture_output=True, timeout=120)
    image = cv2.imread(str(tmp_path / "shot.png"), cv2.IMREAD_GRAYSCALE)
    size = measured_size(Board(), image, 2 * 96 / 25.4)
    assert size == pytest.approx((30.0, 30.0), abs=0.02)


def test_the_command_writes_the_sheet_and_prints_the_board(tmp_path, capsys):
    for name in ("board.pdf", "board.svg"):
        words = f"board charuco --columns 8 --rows 6 --square 30 -o {tmp_path / name} --json"
        with pytest.raises(SystemExit, match="0"):
            cli.main(words.split())
        document = json.loads(capsys.readouterr().out)
        assert document["board"] == "8x6:5X5_100"
        assert document["square"] == 0.03
        assert (tmp_path / name).stat().st_size > 1000


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ("--columns 12 --rows 9 --square 30", "--page A2 or --square 2"),
        ("--columns 20 --rows 15 --square 10 --page A3", "needs 150 markers.*5X5_1000"),
        ("--dictionary 5x5_100", "expected one of .*did you mean '5X5_100'"),
        ("--columns 2", "columns=2: expected 3 to 200"),
        ("--marker 30", "marker=1 of a square"),
        ("--page A9", "page=A9: expected one of"),
    ],
)
def test_a_board_that_cannot_be_printed_is_refused_with_a_cure(tmp_path, capsys, options, message):
    with pytest.raises(SystemExit, match="1"):
        cli.main(["board", "charuco", *options.split(), "-o", str(tmp_path / "board.pdf")])
    assert re.search(message, capsys.readouterr().err)
    assert not (tmp_path / "board.pdf").exists()


def test_a_sheet_in_another_format_is_refused(tmp_path):
    with pytest.raises(ImageError, match=r"board.png: expected a name that ends with .pdf or .svg"):
        make_sheet(Board(), 30.0).write(tmp_path / "board.png")


def test_the_text_of_a_board_names_it():
    for board in (Board(), Board(5, 7, "6X6_250"), Board(10, 8, legacy=True)):
        assert read_board(board.text) == board
    assert read_board("8x6:legacy") == Board(legacy=True)
    assert read_board("8x6:0.7") == Board(marker=0.7)
    assert read_board(Board(marker=0.6, legacy=True).text) == Board(marker=0.6, legacy=True)
    with pytest.raises(ImageError, match="board=eight: expected COLUMNSxROWS"):
        read_board("eight")


def test_without_opencv_the_message_names_the_extra_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(ImageError, match=r"pip install 'parallel_cal\[camera\]'"):
        Board()
