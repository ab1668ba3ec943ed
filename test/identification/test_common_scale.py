"""A board printed to another scale contradicts the robot's nominal lengths: the fit says so."""

import dataclasses
import re

import numpy as np
import pytest
from camera_cells import Cell
from marks import keep

import parallel_cal as pc
from parallel_cal.base.errors import FitError
from parallel_cal.identification.common_scale import CommonScale
from parallel_cal.identification.observations import observe


def fit_with_square(kind, factor):
    """Return the warnings of a fit, or its refusal, with squares that are wrong by a factor."""
    cell = Cell(kind, 1)
    sensor = dataclasses.replace(cell.sensor(), square=0.03 * factor)
    try:
        found = pc.fit(cell.drawn.with_sensors((sensor,)), cell.seen_by_camera(30), hold_out=0)
    except FitError as refused:
        return str(refused)
    return "\n".join(found.warnings)


@pytest.mark.wide
@pytest.mark.parametrize(
    ("kind", "factor", "side"),
    keep(
        [("delta", 1.05, "larger"), ("stewart", 0.98, "smaller"), ("ur5", 1.01, "larger")],
        ("stewart", 0.98, "smaller"),
        ("ur5", 1.01, "larger"),
    ),
)
def test_a_board_printed_to_another_scale_is_named(kind, factor, side):
    """1 % is plausible and was silent; 5 % ended with a length of the robot, not of the board."""
    words = fit_with_square(kind, factor)
    found = re.search(rf"the robot is ([\d.]+) % .* {side} .* square is about ([\d.]+) m", words)
    assert float(found[1]) == pytest.approx(100 * abs(factor - 1), abs=0.4)
    assert float(found[2]) == pytest.approx(0.03, rel=4e-3)


@pytest.mark.wide
@pytest.mark.parametrize("kind", keep(["delta", "stewart", "ur5"], "delta"))
def test_a_board_of_the_stated_size_is_not_questioned(kind):
    assert "square is about" not in fit_with_square(kind, 1.0)


@pytest.mark.wide
def test_legs_that_read_lengths_correct_the_size_of_the_board():
    cell = Cell("stewart", 1)
    sensor = dataclasses.replace(cell.sensor(), square=0.98 * 0.03)
    model = cell.drawn.with_sensors((sensor,))
    data = cell.seen_by_camera(30)
    scale = pc.fit(model, data, hold_out=0, free=["camera.scale"]).parameters()["camera.scale"]
    assert abs(scale.value - 1 / 0.98) < 4 * scale.sigma < 6e-3


def test_a_robot_without_free_lengths_is_no_ruler():
    cell = Cell("stewart", 1)
    model, data = cell.drawn.with_sensors((cell.sensor(),)), cell.seen_by_camera(12)
    free = ~np.asarray(model.fixed)
    free[: len(model.mechanism.parameters)] = False
    assert CommonScale.find(model, observe(model, data), free) is None


def test_only_a_stated_length_that_the_fit_keeps_is_questioned():
    cell = Cell("ur5", 1)
    model, data = cell.drawn.with_sensors((cell.sensor(),)), cell.seen_by_camera(12)
    # A robot that is 3 % larger than its drawing, seen by the camera as it is.
    table, n = model.table, len(model.mechanism.parameters)
    lengths = np.array([p.unit == "m" for p in table]) & (np.arange(len(table)) < n)
    model = model.with_values(np.where(lengths, 1.03 * table.nominal, table.nominal))
    free = ~np.asarray(model.fixed)
    free[table.names.index("camera.scale")] = True
    assert CommonScale.find(model, observe(model, data), free) is None
    tracked = model.with_sensors(())
    free = ~np.asarray(tracked.fixed)
    assert CommonScale.find(tracked, observe(tracked, cell.seen_by_tracker(12)), free) is None
