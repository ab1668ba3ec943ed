"""Flat maps: residual arrows from three sides, and the model's sigma over its workspace."""

from dataclasses import replace

import numpy as np
import plotly.graph_objects as go
import pytest
from datasets import measured

from parallel_cal.identification.fit import fit
from parallel_cal.identification.position_uncertainty import PositionDifference, PositionUncertainty
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.model import new_model
from parallel_cal.model.shelf import load_sensor
from parallel_cal.reporting import maps

PLACES = np.array([[0.0, 0.0, 0.1], [0.1, 0.0, 0.1], [0.0, 0.1, 0.2]])
FIELD = np.array([[1e-4, 0.0, 0.0], [0.0, 0.0, 2e-4], [0.0, -1e-4, 0.0]])


@pytest.fixture(scope="module")
def identified():
    return fit(new_model("delta54"), measured(0), hold_out=0).model


def of(figure, name):
    return [trace for trace in figure["data"] if trace["name"] == name]


def test_plan_front_and_side_show_the_same_arrows_on_one_scale_with_equal_axes():
    drawn, scale = maps.residuals(PLACES, [FIELD], "position", np.array([4, 5, 6]))
    go.Figure(drawn)
    # 0.173 m from corner to corner; 16 % of it for 0.18 mm is 153 times: 100.
    assert scale == 100.0
    plan, front, side = of(drawn, "residual")
    assert plan["x"][:2] == [0.0, 10.0]  # 0.1 mm, 100 times
    assert plan["x"][2] is None
    # The second arrow is the largest and is drawn last.
    assert (front["y"][6], front["y"][7]) == (100.0, 120.0)
    assert (side["x"][3], side["x"][4]) == (100.0, 90.0)
    assert side["customdata"][::3] == [4, 6, 5]
    layout = drawn["layout"]
    assert [layout[f"yaxis{k}"]["scaleanchor"] for k in ("", "2", "3")] == ["x", "x2", "x3"]
    assert [layout[f"xaxis{k}"]["title"]["text"] for k in ("", "2", "3")] == [
        "plan: x of base [mm]",
        "front: x of base [mm]",
        "side: y of base [mm]",
    ]


def test_the_largest_residual_is_drawn_on_top_of_all_others_however_many_there_are():
    count = 3 * maps.MAX_ARROWS
    field = np.tile(FIELD[0], (count, 1))
    field[100] *= 5
    drawn, _ = maps.residuals(np.tile(PLACES[0], (count, 1)), [field], "position", np.arange(count))
    for one in of(drawn, "residual"):
        assert one["customdata"][-1] == 100


def test_a_bar_says_how_long_a_residual_of_a_round_size_is_drawn():
    drawn, scale = maps.residuals(PLACES, [FIELD], "position", np.arange(3))
    bar = of(drawn, "scale")[0]
    assert bar["text"][1] == "100 µm"
    assert bar["x"][1] - bar["x"][0] == pytest.approx(1e3 * scale * 1e-4)


def test_the_workspace_map_has_the_sigma_that_the_answered_pose_has(identified):
    found = PositionUncertainty.of(identified)
    assert found.across == "xyz"
    assert len(found.places) == 3 * 49 - 3 * 7 + 1  # three grids, what they share once
    at = found.places[30]
    k = Kinematics(identified)
    own = k.direct_covariance(k.inverse(at))[:3, :3]
    np.testing.assert_allclose(found.covariance[30], own, rtol=1e-6, atol=1e-18)
    drawn, scale = maps.workspace(found)
    go.Figure(drawn)
    plan = of(drawn, "1 σ of the model")[0]
    x = np.array(plan["x"][: maps.CORNERS], dtype=float)
    middle = np.isclose(found.places[:, 2], np.median(found.places[:, 2]))
    sigma = np.sqrt(found.covariance[middle][0, 0, 0])
    assert np.ptp(x) / 2 == pytest.approx(1e3 * scale * sigma, rel=5e-3)


def test_a_model_that_was_never_identified_has_no_workspace_map():
    assert PositionUncertainty.of(new_model("delta54")) is None


def test_a_robot_that_only_turns_has_no_map_of_places(identified):
    model = new_model("argos9")
    values = np.eye(len(model.values)) * 1e-8
    assert PositionUncertainty.of(model.with_values(model.values, values)) is None


def test_a_planar_robot_is_shown_only_in_plan():
    model = new_model("planar_stewart")
    model = model.with_values(model.values, np.eye(len(model.values)) * 1e-10)
    found = PositionUncertainty.of(model)
    assert found.across == "xy"
    assert len(of(maps.workspace(found)[0], "pose")) == 1


LEGS, WIDTH = range(1, 7), 0.2e-3  # m


@pytest.fixture(scope="module")
def hexapods():
    """Return a hexapod, and one whose legs have backlash."""
    rigid = new_model("stewart42")
    loose = rigid.with_effect("backlash")
    width = loose.table.matching(["backlash.*.width"])
    return rigid, loose.with_values(np.where(width, WIDTH, loose.values))


def test_a_map_says_for_which_orientation_and_conditions_it_holds(hexapods):
    neutral = "in home orientation, at neutral conditions (direction 0)"
    words = ("in home orientation", neutral)
    for model, validity in zip(hexapods, words, strict=True):
        one = model.with_values(model.values, np.eye(len(model.values)) * 1e-10)
        assert PositionUncertainty.of(one).validity == validity
    tilted = new_model("planar_stewart")
    box = tilted.mechanism.workspace
    tilted.mechanism.workspace = replace(box, low=(*box.low[:2], box.low[2] + 0.1))
    found = PositionDifference.of(tilted, tilted)
    assert found.validity == "in the workspace's middle orientation"


def test_the_difference_of_a_model_with_backlash_contains_the_backlash(hexapods):
    """All legs on one side of their backlash, they are half a width longer or shorter."""
    neutral = PositionDifference.of(*hexapods)
    assert np.abs(neutral.difference).max() < 1e-9
    assert neutral.validity == "in home orientation, at neutral conditions (direction 0)"
    up, down = (
        PositionDifference.of(*hexapods, {f"direction.leg{i}": np.array([side]) for i in LEGS})
        for side in (1.0, -1.0)
    )
    assert np.linalg.norm(up.difference, axis=1).min() > 0.5 * WIDTH
    np.testing.assert_allclose(up.difference, -down.difference, atol=0.01 * WIDTH)
    assert up.validity == (
        "in home orientation, each place with the direction of a sample drawn at random"
    )


def test_models_whose_bases_are_placed_differently_are_compared_as_the_device_sees_them():
    """A hexapod with all feet 0.6 mm and the device 0.6 mm lower is the same robot: its pictures
    differed by 0.6 mm, and that was shown as an error."""
    one = new_model("stewart42", sensors=[load_sensor("device_frame", position=(1.0, 2.0, 0.5))])
    numbers = one.table.mapping(one.values)
    lowered = {
        name: value - 0.6e-3
        for name, value in numbers.items()
        if name.endswith("C_z") or name == "device_frame.frame.z"
    }
    values = np.array(list((numbers | lowered).values()))
    assert sum(values != one.values) == 7
    found = PositionDifference.of(one, one.with_values(values))
    assert np.abs(found.difference).max() < 1e-9
    assert found.frames_apart == pytest.approx(0.6e-3, rel=1e-6)
    lower = dict(lowered, **{"device_frame.frame.z": 0.0})
    values = np.array(list((numbers | lower).values()))
    found = PositionDifference.of(one, one.with_values(values))
    np.testing.assert_allclose(found.difference[:, 2], -0.6e-3, rtol=1e-6)
    assert found.frames_apart < 1e-12


def test_the_places_of_a_difference_get_the_conditions_of_whole_samples(hexapods):
    one_side = {f"direction.leg{i}": np.array([1.0, -1.0]) for i in LEGS}
    found = [PositionDifference.of(*hexapods, one_side) for _ in range(2)]
    np.testing.assert_array_equal(found[0].difference, found[1].difference)
    up = np.sign(found[0].difference[:, 2])
    assert {-1, 1} == set(up)
    # Legs of one sample are all on one side, so no leg moves the platform against another.
    assert np.linalg.norm(found[0].difference, axis=1).min() > 0.5 * WIDTH
