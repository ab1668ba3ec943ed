"""One table of units serves files, controllers, screens and the column map's schema."""

import math
from typing import get_args

import pytest

from parallel_cal.base import units


def test_a_column_map_takes_every_unit_of_the_table():
    assert set(get_args(units.Length)) == set(units.LENGTHS)
    assert set(get_args(units.Angle)) == set(units.ANGLES)


def test_an_alias_names_a_unit_of_the_table():
    assert set(units.UNIT_ALIASES.values()) <= set(units.UNITS)
    assert not set(units.UNIT_ALIASES) & set(units.UNITS)


@pytest.mark.parametrize(
    ("name", "factor"),
    [("mm", 1e-3), ("inch", 0.0254), ("degrees", math.pi / 180), ("rev", 2 * math.pi)],
)
def test_a_name_or_its_alias_has_an_si_factor(name, factor):
    assert units.si_factor(name) == pytest.approx(factor, rel=1e-15)


def test_errors_are_shown_in_um_and_arcmin():
    assert units.ERROR_UNITS["position"] == ("um", 1e6)
    assert units.ERROR_UNITS["orientation"] == ("arcmin", pytest.approx(10_800 / math.pi))
    assert units.ERROR_UNITS["reading"] == ("um", 1e6)
