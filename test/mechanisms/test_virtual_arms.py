"""Arms of six and seven joints by Denavit and Hartenberg's own matrices: found, compared, named."""

from dataclasses import replace

import numpy as np
import pytest
import virtual_arm as va
from arms import nominal, seen
from marks import keep

from parallel_cal.base.rotation import quaternion_to_matrix, rotation_vector
from parallel_cal.causes.effects import (
    collect_recorded_values,
    find_missing_conditions,
    find_new_parameters,
)
from parallel_cal.diagnosis.comparison import compare
from parallel_cal.diagnosis.diagnose import diagnose
from parallel_cal.identification.fit import fit
from parallel_cal.identification.fit_warnings import chi2_band
from parallel_cal.identification.observations import conditions
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.shelf import load_sensor
from parallel_cal.posterior.scene import Scene, columns

HERE = va.Tracker()  # in {B} itself, its target in {P}


def test_an_arm_of_the_data_sheet_is_where_the_matrices_put_it():
    for kind in ("ur5", "wam"):
        exact = va.arm(kind, length=0, angle=0)
        q = va.session(exact, 20).q
        there = Kinematics(nominal(kind)).direct(q)
        T = exact.matrix(q)
        assert np.abs(there.position - T[:, :3, 3]).max() < 1e-12
        assert np.abs(there.rotation - T[:, :3, :3]).max() < 1e-12


@pytest.mark.parametrize("kind", ["ur5", pytest.param("wam", marks=pytest.mark.wide)])
@pytest.mark.parametrize("pose", [True, False], ids=["pose", "position"])
def test_an_arm_is_identified_down_to_the_noise_with_nothing_fixed_by_hand(kind, pose):
    robot = va.arm(kind, 3)
    result = fit(nominal(kind), seen(va.session(robot, 80, 1, HERE), pose), hold_out=0)
    low, high = chi2_band(result.estimate.dof)
    assert result.before.summary.position_rms > 1e-3
    assert low < result.estimate.chi2_per_dof < high
    fresh = seen(va.session(robot, 100, 2, HERE.exact()), pose)
    unseen = compare(result.model, fresh, joint_sigma=1e-5).errors.summary
    assert unseen.position_rms < 30e-6
    if not pose:  # the last joint's own frame is not seen by a target on it
        assert len(result.estimate.spectrum.unidentifiable) == 3


def test_positions_alone_ask_for_no_inverse_problem(monkeypatch):
    """Joint errors need the whole pose; solving for them all the same took nine tenths of a fit."""
    asked = []
    plain = Kinematics.inverse

    def count(self, *given, **options):
        asked.append(given)
        return plain(self, *given, **options)

    monkeypatch.setattr(Kinematics, "inverse", count)
    robot = va.arm("ur5", 3)
    found = compare(nominal("ur5"), seen(va.session(robot, 30, 1, HERE), False)).errors
    assert not asked
    assert np.isnan(found.joint).all()
    assert np.isfinite(found.position).all()
    compare(nominal("ur5"), seen(va.session(robot, 30, 1, HERE)))
    assert asked  # for the joint errors, and for the scale of the readings


def test_columns_computed_through_the_closure_inputs_equal_the_direct_columns():
    data = seen(va.session(va.arm("ur5", 1), 40, 0, HERE))
    result = fit(nominal("ur5"), data, hold_out=0)
    scene = Scene.of(result.model, data, result.observations, result.free)
    for name in ("backlash", "base_compliance", "device_axes", "gear_transmission_error"):
        model = result.model.with_effect(name)
        assert not find_missing_conditions(model, data)
        settings = next(
            iter(model.effects[-1].scan(model.mechanism, collect_recorded_values(data)))
        )
        model = model.with_settings(name, settings)
        new, a = find_new_parameters(result.model, model), conditions(model, data)
        which = tuple(int(i) for i in np.flatnonzero(new))
        by_v = model.structure.columns(which)(scene.x, a, model.values)[0]
        J = scene.whitener @ by_v.reshape(len(data), len(which), -1).transpose(0, 2, 1)
        expected = J.reshape(len(scene.residual), -1) * model.table.tolerance[new]
        B = columns(model, scene, new)
        assert np.abs(B - expected).max() < 1e-11 * np.abs(expected).max()


HIDDEN = {
    "encoder_eccentricity": va.Play(1, eccentric=4e-4),
    "gear_transmission_error": va.Play(2, ripple=2e-4, teeth=23.0),
    "backlash": va.Play(0, backlash=5e-4),
}


@pytest.mark.wide
@pytest.mark.parametrize(
    ("kind", "pose"),
    [
        pytest.param("ur5", True, id="ur5-pose"),
        pytest.param("wam", False, id="wam-position"),
        pytest.param("ur5", False, id="ur5-position", marks=pytest.mark.slow),
        pytest.param("wam", True, id="wam-pose", marks=pytest.mark.slow),
    ],
)
@pytest.mark.parametrize("effect", list(HIDDEN))
def test_the_diagnosis_names_an_effect_hidden_in_a_joint_of_an_arm(kind, effect, pose):
    robot = va.arm(kind, 4, hidden=(HIDDEN[effect],))
    data = seen(va.session(robot, 120, 5, HERE), pose)
    found = diagnose(nominal(kind), data, effects=[*HIDDEN, "encoder_gain", "device_axes"])
    assert found.effects[:1] == (effect,)
    best = found.best.fitted
    assert best.held_out.summary.position_rms < 1.3 * best.noise_floor.position_rms


@pytest.mark.wide
@pytest.mark.parametrize(
    ("effect", "kind"),
    keep(
        [(effect, kind) for effect in HIDDEN for kind in ("ur5", "wam")],
        ("gear_transmission_error", "ur5"),
        ("encoder_eccentricity", "wam"),
    ),
)
def test_the_diagnosis_names_a_joint_effect_although_device_frame_and_target_are_unknown(
    kind, effect
):
    """By the whole catalogue, from positions of a target that nobody measured in {P}; the device is
    said to be a tracker: one that bends its space by 0.1 mm over a metre could have made it."""
    robot = va.arm(kind, 4, hidden=(HIDDEN[effect],))
    data = seen(va.session(robot, 120, 5), False, "tracker")
    tracker = load_sensor("certificate", kind="laser_tracker")
    found = diagnose(nominal(kind).with_sensors((tracker,)), data)
    assert found.registration is not None
    called = {effect} | {name for name, swaps in found.swaps.items() if effect in swaps}
    assert found.effects
    assert found.effects[0] in called
    assert not found.robot_or_device
    assert found.verdict.word == "explained"


@pytest.mark.parametrize("kind", ["ur5", pytest.param("wam", marks=pytest.mark.wide)])
@pytest.mark.parametrize("pose", [True, False], ids=["pose", "position"])
@pytest.mark.parametrize("frame", ["tracker", pytest.param("", marks=pytest.mark.wide)])
def test_a_tracker_that_stands_anywhere_is_registered_and_reported(kind, pose, frame):
    robot = va.arm(kind, 1)
    data, model = seen(va.session(robot, 80), pose, frame), nominal(kind)
    before = compare(model, data)
    assert 0.3e-3 < before.errors.summary.position_rms < 4e-3  # the robot's own, no more
    where = before.registration
    assert where.description in before.dataset.warnings
    assert where.frame == (frame or "device")
    assert np.abs(np.array(where.position) - va.FAR_AWAY.shift).max() < 20e-3
    turned = rotation_vector(quaternion_to_matrix(where.quaternion))
    assert np.abs(turned - va.FAR_AWAY.turned).max() < 20e-3
    assert np.abs(np.array(where.target_position) - va.FAR_AWAY.target).max() < 5e-3

    result = fit(model, data)
    assert (
        sum(
            w.startswith(f"frame '{frame or 'device'}' was registered to 'base'")
            for w in result.warnings
        )
        == 1
    )
    assert result.registration.base == "base"
    assert result.held_out.summary.position_rms < 1.15 * result.noise_floor.position_rms
    # Nothing of the frames that the robot's own numbers say already is left free to run.
    assert len(result.estimate.spectrum.unidentifiable) == (0 if pose else 3)
    moved = (result.model.values - result.model.table.nominal) / result.model.table.tolerance
    assert np.abs(moved).max() < 4
    fresh = seen(va.session(robot, 60, 2, va.FAR_AWAY.exact()), pose, frame)
    unseen = compare(result.model, fresh, joint_sigma=1e-5)
    assert unseen.registration is None  # the model says where the device stands
    assert unseen.errors.summary.position_rms < 30e-6


def test_a_device_in_the_base_is_left_where_it_is():
    """And so is one that a robot's errors alone put a little off."""
    robot = va.arm("ur5", 1)
    for frame in ("", "base"):
        data = seen(va.session(robot, 40, 0, HERE), True, frame)
        assert compare(nominal("ur5"), data).registration is None
    near = va.Tracker((0.002, -0.0015, 0.001), (0.001, 0.0, -0.0015))
    assert compare(nominal("ur5"), seen(va.session(robot, 40, 0, near))).registration is None


def test_a_tracker_moved_to_another_place_is_found_again():
    robot = va.arm("ur5", 1)
    known = fit(nominal("ur5"), seen(va.session(robot, 60), True, "tracker"), hold_out=0).model
    elsewhere = replace(va.FAR_AWAY, shift=(1.0, 1.5, -0.2), turned=(0.1, 0.3, -2.5))
    again = compare(known, seen(va.session(robot, 40, 3, elsewhere), True, "tracker"))
    assert np.abs(np.array(again.registration.position) - elsewhere.shift).max() < 20e-3
    assert again.errors.summary.position_rms < 60e-6
