"""Corners in rendered images against the truth: their errors, and images that cannot be used."""

import re
from dataclasses import replace

import numpy as np
import pytest
from board_images import LENS, SQUARE, printed, shots
from marks import as_slow

from parallel_cal.imaging.board import Board, read_board
from parallel_cal.virtual.camera import Camera, FlatBoard, Imager
from parallel_cal.virtual.robot import turn

pytest.importorskip("cv2", reason="OpenCV is not installed (extra camera)")

from parallel_cal.imaging.detection import Detector

SMALL = Camera((640, 512), (600.0, 600.0), (319.5, 255.5), LENS)


@pytest.fixture(scope="module")
def detector():
    return Detector(Board())


def errors_of(detector, camera, n, **options):
    """Errors (m, 2) in px of all corners in n shots, and the number of corners excluded."""
    errors, excluded = [], 0
    for shot in shots(n, camera, **options):
        found = detector.detect(shot.image)
        assert not found.problem
        errors.append(found.pixels - shot.pixels[found.numbers])
        excluded += len(found.excluded)
    return np.concatenate(errors), excluded


@pytest.mark.wide
@pytest.mark.parametrize(
    ("changes", "noisy", "sigma", "largest"),
    [
        as_slow(({}, False, 0.03, 0.2)),
        ({}, True, 0.04, 0.25),
        pytest.param({"imager": Imager(noise=3.0)}, True, 0.06, 0.4, marks=pytest.mark.slow),
        pytest.param({"blur": 2.0}, True, 0.08, 0.4, marks=pytest.mark.slow),
        as_slow(({"focal": (600.0, 600.0), "distortion": (-0.28, 0.07)}, True, 0.06, 0.4)),
        ({"focal": (560.0, 560.0), "fisheye": True, "distortion": (0.05, -0.01)}, True, 0.06, 0.4),
    ],
    ids=["exact", "usual noise", "much noise", "blurred", "wide angle", "fisheye"],
)
def test_corners_are_found_to_a_few_hundredths_of_a_pixel(detector, changes, noisy, sigma, largest):
    camera = replace(Camera(distortion=LENS), **changes)
    scale = camera.focal[0] / 1200  # a shorter lens is nearer
    errors, excluded = errors_of(
        detector, camera, 8, noisy=noisy, near=0.45 * max(scale, 0.6), far=0.75 * scale
    )
    assert len(errors) > 8 * 25
    assert excluded == 0
    assert np.abs(errors.mean(axis=0)).max() < 0.01  # the centre of a pixel is where OpenCV's is
    assert errors.std() < sigma
    assert np.abs(errors).max() < largest


def test_a_corner_in_a_small_image_is_where_the_camera_projects_it(detector):
    errors, _ = errors_of(detector, SMALL, 2, near=0.35, far=0.45)
    assert len(errors) > 60
    assert errors.std() < 0.06
    assert np.abs(errors.mean(axis=0)).max() < 0.03


def test_a_covered_part_of_the_board_is_missing_and_the_rest_is_found(detector):
    (shot,) = shots(1, SMALL, near=0.35, far=0.36, tilt=0.2)
    image = shot.image.copy()
    covered = shot.pixels[:, 0] > np.median(shot.pixels[:, 0]) + 5
    image[:, int(np.median(shot.pixels[:, 0])) + 5 :] = 120
    found = detector.detect(image)
    assert not found.problem
    assert 6 <= len(found.numbers) < 35
    assert not covered[found.numbers].any()
    assert np.abs(found.pixels - shot.pixels[found.numbers]).max() < 0.5


def test_a_corner_that_is_displaced_is_excluded_with_its_residual(detector):
    """A printed flaw: the neighbourhood of one corner is shifted by 3 px."""
    (shot,) = shots(1, SMALL, near=0.5, far=0.51, tilt=0.1)
    image, number = shot.image.copy(), 17
    u, v = np.round(shot.pixels[number]).astype(int)
    image[v - 5 : v + 6, u - 5 : u + 6] = shot.image[v - 5 : v + 6, u - 8 : u + 3]
    found = detector.detect(image)
    assert set(found.excluded) == {number}
    assert 2.0 < found.excluded[number] < 5.0
    assert number not in found.numbers
    assert len(found.numbers) == 34


@pytest.mark.wide
def test_the_width_of_the_edges_measures_the_blur(detector):
    widths = []
    for blur in (0.6, 1.2, 1.8):
        (shot,) = shots(1, replace(SMALL, blur=blur), near=0.3, far=0.31, tilt=0.1)
        widths.append(detector.detect(shot.image).edge_width)
        # contrast / slope of a Gaussian edge, widened by the pixel's own width
        assert widths[-1] == pytest.approx(np.sqrt(2 * np.pi) * np.hypot(blur, 0.4), rel=0.2)
    assert np.diff(widths).min() > 0.8


@pytest.mark.wide
def test_motion_along_one_edge_of_the_board_widens_the_edges(detector):
    R, middle = np.eye(3), np.array([4 * SQUARE, 3 * SQUARE, 0.0])
    r = np.array([0.0, 0.0, 0.4]) - middle
    path = r + np.linspace(0, 3e-3, 9)[:, None] * [0.0, 1.0, 0.0]  # 4.5 px
    still, moved = (
        detector.detect(SMALL.render(printed(), p, np.broadcast_to(R, (len(p), 3, 3))))
        for p in (r[None], path)
    )
    assert moved.problem or moved.edge_width > 1.6 * still.edge_width


@pytest.mark.parametrize(
    ("other", "message"),
    [
        (Board(7, 5), "a board of 7 columns and at least 5 rows is in it"),
        (Board(9, 6), "a board of 9 columns and at least 6 rows is in it"),
        (Board(8, 6, legacy=True), "first square is white .:legacy."),
        (Board(8, 6, "7X7_100", marker=0.72), "no marker of the dictionary 5X5_100 in it"),
    ],
    ids=lambda value: value.text if isinstance(value, Board) else "",
)
def test_another_board_is_named(detector, other, message):
    per_square = 56 if other.dictionary == "5X5_100" else 100
    flat = FlatBoard(other.raster(per_square), SQUARE / per_square)
    found = detector.detect(SMALL.render(flat, np.array([-0.12, -0.09, 0.42]), np.eye(3)))
    assert not len(found.numbers)
    assert re.search(message, found.problem)


def test_an_image_without_the_board_states_what_is_wrong_with_it(detector):
    for grey, words in ((120, ""), (3, "; it is dark"), (255, "; it is overexposed")):
        found = detector.detect(np.full((480, 640), grey, np.uint8))
        assert f"no marker of the dictionary 5X5_100 in it{words}" in found.problem
        assert found.size == (640, 480)


def test_small_markers_are_stated_in_the_text_of_the_board():
    board = Board(marker=0.6)
    flat = FlatBoard(board.raster(70), SQUARE / 70)
    r = np.array([-0.12, -0.09, 0.42])
    found = Detector(read_board(board.text)).detect(SMALL.render(flat, r, np.eye(3)))
    true = SMALL.project(np.c_[SQUARE * board.corners, np.zeros(35)] + r)
    assert len(found.numbers) == 35
    assert np.abs(found.pixels - true[found.numbers]).max() < 0.2


def test_a_mirrored_image_is_recognised(detector):
    (shot,) = shots(1, SMALL, near=0.35, far=0.36, tilt=0.2)
    assert "it is mirrored: switch off" in detector.detect(shot.image[:, ::-1].copy()).problem


def test_the_back_of_a_board_is_blank(detector):
    R = np.diag([-1.0, 1.0, -1.0])  # turned by half a turn
    image = SMALL.render(printed(), np.array([0.12, -0.09, 0.42]), R)
    assert image[256, 320] == 200
    assert "no marker" in detector.detect(image).problem


def test_the_camera_projects_a_point_worked_out_by_hand():
    camera = Camera((200, 100), (100.0, 200.0), (99.5, 49.5), (0.1, 0.0, 0.01, 0.02, 0.0))
    # x = 0.1, y = 0.2, s = 0.05: radial 1.005, tangential 0.0004 + 0.0014 and 0.0013 + 0.0008
    pixel = camera.project(np.array([0.05, 0.1, 0.5]))
    assert pixel == pytest.approx([99.5 + 100 * 0.1023, 49.5 + 200 * 0.2031])


def test_a_pixel_of_the_rendered_image_is_on_the_ray_of_its_point():
    """The grey levels of one black cell have their centre of mass where it is projected."""
    ink = np.ones((41, 41))
    ink[20, 20] = 0.0
    flat, r = FlatBoard(ink, 2e-3), np.array([0.05, 0.02, 0.4])
    even = replace(SMALL, shading=0.0)
    for camera in (even, replace(even, fisheye=True, distortion=(0.05, -0.01))):
        light = camera.imager.white - camera.render(flat, r, np.eye(3)).astype(float)
        at = camera.project(r + [41e-3, 41e-3, 0.0])
        u, v = np.round(at).astype(int)
        window = light[v - 8 : v + 9, u - 8 : u + 9]
        du, dv = np.meshgrid(np.arange(u - 8, u + 9), np.arange(v - 8, v + 9))
        centre = [(window * d).sum() / window.sum() for d in (du, dv)]
        assert centre == pytest.approx(list(at), abs=0.05)


class FullyTracedBoard(FlatBoard):
    """A board of which every pixel gets all its rays."""

    def find_edges(self, x, y, reach):
        return np.ones(x.shape, dtype=bool)


@pytest.mark.parametrize("turned", [[0.4, 0.2, 0.3], [1.2, 0.1, 0.0], [0.5, np.pi, 0.2]])
def test_pixels_that_see_no_edge_need_one_ray_only(turned, monkeypatch):
    board, R = printed(), turn(np.array(turned))
    r = np.array([0.0, 0.0, 0.4]) - R @ [0.12, 0.09, 0.0]
    image = SMALL.render(board, r, R)
    assert (image == SMALL.render(FullyTracedBoard(board.ink, board.cell), r, R)).all()
    monkeypatch.setattr(FlatBoard, "find_edges", lambda self, x, y, reach: x != x)
    assert (image != SMALL.render(board, r, R)).mean() > 0.01  # the edges do need them
