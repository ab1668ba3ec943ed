"""Each joint's own residual against its own reading, straight and round."""

from dataclasses import replace

import numpy as np
import plotly.graph_objects as go
import pytest
from datasets import measured

from parallel_cal.diagnosis.catalogue import candidate
from parallel_cal.diagnosis.comparison import compare
from parallel_cal.diagnosis.signature import signature
from parallel_cal.identification.fit import fit
from parallel_cal.model.model import new_model
from parallel_cal.posterior.scene import Scene
from parallel_cal.reporting import joint_panels, signatures
from parallel_cal.reporting.contents import JointResiduals
from parallel_cal.virtual import joint_effects as vj
from parallel_cal.virtual import robot as vr

RATIO, SIZE, PHASE = 80.0, (4e-4, 3e-4, 5e-4), (0.3, 1.0, 2.0)


@pytest.fixture(scope="module")
def scene():
    data = measured(0, effects=[vj.GearRipple(RATIO, SIZE, PHASE)], n_poses=120)
    result = fit(new_model("delta54"), data, hold_out=0)
    return Scene.of(result.model, data, result.observations, result.free)


@pytest.fixture(scope="module")
def found(scene):
    return JointResiduals.of(scene)


@pytest.fixture(scope="module")
def gear(scene):
    return signature(candidate(scene, "gear_transmission_error"))


def trace(figure, name, axis="xaxis", mark="x"):
    return next(t for t in figure["data"] if t.get("name") == name and t[axis] == mark)


def test_a_panel_a_joint_shows_each_sample_at_its_reading_with_its_number(found):
    drawn = joint_panels.flat_panels(found)
    go.Figure(drawn)
    titles = [drawn["layout"][f"yaxis{k}"]["title"]["text"] for k in ("", "2", "3")]
    assert titles == [f"joint{k} residual [mrad]" for k in (1, 2, 3)]
    points = trace(drawn, "measured", mark="x2")
    np.testing.assert_allclose(points["x"], np.degrees(found.readings[:, 1]), rtol=1e-4)
    np.testing.assert_allclose(points["y"], 1e3 * found.errors[:, 1], rtol=1e-4)
    assert points["customdata"] == found.sample.tolist()


def test_points_of_a_part_of_the_samples_say_so_and_leave_the_means_of_all(found, scene, gear):
    few = found.sample[5:40:5]
    whole, drawn = joint_panels.flat_panels(found), joint_panels.flat_panels(found, shown=few)
    name = f"measured (7 of {len(found.sample)})"
    assert trace(drawn, name, mark="x3")["customdata"] == few.tolist()
    mean = "mean of the measured"
    assert trace(drawn, mark="x3", name=mean) == trace(whole, mark="x3", name=mean)
    laid = signatures.figure(gear, scene.model.mechanism, few)
    assert trace(laid, name, mark="x2")["customdata"] == few.tolist()


def test_the_means_of_many_samples_of_a_joint_are_few(found, monkeypatch):
    monkeypatch.setattr(joint_panels, "MAX_MEANS", 4)
    order = np.argsort(found.readings[:, 0])
    drawn = trace(joint_panels.flat_panels(found), "mean of the measured")
    for values, factor, shown in (
        (found.readings[order, 0], np.degrees(1), drawn["x"]),
        (found.errors[order, 0], 1e3, drawn["y"]),
    ):
        np.testing.assert_allclose(shown, factor * values.reshape(4, -1).mean(axis=1), rtol=1e-3)


def test_a_gears_ripple_is_laid_over_as_the_wave_that_it_is(found, gear):
    name = "pattern of gear_transmission_error"
    laid = trace(joint_panels.flat_panels(found, gear), name, mark="x3")
    assert laid["mode"] == "lines"
    q, drawn = np.radians(laid["x"]), 1e-3 * np.array(laid["y"])
    turned = RATIO * q + PHASE[2]
    # The arm is ahead of its reading by the ripple: the joint reads too little by as much.
    true = -SIZE[2] * (np.sin(turned) + np.sin(2 * turned) / 3)
    assert np.corrcoef(drawn, true)[0, 1] > 0.97
    assert np.std(drawn) == pytest.approx(np.std(true), rel=0.15)


def test_the_pattern_of_backlash_is_drawn_as_points():
    data = measured(0, effects=[vr.Backlash((6e-4, 5e-4, 4e-4))])
    result = fit(new_model("delta54"), data, hold_out=0)
    scene = Scene.of(result.model, data, result.observations, result.free)
    one = signature(candidate(scene, "backlash"))
    laid = trace(joint_panels.flat_panels(JointResiduals.of(scene), one), "pattern of backlash")
    assert laid["mode"] == "markers"


def test_in_the_polar_plot_a_positive_joint_error_points_outwards(found, gear):
    drawn = joint_panels.polar_panels(found, gear)
    go.Figure(drawn)
    points = trace(drawn, "measured", "subplot", "polar3")
    np.testing.assert_allclose(points["theta"], np.degrees(found.readings[:, 2]), rtol=1e-4)
    np.testing.assert_allclose(points["r"], 1e3 * found.errors[:, 2], rtol=1e-4)
    axis = drawn["layout"]["polar"]["radialaxis"]
    assert axis["ticktext"][1] == "0 mrad"
    assert axis["range"][0] < -max(axis["tickvals"])  # no residual is at the middle, or beyond it
    low, high = drawn["layout"]["polar"]["sector"]
    assert low < np.degrees(found.readings.min()) < np.degrees(found.readings.max()) < high


def test_sliding_joints_are_in_micrometres_and_have_no_round(found):
    sliding = replace(found, units=("m",) * 3)
    assert joint_panels.polar_panels(sliding) is None
    drawn = joint_panels.flat_panels(sliding)
    assert drawn["layout"]["yaxis"]["title"]["text"] == "joint1 residual [µm]"
    assert drawn["layout"]["xaxis"]["title"]["text"] == "joint1 [mm]"


def test_a_comparison_has_its_joint_residuals_without_any_fit(scene):
    own = JointResiduals.of(compare(scene.model, scene.dataset).scene)
    assert own.joints == scene.model.joints
    assert np.isfinite(own.errors).all()
