"""The sled on two lines, worked by hand: line lengths, the balance of its weight, refusals."""

import numpy as np
import pytest

from parallel_cal.base.errors import ModelError
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.model import new_model
from parallel_cal.model.shelf import load_mechanism

EYE = np.eye(3)
QUARTER = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
STEEP, FLAT = np.arctan2(4, 3), np.arctan2(3, 4)
# The left line spans (3, -4), the right one (-4, -3): both are 5 long and meet at the tool.
SLED = {
    **{"left.A_x": -3, "left.A_y": 4, "left.B_x": 0, "left.B_y": 0, "left.L0": 0},
    **{"right.A_x": 4, "right.A_y": 3, "right.B_x": 0, "right.B_y": 0, "right.L0": 0},
    **{"sled.G_x": 0, "sled.G_y": -1, "wheels.radius": 0, "sled.standoff": 0},
}
# Lengths of the left and the right line, and the lever of the weight. With the left mount at (0, 1)
# or (1, 0), that line falls at 45 degrees: the tensions are 0.8 sqrt(2) / 1.4 and 1 / 1.4. With the
# right one at (1, 0) or (0, -1), they are 1 / 1.4 and 0.6 sqrt(2) / 1.4.
BY_HAND = {
    "": (0, (5, 5, 0)),
    "left.A_x": (-4, (4 * 2**0.5, 5, 0)),
    "left.A_y": (3, (3 * 2**0.5, 5, 0)),
    "left.B_x": (1, (4 * 2**0.5, 5, 4 / 7)),
    "left.B_y": (1, (3 * 2**0.5, 5, 4 / 7)),
    "left.L0": (2, (3, 5, 0)),
    "right.A_x": (3, (5, 3 * 2**0.5, 0)),
    "right.A_y": (4, (5, 4 * 2**0.5, 0)),
    "right.B_x": (1, (5, 3 * 2**0.5, 3 / 7)),
    "right.B_y": (-1, (5, 4 * 2**0.5, 3 / 7)),
    "right.L0": (3, (5, 2, 0)),
    "sled.G_x": (0.5, (5, 5, -0.5)),
    "sled.G_y": (-3, (5, 5, 0)),
    "sled.standoff": (12, (13, 13, 0)),
    # A wheel of 3 leaves 4 of the 5. The left line hangs straight down.
    "wheels.radius": (3, (4 + 3 * np.pi / 2, 4 + 6 * FLAT, 0)),
}


def phi(mechanism, values, R=EYE):
    model = new_model(mechanism, values)
    configuration = np.concatenate([np.zeros(2), np.zeros(3), R.ravel()])
    return np.array(model.structure.closure(configuration, [], model.values)[0]).ravel()


@pytest.mark.parametrize("changed", BY_HAND, ids=lambda name: name or "nothing")
def test_lines_and_lever_are_what_paper_and_pencil_say(changed):
    value, expected = BY_HAND[changed]
    values = SLED | ({changed: value} if changed else {})
    found = phi(load_mechanism("hanging_sled"), values)
    np.testing.assert_allclose(found, expected, atol=1e-12)
    assert set(SLED) == set(load_mechanism("hanging_sled").parameters.names)


def test_a_sled_that_is_turned_by_a_quarter_has_its_weight_beside_the_tool():
    np.testing.assert_allclose(
        phi(load_mechanism("hanging_sled"), SLED, QUARTER), [5, 5, -1], atol=1e-12
    )


@pytest.mark.parametrize(
    ("over", "expected"),
    [
        # The left line falls with the sine 7/25, the right one is level: tensions 25/7 and 24/7,
        # each 3 away from the tool.
        (True, (4 + 3 * (np.pi - STEEP + FLAT), 4 + 3 * np.pi, 3 / 7)),
        # The left line hangs straight down, 3 to the left of the tool, and bears the weight.
        (False, (4 + 3 * np.pi / 2, 4 + 6 * FLAT, -3)),
    ],
)
def test_a_line_over_a_wheel_of_the_sled_pulls_where_it_touches(over, expected):
    sled = load_mechanism("hanging_sled", wheels="sled", over=over)
    np.testing.assert_allclose(phi(sled, SLED | {"wheels.radius": 3}), expected, atol=1e-12)


def test_a_line_that_leaves_its_sprocket_at_the_bottom_counts_the_longer_arc():
    under = load_mechanism("hanging_sled", over=False)
    expected = (4 + 3 * (np.pi - STEEP + FLAT), 4 + 3 * np.pi, 0)
    np.testing.assert_allclose(phi(under, SLED | {"wheels.radius": 3}), expected, atol=1e-12)


def test_a_sled_on_a_ring_does_not_tilt_and_what_only_a_tilt_shows_is_fixed():
    ring = new_model(load_mechanism("hanging_sled", mounts=[[0, 0], [0, 0]]))
    r = np.array([[0.9, 0.4, 0.0], [-1.0, -0.3, 0.0]])
    found = Kinematics(ring).inverse(r)
    np.testing.assert_allclose(found.rotation, [EYE, EYE], atol=1e-12)
    fixed = {name for name, no in zip(ring.table.names, ring.fixed, strict=True) if no}
    assert fixed == {f"{side}.B_{axis}" for side in ("left", "right") for axis in "xy"} | {
        "sled.G_x",
        "sled.G_y",
        "sled.standoff",
    }


def test_readings_are_whole_lengths_if_lines_count_from_zero():
    lengths = load_mechanism("hanging_sled", retracted=0).home.joints
    change = load_mechanism("hanging_sled")
    table = dict(zip(change.parameters.names, change.parameters.nominal, strict=True))
    assert change.home.joints == (0.0, 0.0)
    assert lengths == pytest.approx((table["left.L0"], table["right.L0"]), abs=1e-12)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"anchors": [[0, 1]]}, r"anchors is \[\[0, 1\]\]: expected two points \[x, y\] in m"),
        ({"anchors": [[1, 1], [-1, 1]]}, r"expected the left one first, and both between"),
        ({"home": [0, 1]}, r"a mount is at y 1.139 m at home \[0.0, 1.0\], as high as an anchor"),
        ({"below": 0}, r"below is 0: expected one number, above 0"),
        ({"wheels": "sleigh"}, r"wheels is 'sleigh': expected frame or sled"),
        ({"radius": -1}, r"radius is -1: expected one number, at least 0"),
        (
            {"mounts": [[-0.155, -0.3], [0.155, -0.3]], "below": 0.01},
            r"no tilt balances the sled at home \[0.0, 0.0\]: expected a centre of gravity further",
        ),
    ],
)
def test_sleds_that_cannot_hang_are_refused(options, message):
    with pytest.raises(ModelError, match=message):
        load_mechanism("hanging_sled", **options)


def test_gravity_across_the_plane_is_refused():
    sled = load_mechanism("hanging_sled")
    sled.gravity = (0.0, 0.0, -9.81)
    with pytest.raises(ModelError, match=r"gravity .* does not act in the plane x, y"):
        Kinematics(new_model(sled)).inverse([[0.1, 0.1, 0.0]])


def test_a_level_chain_sags_by_its_weight_squared_over_its_tension_squared():
    """The right line is level: 4 m of it under 3/4 of the weight, w / weight = 0.01 per metre, sag
    by w^2 S^3 / (24 t^2), beside what they sag at home."""
    ring = load_mechanism(
        "hanging_sled",
        **{"anchors": [[-3, 4], [4, 1e-9]], "mounts": [[0, 0], [0, 0]], "below": 1e-3},
        **{"radius": 0, "retracted": 0, "home": [0, -1]},
    )
    model = new_model(ring).with_effect("line_sag")
    names = list(model.table.names)
    values = model.values.copy()
    values[names.index("line_sag.sag")] = 0.01**2
    at = Kinematics(model.with_values(values)).inverse([[0.0, 0.0, 0.0], [0.0, -1.0, 0.0]]).joints
    plain = Kinematics(model).inverse([[0.0, 0.0, 0.0], [0.0, -1.0, 0.0]]).joints
    (left, right), home = at[0] - plain[0], at[1] - plain[1]
    np.testing.assert_allclose(home, 0, atol=1e-12)
    # At home, the tensions follow from the directions (-3, 5) and (4, 1), as the spans do.
    pull = np.linalg.solve([[-3 / 34**0.5, 4 / 17**0.5], [5 / 34**0.5, 1 / 17**0.5]], [0, 1])
    flat = np.array([3, 4])
    there = 0.01**2 / 24 * flat**2 * np.sqrt([34, 17]) / pull**2
    here = 0.01**2 / 24 * np.array([9 * 5 / 1.25**2, 4**3 / 0.75**2])
    np.testing.assert_allclose([left, right], here - there, rtol=2e-3)
