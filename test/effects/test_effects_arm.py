"""Effects of serial arms: by hand, and found in an arm that yields under its own links."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
import virtual_arm as va
from arms import nominal, seen
from test_effects_load import sees

from parallel_cal.diagnosis.diagnose import diagnose
from parallel_cal.effects._statics import own_weight_torques
from parallel_cal.identification.fit import fit
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.effect import Seen
from parallel_cal.model.file.modelfile import dump_model, parse_model
from parallel_cal.model.parameters import Named
from parallel_cal.model.shelf import load_effect
from parallel_cal.session.steps import add

HERE = va.Tracker()  # in {B} itself, its target in {P}
WALL = (0.0, -9.81, 0.0)  # the SCARA arm on a wall


def true_error(model, robot, seed=9):
    """Rms position error (m) of the robot's own model at 100 poses that nobody measured."""
    fresh = va.session(robot, 100, seed, HERE.exact())
    found = Kinematics(model.robot()).direct(fresh.q)
    return float(np.sqrt(np.mean(np.sum((found.position - fresh.true_r) ** 2, axis=1))))


# ---------------------------------------------------------------------------- by pencil and paper


@pytest.mark.parametrize("size", [0.2, 1.0])
def test_a_straight_arm_on_a_wall_yields_by_its_first_moments(size):
    """Links of 0.2 m and 0.16 m, both level: w (0.2 0.1 + 0.16 (0.2 + 0.08)) and w 0.16 0.08.
    The forearm turned by 60 degrees has half the lever, and carries a tool as heavy as 0.5 m."""
    gravity = tuple(size * np.array(WALL))  # the strength of gravity is part of w
    numbers = {"joint1.sag": 2e-3, "joint2.sag": 5e-3}
    q, *_ = sees("own_weight_sag", "scara16", numbers, {}, [0.0] * 3, gravity=gravity)
    assert q == pytest.approx([-2e-3 * 0.0648, -5e-3 * 0.0128, 0.0], abs=1e-15)
    numbers["tool"] = 0.5
    q, *_ = sees("own_weight_sag", "scara16", numbers, {}, [0.0, np.pi / 3, 0.0], gravity=gravity)
    bent = (0.16 * 0.08 + 0.5 * 0.16) / 2
    assert q[0] == pytest.approx(-2e-3 * (0.2 * 0.1 + (0.16 + 0.5) * 0.2 + bent), abs=1e-15)
    assert q[1] - np.pi / 3 == pytest.approx(-5e-3 * bent, abs=1e-15)


def test_only_revolute_joints_that_carry_links_yield():
    effect = load_effect("own_weight_sag")
    arm = nominal("ur5").mechanism
    assert [p.name for p in effect.parameters(arm)[1:]] == [f"joint{i}.sag" for i in (2, 3, 4, 5)]
    arm.gravity = WALL
    assert effect.parameters(arm)[1].name == "joint1.sag"


@pytest.mark.parametrize("kind", ["ur5", "wam"])
def test_the_torque_of_uniform_links_is_that_of_cross_products(kind):
    """Against the virtual arm's statics; a redundant arm's joints are in equilibrium, too."""
    rows, model = {"ur5": va.UR5, "wam": va.WAM}[kind], nominal(kind)
    exact = va.arm(kind, length=0, angle=0)
    lengths = [float(np.hypot(a, d)) for a, d, _ in rows]
    middles = [tuple(-np.array([a, d * np.sin(t), d * np.cos(t)]) / 2) for a, d, t in rows]
    uniform = va.Links((1.0,) * len(rows), tuple(lengths), tuple(middles), (0.0, 0.0, -1.0))
    q, m = va.session(exact, 5).q, model.mechanism
    p = Named(m.parameters.names, ca.SX(m.parameters.nominal))
    for reading, expected in zip(q, uniform.turns(exact.frames(q)), strict=True):
        at = Seen(ca.SX(reading), ca.SX.zeros(3), ca.SX.eye(3), p)
        torques = np.array(ca.DM(own_weight_torques(at, m))).ravel()
        assert torques == pytest.approx(expected, abs=1e-12)


# ---------------------------------------------------------------------------- as every effect does


def test_a_model_that_sags_keeps_its_numbers_and_its_direct_problem_undoes_the_inverse():
    plain = nominal("ur5")
    model = plain.with_effect("own_weight_sag")
    q = va.session(va.arm("ur5"), 20, width=0.3).q
    before = Kinematics(plain).direct(q)
    np.testing.assert_array_equal(Kinematics(model).direct(q).position, before.position)
    values = {f"own_weight_sag.joint{i}.sag": 2e-3 * i for i in (2, 3, 4, 5)}
    model = model.with_values(model.table.vector(values))
    again = parse_model(dump_model(model), "file")
    np.testing.assert_array_equal(again.values, model.values)
    pose = Kinematics(again.robot()).direct(q)  # the robot's own: a controller's model has it
    assert np.linalg.norm(pose.position - before.position, axis=1).min() > 50e-6
    back = Kinematics(again).inverse(pose.position, pose.rotation)
    assert back.ok.all()
    np.testing.assert_allclose(back.joints, q, atol=1e-10)


# ---------------------------------------------------------------------------- found in an arm


def with_tool(mass):
    """The manufacturer's links, with a tool of this mass (kg) 80 mm beyond the flange."""
    own = va.UR5_LINKS
    masses, centres = (*own.mass, mass), (*own.centre, (0.0, 0.0, 0.08))
    return replace(own, mass=masses, centre=centres)


@pytest.mark.wide
@pytest.mark.parametrize("pose", [True, False], ids=["pose", "position"])
@pytest.mark.parametrize("tool", [0.0, pytest.param(2.0, marks=pytest.mark.slow)])
def test_the_diagnosis_names_the_own_weight_of_an_arm_whose_links_are_unequal(pose, tool):
    robot = va.arm("ur5", 4, links=with_tool(tool))
    data = seen(va.session(robot, 120, 5, HERE), pose)
    found = diagnose(nominal("ur5"), data)
    assert found.effects[:1] == ("own_weight_sag",)
    if not tool:  # with one, the law is less exact, and a small effect may be named after it
        assert found.effects == ("own_weight_sag",)
        assert found.verdict.word == "explained"
    plain = fit(nominal("ur5"), data, hold_out=0).model
    better = add(nominal("ur5"), "own_weight_sag", data).model
    before, after = true_error(plain, robot), true_error(better, robot)
    assert before > 100e-6
    assert after < before / 5
    assert after < 30e-6


@pytest.mark.wide
def test_an_arm_that_is_stiff_needs_no_sag():
    found = diagnose(nominal("ur5"), seen(va.session(va.arm("ur5", 4), 120, 5, HERE)))
    assert found.effects == ()
    assert found.verdict.word == "at_noise"
