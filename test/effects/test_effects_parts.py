"""Parts that expand, each with its own temperature: by hand, and found in the virtual Delta."""

import casadi as ca
import numpy as np
import pytest
import virtual_day as vd
import virtual_effects_more as more

from parallel_cal.diagnosis.diagnose import diagnose
from parallel_cal.exporting.targets import c
from parallel_cal.kinematics.answers import parse_conditions
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.effect import Seen
from parallel_cal.model.model import new_model
from parallel_cal.model.parameters import Named
from parallel_cal.model.shelf import load_effect, load_mechanism
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.virtual import robot as vr

NAME = "thermal_expansion_by_part"
JOINTS = ("joint1", "joint2", "joint3")
DELTA = ("arms", "base", "rods")


def test_a_steel_rod_10_kelvin_warmer_and_an_arm_5_kelvin_colder_than_the_air():
    m, effect = load_mechanism("delta24"), load_effect(NAME)
    table = effect.table(m)
    numbers = {f"{NAME}.rods.alpha": 11.7e-6, f"{NAME}.arms.alpha": 23e-6}
    e = Named(table.names, ca.SX(ca.DM(table.vector(numbers))))[NAME]
    degrees = {"temperature.arms": 15.0, "temperature.rods": 30.0, "temperature.base": 20.0}
    at = Named(tuple(degrees), ca.SX(ca.DM(list(degrees.values()))))
    p = Named(m.parameters.names, ca.SX(ca.DM(m.parameters.nominal)))
    p = effect.ideal(Seen(ca.SX.zeros(3), ca.SX.zeros(3), ca.SX.eye(3), p), e, at, m).p
    rod, arm, base = (float(ca.DM(p[f"chain1.{n}"])) for n in ("Lb", "La_x", "D_x"))
    assert rod == pytest.approx(0.24 * (1 + 117e-6), abs=1e-15)
    assert arm == pytest.approx(0.119963 * (1 - 115e-6), abs=1e-15)
    assert base == 0.076


def test_a_mechanism_with_one_body_has_no_parts():
    links = [{"joint": "R", "axes": "parallel", "a": 0.3}, {"joint": "R", "a": 0.2}]
    with pytest.raises(Exception, match="its lengths belong to one body: thermal_expansion"):
        new_model(load_mechanism("serial", links=links)).with_effect(NAME)


def test_where_only_the_general_temperature_is_given_every_part_has_it():
    numbers = {
        f"{body}.alpha": rate for body, rate in zip(DELTA, (23e-6, 12e-6, 1e-6), strict=True)
    }
    one, other = (
        new_model("delta24", {f"{name}.{k}": v for k, v in numbers.items()}, [name])
        for name in ("thermal_expansion", NAME)
    )
    q, at = np.array([0.3, 0.4, 0.5]), {"temperature": 31.0}
    expected = Kinematics(one).direct(q, at).position
    np.testing.assert_allclose(Kinematics(other).direct(q, at).position, expected, atol=1e-15)
    warm = parse_conditions(other, ["temperature=31", "temperature.arms=45"])
    assert np.abs(Kinematics(other).direct(q, warm).position - expected).max() > 10e-6


def test_exported_c_has_one_member_for_each_part():
    files = c.files(new_model("delta24", effects=[NAME]), "robot")
    header = next(text for name, text in files.items() if name.endswith(".h"))
    for body in DELTA:
        assert f"double temperature_{body}; /* degC, 20 */" in header


def session(seed, rates, noise=1.0, n=120, again=30):
    """A day on which the motors warm the arms, the sun warms the base and the rods are as the air;
    `rates` of arms, rods and base (1/K). The base has no sensor of its own."""
    rng = np.random.default_rng([seed, 5])
    reading = vr.NOMINAL.inverse(vd.targets(n, seed))[0]
    pose = rng.permutation(np.r_[np.arange(n), rng.choice(n, again, replace=False)])
    count = len(pose)
    time = 20.0 * np.arange(count)
    air = 21 + 2 * np.sin(time / 400)
    arms = air + 12 * (1 - np.exp(-time / 900)) + 3 * np.sin(time / 150)
    arm, rod, base = rates
    growth = {"La": (arm, arms), "Lb": (rod, air), "dLb": (rod, air)}
    growth |= {"D": (base, air), "b": (base, air)}
    at = vr.SampleConditions(time, air, np.zeros(count), np.zeros((count, 3)))
    effects = [more.PartsWarmth(growth)] if any(rates) else []
    q = reading[pose]
    _, r, R = vr.truth(vr.MOCK_UP, effects, q, at)
    dq, dr, dw = (noise * part for part in vr.THESIS_NOISE.draw(rng, count))
    sigma = np.repeat([vr.THESIS_NOISE.position, vr.THESIS_NOISE.orientation], 3)
    known = {"time": time, "temperature": air, "temperature.arms": arms}
    return Dataset.from_arrays(
        JOINTS,
        q + dq,
        r + dr,
        vr.turn(dw) @ R,
        pose_cov=np.diag(sigma**2),
        joint_sigma=vr.THESIS_NOISE.joint,
        conditions=known,
        pose_id=pose,
    )


@pytest.mark.wide
def test_the_direct_problem_with_warm_parts_agrees_with_the_virtual_robot():
    numbers = {"arms.alpha": 60e-6, "rods.alpha": 10e-6, "base.alpha": 20e-6}
    data = session(1, (60e-6, 10e-6, 20e-6), noise=0.0)
    values = {**vr.MOCK_UP.parameters, **{f"{NAME}.{k}": v for k, v in numbers.items()}}
    model = new_model("delta54", values, [NAME])
    found = Kinematics(model).direct(data.q, dict(data.conditions))
    np.testing.assert_allclose(found.position, data.r, atol=1e-10)


@pytest.mark.wide
def test_parts_that_warm_apart_are_named_and_not_one_temperature():
    found = diagnose(new_model("delta54"), session(2, (90e-6, 23e-6, 12e-6)))
    assert NAME in {name for one in found.effects for name in (one, *found.swaps.get(one, []))}
    assert "thermal_expansion" not in found.effects


@pytest.mark.wide
def test_where_no_part_expands_nothing_is_named():
    found = diagnose(new_model("delta54"), session(3, (0.0, 0.0, 0.0)))
    assert found.effects == ()
