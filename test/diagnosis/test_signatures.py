"""The pattern that a candidate would leave, laid over the measured residuals."""

from dataclasses import replace

import numpy as np
import pytest
import virtual_setups as vs
from datasets import measured, orientations
from tied import dataset as tied

from parallel_cal.diagnosis.catalogue import candidate
from parallel_cal.diagnosis.comparison import compare
from parallel_cal.diagnosis.signature import (
    compute_joint_components,
    compute_pattern_strength,
    signature,
)
from parallel_cal.identification.fit import fit
from parallel_cal.model.model import new_model
from parallel_cal.model.shelf import load_sensor
from parallel_cal.posterior.scene import Scene
from parallel_cal.reporting import signatures
from parallel_cal.virtual import joint_effects as vj
from parallel_cal.virtual import robot as vr

RATIO = 80.0


def fitted_scene(data, model="delta54"):
    result = fit(new_model(model), data, hold_out=0)
    return Scene.of(result.model, data, result.observations, result.free)


@pytest.fixture(scope="module")
def play():
    return fitted_scene(measured(0, effects=[vr.Backlash((6e-4, 5e-4, 4e-4))]))


@pytest.fixture(scope="module")
def ripple():
    wave = vj.GearRipple(RATIO, (4e-4, 3e-4, 5e-4), (0.3, 1.0, 2.0))
    return fitted_scene(measured(0, effects=[wave], n_poses=120))


def test_a_joints_own_residual_is_measured_minus_the_inverse_of_the_measured_position(play):
    positions = replace(
        play.dataset, measured=np.tile([True] * 3 + [False] * 3, (len(play.dataset), 1))
    )
    result = fit(new_model("delta24"), positions, hold_out=0)
    scene = Scene.of(result.model, positions, result.observations, result.free)
    found = compute_joint_components(scene)
    own = found.values(scene.by_sample(scene.residual))
    exact = compare(result.model, positions).errors.joint
    np.testing.assert_allclose(own, exact, atol=2e-3 * np.abs(exact).max())


def test_a_joint_that_reads_too_much_has_a_residual_of_just_that_much():
    data = measured(0, noise=vr.Noise(1e-12, 1e-12, 1e-12))
    model = fit(new_model("delta54"), data, hold_out=0).model
    q = np.array(data.q)
    q[7, 1] += 1e-4
    found = compare(model, replace(data, q=q, joint_sigma=[1e-5] * 3)).scene
    rows = found.by_sample(found.residual)
    own = compute_joint_components(found).values(rows)[7]
    # What 54 parameters take of one reading among all is a few parts in a hundred.
    assert own == pytest.approx([0.0, 1e-4, 0.0], abs=1.2e-5)


def test_only_the_pattern_of_backlash_has_the_two_levels_of_the_residuals(play):
    found = signature(candidate(play, "backlash"))
    assert [(p.component, p.abscissa) for p in found.panels] == [
        (f"joint{k}", f"direction.joint{k}") for k in (1, 2, 3)
    ]
    for panel, width in zip(found.panels, (6e-4, 5e-4, 4e-4), strict=True):
        levels = [panel.residual[panel.at == way].mean() for way in (-1, 1)]
        pattern = [panel.pattern[panel.at == way].mean() for way in (-1, 1)]
        assert pattern == pytest.approx(levels, abs=0.1)
        assert levels[0] < -0.5 < 0.5 < levels[1]
        # Half the play to each side, less what geometry and chance take of it.
        way = np.where(panel.at > 0, 1, -1)
        k = int(panel.component[-1]) - 1
        apart = np.ptp([found.joints[way == w, k].mean() for w in (-1, 1)])
        assert 0.6 * width < apart < 1.05 * width
    other = signature(candidate(play, "encoder_gain"))
    assert max(p.pattern.std() for p in other.panels) < 0.3 * found.panels[0].pattern.std()


def test_a_gears_pattern_is_laid_into_one_turn_of_its_input(ripple):
    found = signature(candidate(ripple, "gear_transmission_error"))
    panel = found.panels[2]
    assert panel.period == pytest.approx(2 * np.pi / RATIO, rel=2e-3)
    assert 0 <= panel.at.min() < panel.at.max() <= panel.period
    assert np.corrcoef(panel.residual, panel.pattern)[0, 1] > 0.8
    # Where it is folded the ripple is one curve: bins of an eighth of a turn show most of it.
    assert compute_pattern_strength(panel.at, panel.pattern) > 0.6 * np.mean(panel.pattern**2)
    joint = dict(zip(ripple.model.joints, ripple.x.T, strict=False))["joint3"]
    assert compute_pattern_strength(joint, panel.pattern) < 0.2 * np.mean(panel.pattern**2)


def test_an_effect_that_touches_no_joint_is_shown_in_the_coordinates_that_follow_it_most():
    drift = vj.CreepingStand((0.0, 4e-7, 0.0), (0.0, 0.0, 0.0))  # m/s
    scene = fitted_scene(measured(0, effects=[drift]))
    found = signature(candidate(scene, "base_drift"))
    assert (found.panels[0].component, found.panels[0].abscissa) == ("y", "time")
    assert np.corrcoef(found.panels[0].residual, found.panels[0].pattern)[0, 1] > 0.6


def test_a_pattern_explains_no_more_than_the_candidates_columns_do(play):
    one = candidate(play, "backlash")
    found = one.score.U @ (one.score.U.T @ play.residual)
    left = play.residual - found
    assert found @ left == pytest.approx(0.0, abs=1e-6 * (found @ found))


@pytest.mark.wide
def test_orientations_alone_and_readings_alone_have_signatures_too():
    turned = signature(candidate(fitted_scene(orientations(), "argos9"), "encoder_eccentricity"))
    assert [p.abscissa for p in turned.panels] == ["joint1", "joint2", "joint3"]

    plate = vs.Plate()
    sensor = load_sensor(
        "plane_spheres",
        height=plate.height,
        holes=plate.holes,
        bars=(plate.bar,) * len(plate.holes),
    )
    data = tied(plate, *plate.session(vs.random_delta(0), 25, 0))
    result = fit(new_model("delta24", sensors=[sensor]), data, hold_out=0)
    scene = Scene.of(result.model, data, result.observations, result.free)
    # One length a sample says nothing of a single joint: what was read is shown.
    assert not compute_joint_components(scene).names
    found = signature(candidate(scene, "encoder_eccentricity"))
    assert {p.component for p in found.panels} <= set(scene.model.structure.channels)
    assert len(found.panels[0].sample) < len(data)  # of a hole only those of this hole


def test_what_was_not_tested_has_no_signature(play):
    with pytest.raises(ValueError, match="could not be tested: cannot be tested: it needs"):
        signature(candidate(play, "zero_shift"))


def test_the_figure_shows_measured_means_and_pattern_in_sigmas(ripple):
    import plotly.graph_objects as go

    found = signature(candidate(ripple, "gear_transmission_error"))
    drawn = signatures.figure(found, ripple.model.mechanism)
    go.Figure(drawn)
    names = [trace["name"] for trace in drawn["data"] if trace["showlegend"]]
    assert names == [
        "measured",
        "99 % band",
        "measured, mean",
        "pattern of gear_transmission_error",
    ]
    layout = drawn["layout"]
    assert layout["xaxis"]["title"]["text"] == "joint1 mod 4.50 deg [deg]"
    assert layout["yaxis3"]["title"]["text"] == "joint3 residual [σ]"
    assert layout["yaxis"]["range"] == layout["yaxis2"]["range"]
    mean, pattern = (np.array(drawn["data"][k]["y"], dtype=float) for k in (2, 3))
    assert np.abs(mean - pattern).max() < 0.9 < np.abs(pattern).max()  # sigmas
