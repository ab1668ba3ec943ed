"""What readings may have meant, and when no such meaning is named."""

from dataclasses import replace

import numpy as np
import pytest
from datasets import measured

from parallel_cal.identification.column_doubts import doubt_columns
from parallel_cal.identification.observations import observe
from parallel_cal.identification.registration import DevicePoses
from parallel_cal.model.model import new_model

MODEL = new_model("delta24")


@pytest.fixture(scope="module")
def session():
    return measured()


def doubt(dataset, **limits):
    observations = observe(MODEL, dataset, insist=True)
    there = DevicePoses.of(MODEL, observations)
    return doubt_columns(MODEL, observations, there, "", suspected=True, **limits)


def exchanged(dataset):
    return replace(dataset, q=dataset.q[:, [1, 0, 2]])


def in_millimetres(dataset):
    return replace(dataset, r=1e3 * dataset.r)


def test_positions_in_mm_are_named_only_if_nothing_else_is_wrong(session):
    """Beside exchanged columns, too, m in place of mm makes errors a thousand times smaller. They
    are then still 33 mm, most of the motion: who corrected that alone would be misled."""
    assert "positions are in mm, not m" in doubt(in_millimetres(session))
    assert doubt(exchanged(in_millimetres(session))) == ""


def test_positions_in_inches_are_named(session):
    assert "positions are in inches, not mm" in doubt(replace(session, r=session.r / 25.4))


def test_other_columns_are_named_only_if_they_fit_better_than_what_is_known(session):
    """An error of the robot that explains the samples better than exchanged columns do is likelier
    than those, which leave 0.07 mm before a fit."""
    assert "joint1, joint2 are in the columns of joint2, joint1" in doubt(
        exchanged(session), most=1e-4
    )
    assert doubt(exchanged(session), most=5e-5) == ""


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"q": np.diag([-1.0, -1.0, 1.0])}, "joint1, joint2 have the other sign (column map: j"),
        ({"q": np.radians(1.0) * np.eye(3)}, "the joints are in rad, not deg (column map: unit)"),
        ({"r": np.diag([1.0, -1.0, 1.0])}, "the frame of the device is left-handed (two"),
    ],
    ids=["signs", "unit", "left-handed"],
)
def test_what_readings_meant_is_named_with_the_entry_of_a_column_map(session, change, words):
    assert words in doubt(
        replace(session, **{name: getattr(session, name) @ M for name, M in change.items()})
    )
