"""Effects of encoders, gears, clocks and devices: by hand, and found in the virtual robot."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np
import pytest
import virtual_day as vd
import virtual_effects_more as more
from marks import keep
from twins import hexapod, joints_near_home

from parallel_cal.causes.effects import collect_recorded_values
from parallel_cal.effects.encoder_crosstalk import SIZE
from parallel_cal.identification.fit import fit
from parallel_cal.identification.fit_warnings import chi2_band
from parallel_cal.identification.methods.implicit import estimate
from parallel_cal.identification.observations import observe
from parallel_cal.model.drive import Drive
from parallel_cal.model.effect import Seen
from parallel_cal.model.model import new_model
from parallel_cal.model.parameters import Named
from parallel_cal.model.shelf import load_effect, load_mechanism
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.virtual import joint_effects as ve
from parallel_cal.virtual import robot as vr

HEX = vr.Noise(joint=5e-6, position=10e-6, orientation=15 * vr.ARCSEC)  # m on its legs


# --------------------------------------------------------------------------- by pencil and paper


def sees(name, mechanism, numbers, conditions, q=None, r=(0.1, -0.2, 0.3), R=None):
    """(q, r, R) that the ideal mechanism sees."""
    m = load_mechanism(mechanism)
    effect = load_effect(name)
    table = effect.table(m)
    values = table.vector({f"{name}.{key}": value for key, value in numbers.items()})
    e = Named(table.names, ca.SX(ca.DM(values)))[name]
    at = Named(tuple(conditions), ca.SX(ca.DM(list(conditions.values()))))
    q = m.home.joints if q is None else q
    seen = Seen(ca.SX(ca.DM(q)), ca.SX(ca.DM(r)), ca.SX(ca.DM(np.eye(3) if R is None else R)), None)
    seen = effect.ideal(seen, e, at, m)
    return tuple(np.array(ca.DM(part)).squeeze() for part in (seen.q, seen.r, seen.R))


THIRD = np.pi / 3
QUARTER = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])  # about z


def test_second_harmonic_of_a_joint_at_30_degrees_is_sine_and_cosine_of_60():
    numbers = {"joint1.sin": 2e-3, "joint1.cos": 1e-3, "joint3.cos": 4e-3}
    q, _, _ = sees("encoder_second_harmonic", "delta24", numbers, {}, [np.pi / 6, 0.5, THIRD])
    expected = [np.pi / 6 + 2e-3 * 0.8660254037844386 + 0.5e-3, 0.5, THIRD - 2e-3]
    np.testing.assert_allclose(q, expected, atol=1e-15)


def test_a_gain_of_a_thousandth_lengthens_a_stroke_of_80_mm_by_80_um_and_leaves_zero():
    q, _, _ = sees(
        "encoder_gain",
        "stewart42",
        {"leg1.gain": 1e-3, "leg2.gain": -1e-3, "leg3.gain": 5e-4},
        {},
        [0.08, 0.08, 0.0, 0.08, 0.08, 0.08],
    )
    np.testing.assert_allclose(q, [0.08008, 0.07992, 0.0, 0.08, 0.08, 0.08], atol=1e-16)


def test_a_gear_of_ratio_6_ripples_six_times_and_twelve_times_a_turn():
    numbers = {"ratio": 6.0, "joint1.sin1": 1e-3, "joint1.cos2": 2e-3}
    numbers |= {"joint2.cos1": 3e-3, "joint2.sin2": 1e-3}
    q, _, _ = sees("gear_transmission_error", "delta24", numbers, {}, [np.pi / 12, THIRD, 0.7])
    # 6 * 15 degrees = 90, its double 180; 6 * 60 = a whole turn
    np.testing.assert_allclose(q, [np.pi / 12 + 1e-3 - 2e-3, THIRD + 3e-3, 0.7], atol=1e-15)


def test_after_a_reversal_the_lag_grows_as_a_tanh_and_towards_where_the_joint_came_from():
    numbers = {"joint1.lag": 3e-4, "joint1.width": 0.01, "joint2.lag": 2e-4, "joint2.width": 0.01}
    travel = {"travel.joint1": 0.01 * np.log(2), "travel.joint2": -0.5, "travel.joint3": 1.0}
    q, _, _ = sees("hysteresis", "delta24", numbers, travel, [0.5, 0.5, 0.5])
    # tanh(ln 2) = (2 - 1/2) / (2 + 1/2) = 0.6
    np.testing.assert_allclose(q, [0.5 - 1.8e-4, 0.5 + 2e-4, 0.5], atol=1e-15)


def test_a_pose_stamped_2_ms_late_belongs_to_joints_2_ms_back():
    velocity = {"velocity.joint1": 0.5, "velocity.joint2": -0.25, "velocity.joint3": 0.0}
    q, _, _ = sees("latency", "delta24", {"delay": 2e-3}, velocity, [0.5, 0.5, 0.5])
    np.testing.assert_allclose(q, [0.499, 0.5005, 0.5], atol=1e-15)


def test_a_drive_of_200_per_second_is_5_ms_behind_its_command():
    velocity = {"velocity.joint1": 0.5, "velocity.joint2": -0.25, "velocity.joint3": 0.0}
    lags = {"joint1.lag": 1 / 200, "joint2.lag": 1 / 125, "joint3.lag": 1.0}
    q, _, _ = sees("servo_lag", "delta24", lags, velocity, [0.5, 0.5, 0.5])
    np.testing.assert_allclose(q, [0.4975, 0.502, 0.5], atol=1e-15)


def test_a_drive_of_100_rad_per_s_is_a_tenth_of_a_milliradian_behind_per_rad_per_s2():
    """1 / 100^2 = 0.1e-3 s^2."""
    rise = {"acceleration.joint1": 5.0, "acceleration.joint2": -2.0, "acceleration.joint3": 0.0}
    lags = {"joint1.lag": 1e-4, "joint2.lag": 2e-4, "joint3.lag": 1.0}
    q, _, _ = sees("acceleration_lag", "delta24", lags, rise, [0.5, 0.5, 0.5])
    np.testing.assert_allclose(q, [0.5 - 5e-4, 0.5 + 4e-4, 0.5], atol=1e-15)


def test_a_strain_wave_gear_ripples_twice_per_turn_relative_to_each_spline():
    numbers = {"ratio": 6.0, "joint1.cos_c": 1e-3, "joint1.sin_f": 2e-3, "joint2.sin_c": 4e-3}
    q, _, _ = sees("strain_wave_ripple", "delta24", numbers, {}, [np.pi / 12, np.pi / 24, 0.7])
    # 12 and 14 times 15 degrees: -cos 0 and -sin 30; 12 times 7.5 degrees: sin 90
    np.testing.assert_allclose(q, [np.pi / 12 - 2e-3, np.pi / 24 + 4e-3, 0.7], atol=1e-15)


def test_a_scale_whose_signals_have_an_offset_and_unequal_sizes_errs_once_and_twice_per_period():
    """The interpolator reads atan2((1 + g) sin + a, cos + b): to first order it is ahead by
    a cos - b sin + g/2 sin 2."""
    a, b, g, period = 2e-3, -1e-3, 3e-3, 2e-3
    true = 0.1 + np.linspace(0, period, 6, endpoint=False)
    angle = 2 * np.pi * true / period
    shown = np.arctan2((1 + g) * np.sin(angle) + a, np.cos(angle) + b)
    reading = true + ((shown - angle + np.pi) % (2 * np.pi) - np.pi) * period / (2 * np.pi)
    size = period / (2 * np.pi)
    numbers = {"period": period}
    for leg in HEXAPOD.joints:
        numbers |= {f"{leg}.cos1": -a * size, f"{leg}.sin1": b * size, f"{leg}.sin2": -g / 2 * size}
    q, _, _ = sees("encoder_interpolation", "stewart42", numbers, {}, reading)
    assert np.abs(reading - true).max() > 0.8e-6
    np.testing.assert_allclose(q, true, atol=20e-9 / 2)


@pytest.mark.parametrize(
    ("turned", "largest"), [(0, 2.0), (np.pi / 4, np.sqrt(2)), (np.pi / 2, 0.0), (np.pi, 2.0)]
)
def test_two_equal_waves_beat_twice_per_turn_of_the_joint(turned, largest):
    """cos 100 q + cos 102 q = 2 cos q cos 101 q."""
    numbers = {"ratio": 50.0, "joint1.cos_c": 1e-3, "joint1.cos_f": 1e-3}
    near = turned + np.linspace(-1, 1, 81) * np.pi / 101
    errors = [
        sees("strain_wave_ripple", "delta24", numbers, {}, [q, 0.0, 0.0])[0][0] - q for q in near
    ]
    assert max(errors) == pytest.approx(1e-3 * largest, abs=0.04e-3)


@pytest.mark.parametrize(
    ("session", "shift"), [(0, 0), (1, 1e-3), (2, 3e-3), (3, -1e-3), (4, -1e-3)]
)
def test_every_session_keeps_the_shifts_of_those_before_it(session, shift):
    numbers = {"joint1.since1": 1e-3, "joint1.since2": 2e-3, "joint1.since3": -4e-3}
    q, _, _ = sees("zero_shift", "delta24", numbers, {"session": session}, [0.5, 0.5, 0.5])
    np.testing.assert_allclose(q, [0.5 + shift, 0.5, 0.5], atol=1e-15)


def test_a_base_that_slid_and_turned_is_put_back_to_where_it_was():
    numbers = {"v_x": 1e-7, "v_y": 2e-7, "v_z": -1e-7, "w_z": 1e-6}
    _, r, R = sees("base_drift", "stewart42", numbers, {"time": 1000.0})
    # 0.1, 0.2, -0.1 mm too far; then turned back by 1 mrad about z
    slid = np.array([0.1 - 1e-4, -0.2 - 2e-4, 0.3 + 1e-4])
    expected = [slid[0] + 1e-3 * slid[1], slid[1] - 1e-3 * slid[0], slid[2]]
    np.testing.assert_allclose(r, expected, atol=2e-7)  # 1 - cos(1 mrad) is 5e-7 of 0.2 m
    np.testing.assert_allclose(R, [[1, 1e-3, 0], [-1e-3, 1, 0], [0, 0, 1]], atol=6e-7)


@pytest.mark.parametrize(
    ("number", "expected"),
    [
        ("scale_x", [0.1001, -0.2, 0.3]),
        ("scale_y", [0.1, -0.2002, 0.3]),
        ("square_xy", [0.0998, -0.2, 0.3]),
        ("square_xz", [0.1003, -0.2, 0.3]),
        ("square_yz", [0.1, -0.1997, 0.3]),
    ],
)
def test_a_reading_along_a_leaning_axis_leads_aside(number, expected):
    _, r, R = sees("device_axes", "delta54", {number: 1e-3}, {})
    np.testing.assert_allclose(r, expected, atol=1e-15)
    np.testing.assert_array_equal(R, np.eye(3))


def test_a_target_off_the_origin_turns_with_the_platform():
    _, r, R = sees(
        "target_offset", "stewart42", {"o_x": 1e-3, "o_y": 2e-3, "o_z": 4e-3}, {}, R=QUARTER
    )
    np.testing.assert_allclose(r, [0.1 + 2e-3, -0.2 - 1e-3, 0.3 - 4e-3], atol=1e-15)
    np.testing.assert_array_equal(R, QUARTER)


def test_an_eccentric_encoder_and_play_in_a_sliding_joint_by_hand():
    q, _, _ = sees(
        "encoder_eccentricity",
        "scara16",
        {"joint1.sin": 2e-3, "joint2.cos": 1e-3},
        {},
        [np.pi / 6, THIRD, 0.05],
    )
    np.testing.assert_allclose(q, [np.pi / 6 + 1e-3, THIRD + 0.5e-3, 0.05], atol=1e-15)
    came = {f"direction.joint{i}": 1.0 for i in (1, 2, 3)}
    q, _, _ = sees("backlash", "scara16", {"joint3.width": 40e-6}, came, [0.1, 0.1, 0.05])
    np.testing.assert_allclose(q, [0.1, 0.1, 0.05 - 20e-6], atol=1e-15)


def test_a_ring_on_three_screws_at_20_degrees_misreads_as_at_60():
    numbers = {"order": 3.0, "joint1.sin": 2e-4, "joint2.cos": 1e-4}
    q, _, _ = sees("encoder_harmonic", "delta24", numbers, {}, [np.pi / 9, np.pi / 9, 0.5])
    expected = [np.pi / 9 + 2e-4 * 0.8660254037844386, np.pi / 9 + 0.5e-4, 0.5]
    np.testing.assert_allclose(q, expected, atol=1e-15)


def test_a_joint_is_dragged_by_what_each_of_its_neighbours_reads():
    numbers = {"joint1.by_joint2": 1e-3, "joint1.by_joint3": -2e-3, "joint3.by_joint2": 5e-4}
    q, _, _ = sees("encoder_crosstalk", "delta24", numbers, {}, [0.4, 0.2, 0.1])
    # 0.2 and 0.2 mrad cancel; joint 2 stays as it is read
    np.testing.assert_allclose(q, [0.4, 0.2, 0.1 + 1e-4], atol=1e-16)


def test_of_six_legs_in_a_ring_each_is_dragged_by_two_and_of_two_joints_by_the_other():
    def dragged(mechanism):
        effect = load_effect("encoder_crosstalk")
        return [p.name for p in effect.parameters(load_mechanism(mechanism))]

    assert len(dragged("stewart42")) == 12
    assert dragged("stewart42")[:2] == ["leg1.by_leg6", "leg1.by_leg2"]
    assert load_effect("encoder_crosstalk").applies(load_mechanism("slider_crank")) != ""


def test_neighbours_are_dragged_by_no_more_than_a_belts_length_is_off():
    """16 thousandths of an inch on ten inches; by a wheel of 0.1 m where angle becomes travel."""
    crosstalk = load_effect("encoder_crosstalk")
    limits = {p.name: p.high for p in crosstalk.parameters(load_mechanism("delta24"))}
    np.testing.assert_allclose(list(limits.values()), 1.6e-3)
    by_unit = {units: by for units, (_, by) in SIZE.items()}
    assert by_unit["rad", "m"] == pytest.approx(10)
    assert by_unit["m", "rad"] == pytest.approx(0.1)


def test_a_screw_of_4_mm_lead_is_back_after_4_mm_and_its_pitch_grows():
    numbers = {"lead": 4e-3, "leg1.sin": 8e-6, "leg2.cos": 5e-6, "leg3.bend": 1e-3}
    stroke = [0.041, 0.042, 0.1, 0.04, 0.04, 0.04]  # 10 leads and a quarter, and a half
    q, _, _ = sees("screw_pitch_error", "stewart42", numbers, {}, stroke)
    expected = [0.041 + 8e-6, 0.042 - 5e-6, 0.1 + 1e-5, 0.04, 0.04, 0.04]
    np.testing.assert_allclose(q, expected, atol=1e-15)


@pytest.mark.parametrize(("time", "after"), [(99.0, 0), (100.0, 1), (5000.0, 1)])
def test_a_knock_is_undone_from_its_moment_on(time, after):
    numbers = {"time": 100.0, "v_x": 1e-4, "v_z": -2e-4, "w_z": 1e-3}
    _, r, R = sees("device_bump", "stewart42", numbers, {"time": time})
    slid = np.array([0.1 - 1e-4, -0.2, 0.3 + 2e-4])
    there = [slid[0] + 1e-3 * slid[1], slid[1] - 1e-3 * slid[0], slid[2]]
    np.testing.assert_allclose(r, there if after else [0.1, -0.2, 0.3], atol=2e-7)
    np.testing.assert_allclose(R[0, 1], 1e-3 * after, atol=1e-9)


@pytest.mark.parametrize(
    ("number", "expected"),
    [
        # Home of the Delta is 0.3 m high: r is 0.1, -0.2 and 0 m from there.
        ("x_xx", [0.1 + 1e-5, -0.2, 0.3]),
        ("z_xy", [0.1, -0.2, 0.3 - 2e-5]),
        ("y_yy", [0.1, -0.2 + 4e-5, 0.3]),
        ("x_zz", [0.1, -0.2, 0.3]),
    ],
)
def test_a_bent_axis_deviates_by_the_square_of_the_distance_from_home(number, expected):
    home = load_mechanism("stewart42").home.position
    _, r, R = sees("device_field", "stewart42", {number: 1e-3}, {}, r=np.add(home, [0.1, -0.2, 0]))
    np.testing.assert_allclose(r - home, np.array(expected) - [0, 0, 0.3], atol=1e-15)
    np.testing.assert_array_equal(R, np.eye(3))


def test_a_base_sinks_on_the_side_that_the_weight_hangs_on():
    _, r, R = sees("base_compliance", "stewart42", {"lean_y": 1e-3}, {}, r=(0.1, 0.0, 0.3))
    # 0.1 m aside: 0.1 mrad about y, which lowers +x; undone, it is higher by 10 um
    np.testing.assert_allclose(r, [0.1 - 3e-5, 0.0, 0.3 + 1e-5], atol=2e-8)
    np.testing.assert_allclose(R @ [1, 0, 0], [1, 0, 1e-4], atol=4e-8)
    _, r, _ = sees("base_compliance", "stewart42", {"lean_x": 1e-3}, {}, r=(0.0, 0.1, 0.3))
    np.testing.assert_allclose(r, [0.0, 0.1 - 3e-5, 0.3 + 1e-5], atol=2e-8)


def test_a_base_may_lean_away_from_the_weight():
    """The device's stand may lean further than the base: the tilt between them has either sign."""
    _, r, _ = sees("base_compliance", "stewart42", {"lean_y": -1e-3}, {}, r=(0.1, 0.0, 0.3))
    np.testing.assert_allclose(r, [0.1 + 3e-5, 0.0, 0.3 - 1e-5], atol=2e-8)
    for parameter in load_effect("base_compliance").parameters(load_mechanism("stewart42")):
        assert parameter.low == -parameter.high


# --------------------------------------------------------------------------- where they apply


def test_effects_that_repeat_every_turn_apply_to_revolute_joints_only():
    scara, hexapod = load_mechanism("scara16"), load_mechanism("stewart42")
    once_a_turn = ("encoder_eccentricity", "encoder_second_harmonic", "encoder_harmonic")
    for name in (*once_a_turn, "gear_transmission_error", "strain_wave_ripple"):
        effect = load_effect(name)
        joints = {p.name.split(".")[0] for p in effect.parameters(scara)} - {"ratio", "order"}
        assert joints == {"joint1", "joint2"}
        assert effect.applies(scara) == ""
        assert effect.applies(hexapod) == "it has no revolute joint"


@pytest.mark.parametrize(
    ("effect", "mechanism", "names"),
    [
        ("device_axes", "delta24", "scale_x scale_y square_xy square_xz square_yz"),
        ("device_axes", "planar_stewart", "scale_x square_xy"),
        ("target_offset", "planar_stewart", "o_x o_y"),
        ("target_offset", "stewart42", "o_x o_y o_z"),
        ("base_drift", "planar_stewart", "v_x v_y w_z"),
        ("base_drift", "argos9", "w_x w_y w_z"),
        ("base_drift", "slider_crank", "v_x"),
        ("base_drift", "cable", "v_x v_y v_z w_x w_y w_z"),
        ("device_bump", "planar_stewart", "time v_x v_y w_z"),
        ("device_field", "planar_stewart", "x_xx x_xy x_yy y_xx y_xy y_yy"),
        ("base_compliance", "delta24", "lean_x lean_y"),
    ],
)
def test_device_and_base_have_the_numbers_that_the_platform_can_feel(effect, mechanism, names):
    found = [p.name for p in load_effect(effect).parameters(load_mechanism(mechanism))]
    assert found == names.split()


@pytest.mark.parametrize(
    ("effect", "mechanism", "reason"),
    [
        ("device_axes", "argos9", "fewer than two axes"),
        ("device_axes", "slider_crank", "fewer than two axes"),
        ("device_field", "slider_crank", "fewer than two axes"),
        ("base_compliance", "planar_stewart", "does not move across gravity"),
        ("base_compliance", "argos9", "does not move across gravity"),
        ("screw_pitch_error", "delta54", "it has no prismatic joint"),
        ("encoder_interpolation", "delta54", "gear_transmission_error describes revolute ones"),
        ("target_offset", "delta24", "does not rotate"),
        ("target_offset", "argos9", "only rotates"),
    ],
)
def test_device_effects_say_where_they_make_no_sense(effect, mechanism, reason):
    assert reason in load_effect(effect).applies(load_mechanism(mechanism))


def test_a_line_on_a_spool_has_no_scale():
    """A scan of its whole length for the pitch of one took most of a diagnosis, and found it."""
    hexapod = load_mechanism("stewart42")
    scale = load_effect("encoder_interpolation")
    assert scale.applies(hexapod) == ""
    hexapod.drives = (Drive("spool", radius=0.04),) * 6
    assert "its joints are lines on spools" in scale.applies(hexapod)
    hexapod.drives = (Drive("belt", per_rev=0.04), *hexapod.drives[1:])
    names = [p.name for p in scale.parameters(hexapod)]
    assert names[1:] == [f"leg1.{part}" for part in ("sin1", "cos1", "sin2", "cos2")]


def test_warmth_lengthens_lines_on_spools_as_it_does_scales():
    """What has no scale to interpolate grows all the same: 12e-6 / K times 10 K of 0.2 m."""
    hexapod = load_mechanism("stewart42")
    hexapod.drives = (Drive("spool", radius=0.04),) * 6
    effect = load_effect("thermal_expansion")
    names = [p.name for p in effect.parameters(hexapod)]
    sizes = {"scales.alpha": 12e-6, "reference": 20.0}
    e = Named(names, ca.DM([sizes.get(name, 0.0) for name in names]))
    p = Named(hexapod.parameters.names, ca.DM(hexapod.parameters.nominal))
    seen = Seen(ca.DM([0.2] * 6), ca.DM.zeros(3), ca.DM.eye(3), p)
    grown = effect.ideal(seen, e, Named(["temperature"], ca.DM([30.0])), hexapod)
    np.testing.assert_allclose(np.array(grown.q).ravel() - 0.2, 0.2 * 12e-5, rtol=1e-9)


# --------------------------------------------------------------------------- found again


@dataclass(frozen=True)
class Robot:
    """A virtual robot with non-nominal geometry, and the model that a person starts from."""

    mechanism: str
    twin: Any
    joints: tuple[str, ...]
    noise: vr.Noise
    reach: float

    def poses(self, n, seed):
        return joints_near_home(self.mechanism, self.twin, n, seed)


DELTA = Robot("delta54", vr.MOCK_UP, ("joint1", "joint2", "joint3"), vr.THESIS_NOISE, 0.5)
HEXAPOD = Robot("stewart42", hexapod(), tuple(f"leg{i}" for i in range(1, 7)), HEX, 0.05)


def measured(robot, hidden, n=100, seed=1, errorless=False):
    """A dataset of the robot with its hidden physics; `errorless` instruments claim 1e-6 of it."""
    reading, nq = robot.poses(n, seed), len(robot.joints)
    at = more.Motion.of(vd.visits(n, nq, seed, robot.reach), 10 * robot.reach, seed)
    _, r, R = vr.truth(robot.twin, hidden, reading, at)
    q_error, r_error, w_error = vd.errors(robot.noise, n, nq, seed)
    factor, size = (0.0, 1e-6) if errorless else (1.0, 1.0)
    sigma = np.repeat([robot.noise.position * size, robot.noise.orientation * size], 3)
    conditions = {"time": at.time, "session": at.session}
    for k, joint in enumerate(robot.joints):
        for name in ("direction", "travel", "velocity", "acceleration"):
            conditions[f"{name}.{joint}"] = getattr(at, name)[:, k]
    return Dataset.from_arrays(
        robot.joints,
        reading + factor * q_error,
        r + factor * r_error,
        vr.turn(factor * w_error) @ R,
        pose_cov=np.diag(sigma**2),
        joint_sigma=robot.noise.joint * size,
        conditions=conditions,
        pose_id=np.arange(n),
    )


@dataclass(frozen=True)
class Case:
    """What is hidden, and the numbers that say so in the package's terms."""

    robot: Robot
    effect: str
    hidden: Any
    numbers: dict[str, float]
    settings: Any = None
    fix: tuple[str, ...] = ()

    def __str__(self):
        return f"{self.effect} of {self.robot.mechanism}"


def a_joint(robot, part, values):
    return {f"{j}.{part}": v for j, v in zip(robot.joints, values, strict=True)}


OVAL, AT = (2e-3, -1e-3, 1.5e-3), (0.3, -0.5, 1.0)
RIPPLE, PHASE = (4e-4, 3e-4, -5e-4), (0.4, 1.1, -0.8)
BEAT, FAST, SLOW = (8e-4, 6e-4, 7e-4), (0.3, -1.2, 2.0), (0.9, 0.2, -0.7)
SIX = (60e-6, -40e-6, 50e-6, 30e-6, -70e-6, 20e-6)
PITCH = tuple(2 * v for v in SIX)
SLIDE, SPIN = (5e-8, -8e-8, 4e-8), (1e-7, -2e-7, 1.5e-7)
CROOKED = more.CrookedAxes((1 + 2e-4, 0, 0), (1e-4, 1 - 1.5e-4, 0), (-2e-4, 1.2e-4, 1))
AXES = {
    **{"scale_x": 2e-4, "scale_y": -1.5e-4},
    **{"square_xy": 1e-4, "square_xz": -2e-4, "square_yz": 1.2e-4},
}
LOBES = (3e-4, -2e-4, 4e-4)
BESIDE = np.roll(np.eye(6), 1, axis=0) + np.roll(np.eye(6), -1, axis=0)
DRAG = BESIDE * np.random.default_rng(6).uniform(-1e-3, 1e-3, (6, 6))
WOBBLE, ANGLE = (12e-6, -8e-6, 10e-6, 15e-6, -9e-6, 11e-6), (0.3, 1.2, -0.7, 2.0, -1.5, 0.9)
GROWING = (3e-3, -2e-3, 4e-3, 1e-3, -3e-3, 2e-3)
PUSH, TWIST = (80e-6, -50e-6, 60e-6), (2e-4, -3e-4, 1e-4)
BEND = np.random.default_rng(5).uniform(-1.2e-3, 1.2e-3, (3, 3, 3))
BENT = more.BentSpace(tuple(BEND + BEND.transpose(0, 2, 1)), (0.0, 0.0, 0.3))
FIELD = {
    f"{i}_{j}{k}": BENT.bend[a][b][c] * (1 if b == c else 2)
    for a, i in enumerate("xyz")
    for b, j in enumerate("xyz")
    for c, k in enumerate("xyz")
    if b <= c
}
KNOCKED = {
    **{f"v_{a}": v for a, v in zip("xyz", PUSH, strict=True)},
    **{f"w_{a}": v for a, v in zip("xyz", TWIST, strict=True)},
}
DRIFT = {
    **{f"v_{a}": v for a, v in zip("xyz", SLIDE, strict=True)},
    **{f"w_{a}": v for a, v in zip("xyz", SPIN, strict=True)},
}
CASES = [
    Case(
        DELTA,
        "encoder_second_harmonic",
        ve.OvalDisc(OVAL, AT),
        a_joint(DELTA, "sin", np.array(OVAL) * np.sin(2 * np.array(AT)))
        | a_joint(DELTA, "cos", np.array(OVAL) * np.cos(2 * np.array(AT))),
    ),
    Case(
        DELTA,
        "encoder_gain",
        ve.WrongPitch((2e-3, -3e-3, 1e-3)),
        a_joint(DELTA, "gain", (2e-3, -3e-3, 1e-3)),
    ),
    Case(HEXAPOD, "encoder_gain", ve.WrongPitch(PITCH), a_joint(HEXAPOD, "gain", PITCH)),
    Case(
        DELTA,
        "gear_transmission_error",
        ve.GearRipple(50.0, RIPPLE, PHASE),
        a_joint(DELTA, "sin1", np.array(RIPPLE) * np.cos(PHASE))
        | a_joint(DELTA, "cos1", np.array(RIPPLE) * np.sin(PHASE))
        | a_joint(DELTA, "sin2", np.array(RIPPLE) / 3 * np.cos(2 * np.array(PHASE)))
        | a_joint(DELTA, "cos2", np.array(RIPPLE) / 3 * np.sin(2 * np.array(PHASE))),
        {"ratio": 50.0},
    ),
    Case(
        DELTA,
        "hysteresis",
        ve.WindUp((5e-4, 3e-4, 4e-4), 0.02),
        a_joint(DELTA, "lag", (5e-4, 3e-4, 4e-4)),
    ),
    Case(
        HEXAPOD,
        "hysteresis",
        ve.WindUp((20e-6,) * 6, 5e-4),
        a_joint(HEXAPOD, "lag", (20e-6,) * 6),
        a_joint(HEXAPOD, "width", (5e-4,) * 6),
    ),
    Case(DELTA, "latency", more.LateStamp(3e-3), {"delay": 3e-3}),
    Case(HEXAPOD, "latency", more.LateStamp(-2e-3), {"delay": -2e-3}),
    Case(
        DELTA,
        "servo_lag",
        more.LateDrives((200.0, 500.0, 125.0)),
        a_joint(DELTA, "lag", (5e-3, 2e-3, 8e-3)),
    ),
    Case(
        HEXAPOD,
        "servo_lag",
        more.LateDrives((200.0, 500.0, 125.0, 250.0, 1000.0, 100.0)),
        a_joint(HEXAPOD, "lag", (5e-3, 2e-3, 8e-3, 4e-3, 1e-3, 10e-3)),
    ),
    Case(
        DELTA,
        "acceleration_lag",
        more.BentByInertia((40.0, 60.0, 50.0)),
        a_joint(DELTA, "lag", (1 / 1600, 1 / 3600, 1 / 2500)),
    ),
    Case(
        HEXAPOD,
        "acceleration_lag",
        more.BentByInertia((30.0, 40.0, 50.0, 60.0, 45.0, 35.0)),
        a_joint(HEXAPOD, "lag", 1 / np.array([30.0, 40.0, 50.0, 60.0, 45.0, 35.0]) ** 2),
    ),
    Case(
        DELTA,
        "strain_wave_ripple",
        more.BeatingGears(50.0, BEAT, FAST, SLOW),
        a_joint(DELTA, "sin_c", np.array(BEAT) / 2 * np.sin(np.subtract(FAST, SLOW)))
        | a_joint(DELTA, "cos_c", np.array(BEAT) / 2 * np.cos(np.subtract(FAST, SLOW)))
        | a_joint(DELTA, "sin_f", np.array(BEAT) / 2 * np.sin(np.add(FAST, SLOW)))
        | a_joint(DELTA, "cos_f", np.array(BEAT) / 2 * np.cos(np.add(FAST, SLOW))),
        {"ratio": 50.0},
    ),
    Case(
        DELTA,
        "zero_shift",
        more.HomedAnew((1e-3, -5e-4, 7e-4)),
        a_joint(DELTA, "since1", (1e-3, -5e-4, 7e-4)),
    ),
    Case(HEXAPOD, "zero_shift", more.HomedAnew(SIX), a_joint(HEXAPOD, "since1", SIX)),
    Case(DELTA, "base_drift", ve.CreepingStand(SLIDE, SPIN), DRIFT),
    Case(HEXAPOD, "base_drift", ve.CreepingStand(SLIDE, SPIN), DRIFT),
    Case(
        DELTA,
        "encoder_harmonic",
        more.LobedRing(5, LOBES, AT),
        a_joint(DELTA, "sin", np.array(LOBES) * np.sin(5 * np.array(AT)))
        | a_joint(DELTA, "cos", np.array(LOBES) * np.cos(5 * np.array(AT))),
        {"order": 5.0},
    ),
    Case(
        HEXAPOD,
        "encoder_crosstalk",
        ve.DraggedNeighbours(tuple(map(tuple, DRAG))),
        {
            f"leg{i + 1}.by_leg{j + 1}": float(DRAG[i, j])
            for i, j in zip(*np.nonzero(DRAG), strict=True)
        },
    ),
    Case(
        HEXAPOD,
        "screw_pitch_error",
        ve.UnevenScrew(5e-3, WOBBLE, ANGLE, GROWING),
        a_joint(HEXAPOD, "sin", np.array(WOBBLE) * np.cos(ANGLE))
        | a_joint(HEXAPOD, "cos", np.array(WOBBLE) * np.sin(ANGLE))
        | a_joint(HEXAPOD, "bend", GROWING),
        {"lead": 5e-3},
    ),
    Case(
        HEXAPOD,
        "encoder_interpolation",
        more.UnevenPitch(5e-3, WOBBLE, ANGLE),
        a_joint(HEXAPOD, "sin1", np.array(WOBBLE) * np.sin(ANGLE))
        | a_joint(HEXAPOD, "cos1", np.array(WOBBLE) * np.cos(ANGLE))
        | a_joint(HEXAPOD, "sin2", np.array(WOBBLE) / 2 * np.sin(2 * np.array(ANGLE)))
        | a_joint(HEXAPOD, "cos2", np.array(WOBBLE) / 2 * np.cos(2 * np.array(ANGLE))),
        {"period": 5e-3},
    ),
    *[
        Case(
            robot,
            "device_bump",
            more.Knock(1500.0, PUSH, TWIST),
            KNOCKED,
            {"time": 1500.0},
        )
        for robot in (DELTA, HEXAPOD)
    ],
    Case(HEXAPOD, "device_field", BENT, FIELD),
    *[
        Case(
            robot,
            "base_compliance",
            more.LeaningBase((1e-3, lean_y)),
            {"lean_x": 1e-3, "lean_y": lean_y},
        )
        for robot, lean_y in ((DELTA, 1.5e-3), (HEXAPOD, -1.5e-3))
    ],
    Case(HEXAPOD, "device_axes", CROOKED, AXES),
    Case(
        HEXAPOD,
        "target_offset",
        more.MisplacedTarget((1e-3, -2e-3, 1.5e-3)),
        {"o_x": 1e-3, "o_y": -2e-3, "o_z": 1.5e-3},
        fix=("*.B_?",),
    ),
    Case(
        HEXAPOD,
        "backlash",
        vr.Backlash((30e-6, 10e-6, 20e-6, 40e-6, 15e-6, 25e-6)),
        a_joint(HEXAPOD, "width", (30e-6, 10e-6, 20e-6, 40e-6, 15e-6, 25e-6)),
    ),
]
# A Delta's arms and rods take the place of leaning axes: noise hides them, yet they are no nullity.
SWALLOWED = Case(DELTA, "device_axes", CROOKED, AXES)


def model_of(case):
    """The nominal model; what stays fixed in the geometry is as the robot really is."""
    model = new_model(case.robot.mechanism)
    if case.fix:
        fixed = model.table.matching(case.fix)
        true = model.table.vector(case.robot.twin.parameters)
        model = model.with_values(np.where(fixed, true, model.values))
    return model


QUICK = ("backlash", "base_drift", "encoder_gain", "hysteresis", "zero_shift")  # of each kind


def mark_case(case):
    """The Delta shows sizes and sigmas; all that the hexapod has is found exactly below."""
    if case.robot is DELTA and case.effect in QUICK:
        return case
    marks = pytest.mark.wide if case.robot is DELTA else pytest.mark.slow
    return pytest.param(case, marks=marks)


def identified(case, data, **options):
    model = model_of(case).with_effect(case.effect, case.settings)
    return fit(model, data, fix=case.fix, **options)


@pytest.mark.parametrize("case", [mark_case(case) for case in CASES], ids=str)
def test_a_hidden_effect_is_found_with_its_size_and_the_held_out_error_falls(case):
    data = measured(case.robot, [case.hidden])
    found, without = identified(case, data), fit(model_of(case), data, fix=case.fix)
    sigma = dict(zip(found.model.table.names, found.estimate.sigma, strict=True))
    for name, planted in case.numbers.items():
        full = f"{case.effect}.{name}"
        assert abs(found.model.value(full) - planted) < 4 * sigma[full], full
    low, high = chi2_band(found.estimate.dof)
    assert low < found.estimate.chi2_per_dof < high
    assert not found.estimate.spectrum.unidentifiable
    before, after = (one.held_out.summary.position_rms for one in (without, found))
    assert after < 1.25 * found.noise_floor.position_rms
    assert before > after


# The Delta's effects are found above, with noise.
OF_HEXAPODS = [case for case in CASES if case.robot is HEXAPOD]


@pytest.mark.wide
@pytest.mark.parametrize("case", keep([*CASES, SWALLOWED], *OF_HEXAPODS, SWALLOWED), ids=str)
def test_without_noise_it_is_found_exactly(case):
    found = identified(case, measured(case.robot, [case.hidden], errorless=True), hold_out=0)
    for name, planted in case.numbers.items():
        assert found.model.value(f"{case.effect}.{name}") == pytest.approx(planted, abs=1e-9), name


@pytest.mark.wide
def test_a_gear_of_unknown_ratio_is_found_by_scanning_and_then_refined():
    name, true = "gear_transmission_error", 47.3
    data = measured(DELTA, [ve.GearRipple(true, RIPPLE, PHASE)], n=150)
    start = fit(new_model("delta54"), data, hold_out=0).model
    observations = observe(start, data)
    scan = list(load_effect(name).scan(start.mechanism, collect_recorded_values(data)))
    tried = [start.with_effect(name, setting) for setting in scan]
    amplitudes = tried[0].table.matching([f"{name}.joint*"])
    best = min(tried, key=lambda model: estimate(model, observations, amplitudes).chi2)
    step = scan[1]["ratio"] - scan[0]["ratio"]
    assert abs(best.value(f"{name}.ratio") - true) < step
    found = fit(best, data, free=[f"{name}.ratio"])
    sigma = found.estimate.sigma[found.model.table.index_of(f"{name}.ratio")]
    assert sigma < 0.1
    assert abs(found.model.value(f"{name}.ratio") - true) < 4 * sigma
    low, high = chi2_band(found.estimate.dof)
    assert low < found.estimate.chi2_per_dof < high


def test_a_third_session_needs_its_own_shift_freed():
    """Sessions that were not recorded cost nothing; one that was may be freed."""
    data = measured(DELTA, [more.HomedAnew((1e-3, -5e-4, 7e-4))])
    session = np.repeat([0.0, 1.0, 2.0], [50, 25, 25])  # 2 goes on from 1 without a shift
    thrice = replace(data, conditions={**data.conditions, "session": session})
    model = new_model("delta54").with_effect("zero_shift")
    found = fit(model, thrice, free=["*.since2"], hold_out=0)
    sigma = dict(zip(found.model.table.names, found.estimate.sigma, strict=True))
    for joint, shift in zip(DELTA.joints, (1e-3, -5e-4, 7e-4), strict=True):
        for part, planted in (("since1", shift), ("since2", 0.0)):
            full = f"zero_shift.{joint}.{part}"
            assert abs(found.model.value(full) - planted) < 4 * sigma[full]
    assert not found.estimate.spectrum.unidentifiable


def test_a_ratio_between_two_of_a_scan_keeps_nine_tenths_of_its_ripple():
    """A sine of the unknown frequency, fitted by sines of the frequency that was tried."""
    m = load_mechanism("delta54")
    q = np.linspace(*m.joint_limits[0], 2000)
    scan = load_effect("gear_transmission_error").scan(m, dict.fromkeys(m.joints, q))
    one, other = [setting["ratio"] for setting in scan][30:32]
    ripple = np.sin((one + other) / 2 * q)
    columns = np.column_stack([np.sin(one * q), np.cos(one * q)])
    shown = columns @ np.linalg.lstsq(columns, ripple, rcond=None)[0]
    assert np.linalg.norm(shown) > 0.89 * np.linalg.norm(ripple)


def test_a_drum_of_40_mm_whose_axis_is_2_mm_off_is_wrong_once_per_251_mm_of_line():
    """A hexapod on drums, one of them behind two sheaves, one on a belt and one on a screw. A
    quarter turn lets out a quarter of 2 pi 40 mm; behind the sheaves, a leg moves half as far."""
    drives = 3 * [Drive("spool", radius=0.04)] + [Drive("spool", radius=0.04, advantage=2.0)]
    drives += [Drive("belt", per_rev=8e-3, gear=4.0), Drive("screw", per_rev=5e-3)]
    m = load_mechanism("stewart42")
    m.drives = tuple(drives)
    effect = load_effect("screw_pitch_error")
    leads, motors = effect.scan(m, {})
    changed = {name: lead for name, lead in motors.items() if lead != leads[name]}
    assert changed == {"leg5.lead": pytest.approx(8e-3)}
    quarters = np.array([*leads.values()]) / 4
    np.testing.assert_allclose(quarters[:3], np.pi * 0.02)
    np.testing.assert_allclose(quarters[3:], [np.pi * 0.01, 8e-3, 1.25e-3])
    assert effect.period(leads) == 5e-3
    names = [f"leg{k}.bend" for k in range(1, 7)]
    own = [p.name for p in effect.parameters(m)]
    assert [name in own for name in names] == 5 * [False] + [True]
    table = effect.table(m)
    values = table.vector({f"{effect.name}.leg{k}.sin": 2e-3 for k in range(1, 7)})
    e = Named(table.names, ca.SX(ca.DM(values)))[effect.name]
    p = Named(m.parameters.names, ca.SX(ca.DM(m.parameters.nominal)))
    seen = Seen(ca.SX(ca.DM(quarters)), ca.SX.zeros(3), ca.SX.eye(3), p)
    q = np.array(ca.DM(effect.ideal(seen, e, Named([], ca.SX(0, 1)), m).q)).ravel()
    np.testing.assert_allclose(q, quarters + 2e-3, atol=1e-15)
    usual = {p.name: p.high for p in effect.parameters(m)}
    assert usual["leg1.cos"] == pytest.approx(0.05 * 0.04)
    assert usual["leg4.cos"] == pytest.approx(0.05 * 0.02)
    assert usual["leg6.cos"] == 0.1e-3


def test_equal_stated_drums_have_one_lead():
    m = load_mechanism("stewart42")
    m.drives = 6 * (Drive("spool", radius=0.04),)
    effect = load_effect("screw_pitch_error")
    assert list(effect.scan(m, {})) == [{"lead": pytest.approx(2 * np.pi * 0.04)}]
    labels = {p.name: p.label for p in effect.parameters(m)}
    assert labels["leg1.sin"] == "sine part, once per turn of the drum"


@pytest.mark.parametrize("pulley", [32e-3, 40e-3])
def test_a_scan_reaches_one_turn_of_the_pulley_of_a_printers_belt(pulley):
    m = load_mechanism("linear_delta")
    recorded = dict.fromkeys(m.joints, np.array([0.0, 0.4]))
    leads = [one["lead"] for one in load_effect("screw_pitch_error").scan(m, recorded)]
    assert np.abs(1 / np.array(leads) - 1 / pulley).min() <= 1 / (4 * 0.4)


def test_a_line_has_a_screw_only_if_the_model_file_states_one():
    lines = load_mechanism("cable", anchors=[[-1, 1], [1, 1], [1, -1], [-1, -1]])
    effect = load_effect("screw_pitch_error")
    assert effect.applies(lines).startswith("its lines wind onto spools, whose size")
    lines.drives = (Drive("screw", per_rev=5e-3),) * 4
    assert effect.applies(lines) == ""
