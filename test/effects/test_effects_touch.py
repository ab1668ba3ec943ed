"""Effects of plates and probes: by hand, and found in what virtual robots touch."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
import virtual_day as vd
import virtual_setups as vs
from test_effects_joint import HEXAPOD

from parallel_cal.identification.fit import fit
from parallel_cal.identification.fit_warnings import chi2_band
from parallel_cal.model.model import new_model
from parallel_cal.model.parameters import Named
from parallel_cal.model.shelf import load_effect, load_mechanism, load_sensor
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.virtual import robot as vr

# --------------------------------------------------------------------------- by pencil and paper


def sees(name, numbers, r=(0.1, -0.2, 0.3), R=None, tip=(0.0, 0.0, 0.0)):
    """The pose (r, R) at which an ideal sensor would show the same."""
    m, effect = load_mechanism("stewart42"), load_effect(name)
    table = effect.table(m)
    e = Named(table.names, ca.DM(table.vector({f"{name}.{k}": v for k, v in numbers.items()})))
    s = Named(("tip.x", "tip.y", "tip.z"), ca.DM(tip))
    pose = effect.at_sensor(ca.DM(r), ca.DM(np.eye(3) if R is None else R), s, e[name])
    return tuple(np.array(ca.DM(part)).squeeze() for part in pose)


@pytest.mark.parametrize(
    ("number", "size", "higher"),
    [
        ("h_xx", 1e-3, 9e-7),
        ("h_xy", 1e-3, -9e-7),
        ("h_yy", 1e-3, 9e-7),
        ("h_xxx", 1e-2, -2.7e-7),
        ("h_xxy", 1e-2, 2.7e-7),
        ("h_xyy", 1e-2, -2.7e-7),
        ("h_yyy", 1e-2, 2.7e-7),
    ],
)
def test_where_a_plate_is_higher_the_tip_is_nearer(number, size, higher):
    # {P} stands at (-0.05, 0.05); the tip, 20 mm aside, over (-0.03, 0.03)
    at, tip = (-0.05, 0.05, 0.3), (0.02, -0.02, 0.0)
    r, R = sees("bed_shape", {number: size}, r=at, tip=tip)
    np.testing.assert_allclose(r, np.subtract(at, [0, 0, higher]), atol=1e-15)
    np.testing.assert_array_equal(R, np.eye(3))


def test_a_tip_aside_rises_and_sinks_as_the_platform_leans():
    lean = vr.axis_rotation("y", np.arcsin(0.6))  # x of the platform goes down by 0.6 a metre
    r, R = sees("probe_offset", {"o_x": 1e-3, "o_y": 2e-3, "o_z": -5e-3}, R=lean)
    np.testing.assert_allclose(r - [0.1, -0.2, 0.3], [-2.2e-3, 2e-3, -4.6e-3], atol=1e-15)
    np.testing.assert_array_equal(R, lean)


def test_a_stem_slants_about_its_tip_which_stays_where_it_is():
    tip, lean = np.array([0.01, 0.02, -0.03]), vr.axis_rotation("x", 0.3)
    r, R = sees("probe_tilt", {"tilt_x": 0.02}, R=lean, tip=tip)
    np.testing.assert_allclose(R, vr.axis_rotation("x", 0.32), atol=1e-6)
    np.testing.assert_allclose(r + R @ tip, [0.1, -0.2, 0.3] + lean @ tip, atol=1e-15)


def test_a_gauge_mounted_on_the_platform_reads_along_the_platforms_z():
    sensor = load_sensor("probe", height=0.2, mounted=True)
    table = sensor.table(load_mechanism("stewart42"))
    s = Named(table.names, ca.DM(table.nominal))["probe"]
    shown = sensor.readings(ca.DM([0, 0, 0.25]), ca.DM(vr.axis_rotation("x", np.pi / 3)), s)
    assert float(shown) == pytest.approx(0.1, abs=1e-15)


def test_effects_of_the_probe_mounting_do_not_apply_to_a_platform_that_stays_level():
    for name in ("probe_offset", "probe_tilt"):
        assert load_effect(name).applies(load_mechanism("delta24")) == "the platform does not tilt"
    assert load_effect("bed_shape").applies(load_mechanism("delta24")) == ""
    assert "over a plate" in load_effect("bed_shape").applies(load_mechanism("slider_crank"))


# --------------------------------------------------------------------------- found again

DOME = ((2, 0, 8e-3), (1, 1, -4e-3), (0, 2, 5e-3), (3, 0, 0.05), (2, 1, 0.1), (0, 3, -0.08))
HIDDEN = {
    "bed_shape": (
        vs.Gauge(0.3, shape=DOME),
        {f"h_{'x' * i}{'y' * j}": c for i, j, c in DOME} | {"h_xyy": 0.0},
    ),
    "probe_offset": (vs.Gauge(0.3, tip=(1e-3, -2e-3, 0.0)), {"o_x": 1e-3, "o_y": -2e-3}),
    "probe_tilt": (vs.Gauge(0.3, slant=(8e-3, -5e-3)), {"tilt_x": 8e-3, "tilt_y": -5e-3}),
}


def gauged(gauge, n=120, seed=2):
    """A hexapod before a pose device, with a gauge 0-12 mm over a plate."""
    rng, noise, twin = np.random.default_rng([seed, 3]), HEXAPOD.noise, HEXAPOD.twin
    r = rng.uniform((-0.06, -0.06, 0.300), (0.06, 0.06, 0.312), (n, 3))
    reading = twin.inverse(r, vr.turn(rng.uniform(-0.2, 0.2, (n, 3))))[0]
    r, R = twin.forward(reading)
    q_error, r_error, w_error = vd.errors(noise, n, 6, seed)
    return Dataset.from_arrays(
        HEXAPOD.joints,
        reading + q_error,
        r + r_error,
        vr.turn(w_error) @ R,
        pose_cov=np.diag(np.repeat([noise.position, noise.orientation], 3) ** 2),
        joint_sigma=noise.joint,
        pose_id=np.arange(n),
        conditions={"reading.probe": gauge.reads(r, R) + rng.normal(0, 2e-6, n)},
    )


@pytest.mark.wide
@pytest.mark.parametrize("name", HIDDEN)
def test_what_is_wrong_with_plate_or_probe_is_found_with_its_size(name):
    gauge, planted = HIDDEN[name]
    data = gauged(gauge)
    model = new_model("stewart42", sensors=[load_sensor("probe", height=0.3, mounted=True)])
    without, found = fit(model, data), fit(model.with_effect(name), data)
    sigma = dict(zip(found.model.table.names, found.estimate.sigma, strict=True))
    for number, value in planted.items():
        full = f"{name}.{number}"
        assert abs(found.model.value(full) - value) < 4 * sigma[full], full
    low, high = chi2_band(found.estimate.dof)
    assert low < found.estimate.chi2_per_dof < high < without.estimate.chi2_per_dof
