"""Argos, Stewart, linear Delta, slider-crank, RSSR and cable robot: numbers worked by hand,
independent points and rods, round trips, the parameter counts of table 3.1, ranks."""

import re
from pathlib import Path

import numpy as np
import pytest
import virtual_small

from parallel_cal.base.errors import ModelError
from parallel_cal.base.rotation import rotation_matrix, rotation_vector
from parallel_cal.identification.fit import fit
from parallel_cal.identification.fit_warnings import chi2_band
from parallel_cal.identification.prediction_errors import keep_moved_coordinates
from parallel_cal.kinematics.all_solutions import direct_all, inverse_all
from parallel_cal.kinematics.kinematics import Kinematics, Status
from parallel_cal.model.mechanism import poses_in_workspace
from parallel_cal.model.model import new_model
from parallel_cal.model.shelf import load_mechanism, load_sensor
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.virtual import argos, linear_delta, stewart

ALL = (
    "argos_nominal argos9 argos27 stewart42 planar_stewart linear_delta slider_crank rssr five_bar "
    "cable"
).split()
RIGHT = np.pi / 2
CYCLE = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])  # turns (x, y, z) into (z, x, y)
QUARTER = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])  # turns (x, y, z) into (-y, x, z)
EYE = np.eye(3)


def phi(model, q, r, R):
    configuration = np.concatenate([np.ravel(q), r, np.asarray(R).ravel()])
    return np.array(model.structure.closure(configuration, [], model.values)[0]).ravel()


def strayed(name, seed=0, tolerances=1.0, **options):
    """A robot whose every parameter is off by about so many tolerances."""
    model = new_model(load_mechanism(name, **options))
    draw = np.random.default_rng(seed).standard_normal(len(model.values))
    return model.with_values(model.values + tolerances * model.table.tolerance * draw)


def solved_poses(model, n=400, seed=1):
    """Configurations (n', nq + 12) of the workspace that close."""
    r, R = poses_in_workspace(model.mechanism, n, np.random.default_rng(seed))
    s = Kinematics(model).inverse(r, R)
    x = np.concatenate([s.joints, s.position, s.rotation.reshape(-1, 9)], axis=1)
    return x[s.residual < 1e-10]


# ------------------------------------------------------------------------------ every mechanism


@pytest.mark.parametrize("name", ALL)
def test_home_closes_and_is_what_both_problems_answer(name):
    model = new_model(name)
    home, kinematics = model.mechanism.home, Kinematics(model)
    pose = kinematics.direct(np.array(home.joints))
    joints = kinematics.inverse(pose.position, pose.rotation)
    assert (pose.status, joints.status) == (Status.CONVERGED, Status.CONVERGED)
    assert pose.position == pytest.approx(home.position, abs=1e-12)
    assert abs(pose.quaternion @ home.quaternion) == pytest.approx(1, abs=1e-12)
    assert joints.joints == pytest.approx(home.joints, abs=1e-12)


@pytest.mark.parametrize("compile", [False, True], ids=["virtual machine", "compiled"])
@pytest.mark.parametrize("name", ALL)
def test_round_trips_of_a_strayed_robot_return_to_where_they_began(name, compile):
    model = strayed(name, seed=3)
    kinematics = Kinematics(model, compile=compile)
    r, R = poses_in_workspace(model.mechanism, 1000, np.random.default_rng(4))
    there = kinematics.inverse(r, R)
    back = kinematics.direct(there.joints)
    assert set(there.status) | set(back.status) == {Status.CONVERGED}
    assert np.abs(back.position - there.position).max() <= 1e-12
    assert np.abs(rotation_vector(back.rotation @ there.rotation.swapaxes(1, 2))).max() <= 1e-12
    given = [i for i in model.mechanism.controlled if i < 3]
    assert np.abs((there.position - r)[:, given]).max(initial=0) == 0


@pytest.mark.parametrize("name", ALL)
def test_one_pose_is_answered_as_in_a_batch(name):
    model = strayed(name, seed=5)
    kinematics, x = Kinematics(model), solved_poses(model, 5)
    batch = kinematics.direct(x[:, : len(model.joints)])
    for i, row in enumerate(x):
        one = kinematics.direct(row[: len(model.joints)])
        assert np.abs(one.position - batch.position[i]).max() <= 1e-12
        assert np.abs(one.rotation - batch.rotation[i]).max() <= 1e-12


VIRTUAL = {  # robots of points, rods and pantographs, solved without any closure of ours
    "argos27": argos.Argos,
    "stewart42": stewart.Stewart,
    "planar_stewart": stewart.PlanarStewart,
    "linear_delta": linear_delta.LinearDelta,
    "slider_crank": virtual_small.SliderCrank,
    "rssr": virtual_small.Rssr,
    "five_bar": virtual_small.FiveBar,
    "cable": virtual_small.Cable,
}


@pytest.mark.wide
@pytest.mark.parametrize("name", VIRTUAL)
@pytest.mark.parametrize("seed", range(3))
def test_mechanism_agrees_with_the_robot_of_points_and_rods(name, seed):
    model = strayed(name, seed)
    robot, kinematics = VIRTUAL[name](model.table.mapping(model.values)), Kinematics(model)
    q, r, R = robot.inverse(*poses_in_workspace(model.mechanism, 100, np.random.default_rng(seed)))
    assert max(np.abs(phi(model, *x)).max() for x in zip(q, r, R, strict=True)) < 1e-11
    pose, joints = kinematics.direct(q), kinematics.inverse(r, R)
    assert np.abs(pose.position - r).max() < 1e-9
    assert np.abs(pose.rotation - R).max() < 1e-9
    assert np.abs((joints.joints - q) * joints_in_metres(model)).max() < 1e-9


def joints_in_metres(model):
    return 1.0 if model.mechanism.joint_unit == "m" else model.mechanism.length


@pytest.mark.parametrize("name", ["argos_nominal", "argos9"])
def test_spherical_argos_agrees_with_the_one_of_pantographs(name):
    model = strayed(name, 1)
    robot = argos.Argos(argos.spherical(model.table.mapping(model.values)))
    rows = solved_poses(model, 20)
    assert len(rows) == 20
    for row in rows:
        turned = robot.orientation_at_origin(
            row[:3], row[6:].reshape(3, 3) @ rotation_matrix(np.full(3, 0.02))
        )
        assert np.abs(turned.ravel() - row[6:]).max() < 1e-9


def test_nominal_values_of_the_argos_are_those_of_table_5_21():
    table = new_model("argos27").table
    assert table.nominal == pytest.approx(table.vector(argos.TABLE_5_21))


COUNTS = {  # table 3.1 and section 3.5; gear and advantage of a cable's line act as its radius
    "argos_nominal": 3,
    "argos9": 9,
    "argos27": 27,
    "stewart42": 42,
    "planar_stewart": 18,
    "linear_delta": 48,
    "slider_crank": 3,
    "rssr": 9,
    "cable": 4 * 6 + 2,
    "five_bar": 10,
}
RANKS = COUNTS | {"cable": 4 * 5}  # each line: anchor, offset, metres a radian


@pytest.mark.parametrize("name", ALL)
def test_parameters_are_as_many_as_a_complete_model_needs(name):
    assert len(new_model(name).table) == COUNTS[name]


@pytest.mark.wide
@pytest.mark.parametrize("name", [n for n in ALL if n not in ("rssr", "planar_stewart")])
def test_many_poses_see_every_parameter_on_its_own(name):
    tolerances = 20.0 if name == "linear_delta" else 1.0  # else its platform hardly turns
    model = strayed(name, seed=2, tolerances=tolerances)
    assert rank(model, solved_poses(model)) == RANKS[name]


def test_misaligned_slides_of_a_planar_platform_are_seen_once_they_are_there():
    model = strayed("planar_stewart", seed=2, tolerances=5)
    assert rank(model, solved_poses(model)) == 18
    straight = new_model("planar_stewart")
    assert rank(straight, solved_poses(straight)) == 15
    assert [n for n, f in zip(straight.table.names, straight.fixed, strict=True) if f] == [
        f"leg{i}.delta" for i in (1, 2, 3)
    ]


def rank(model, x, fixed=False):
    """Numerical rank of d phi / d p over many configurations, columns in tolerances."""
    phi, _, J = model.structure.closure_batch(x, np.zeros((len(x), 0)), model.values)
    J = J.reshape(len(x), -1, phi.shape[1]).transpose(0, 2, 1).reshape(-1, len(model.table))
    sizes = np.linalg.svd(J * model.table.tolerance * ~np.array(fixed), compute_uv=False)
    return int((sizes > 1e-9 * sizes[0]).sum())


# ------------------------------------------------------------------------------ by hand

# Chain 3 of the Argos with a sphere of radius 10, at r = (1, 2, 3) and R = CYCLE. On paper:
# C = (5, -7, 3), u = (0, -1, 0), R v = (-1, 0, 0), so CB = (-14, 9, 0), G1 = -9 and
# G2 = (277 - 100) / 20. Changed number -> (G1, G2).
ARGOS = {
    "alpha0": RIGHT,
    "Omega": RIGHT,
    "Phi": RIGHT,
    "omega": RIGHT,
    "phi": -RIGHT,
    "dA": 1,
    "dC": 2,
    "da": 3,
    "dc": 4,
    "gamma": RIGHT,
    "dR": 5,
    "R": 10,
}
ARGOS_BY_HAND = {
    "": (0, -9, 8.85),
    "q": (RIGHT, -15, 6.25),
    "alpha0": (0, 5, -0.55),
    "Omega": (0, -4, 5.65),
    "Phi": (0, -9, 9.95),
    "omega": (0, -9, 4.85),
    "phi": (0, -19, 13.85),
    "dA": (2, -9, 10.3),
    "dC": (3, -10, 9.8),
    "da": (4, -9, 8.9),
    "dc": (5, -9, 10.3),
    "gamma": (0, -5, 6.85),
    "dR": (6, -10, 9.8),
    "R": (20, -9, -3.075),
}


@pytest.mark.parametrize("changed", ARGOS_BY_HAND, ids=lambda name: name or "nothing")
def test_argos_27_closure_is_what_paper_and_pencil_say(changed):
    value, g1, g2 = ARGOS_BY_HAND[changed]
    numbers = {**ARGOS, changed: value} if changed in ARGOS else ARGOS
    mechanism = load_mechanism("argos27", radius=10)
    model = new_model(mechanism, {f"chain3.{k}": v for k, v in numbers.items()})
    q = [0, 0, value if changed == "q" else 0]
    assert phi(model, q, [1, 2, 3], CYCLE)[[2, 5]] == pytest.approx([g1, g2], abs=1e-12)
    assert set(ARGOS_BY_HAND) - {"", "q"} == {n[7:] for n in model.table.names if "chain3" in n}


def test_the_lengths_of_argos_27_act_where_their_descriptions_say():
    labels = {p.name.partition(".")[2]: p.label for p in load_mechanism("argos27").parameters}
    assert labels["da"] == "pantograph's shift along the motor axis"
    assert labels["dc"] == "pantograph's distance from the motor axis"
    assert labels["dR"] == "shift of the ball's circle along its normal"
    assert labels["dA"] == "motor axis' shift along motor axis 1"
    assert labels["dC"] == "motor axis' distance from motor axis 1"
    q, drawn = np.array([0.3, -0.2, 0.5]), argos.Argos(argos.TABLE_5_21)
    start, axis = drawn.hinges(q)
    motor, one = drawn.motors.along, drawn.motors.along[0]
    for name, along in [("da", motor[2]), ("dR", axis.along[2]), ("dA", one)]:
        moved = argos.Argos({**argos.TABLE_5_21, f"chain3.{name}": 1e-3}).hinges(q)[0] - start
        np.testing.assert_allclose(moved[2], 1e-3 * along, atol=1e-15)
    for name, across in [("dc", motor[2]), ("dC", one)]:
        moved = argos.Argos({**argos.TABLE_5_21, f"chain3.{name}": 1e-3}).hinges(q)[0] - start
        assert np.linalg.norm(moved[2]) == pytest.approx(1e-3)
        assert moved[2] @ across == pytest.approx(0, abs=1e-15)


@pytest.mark.parametrize(("chain", "g1", "g2"), [(1, -2, 8.2), (2, -14, 5.3)])
def test_argos_27_chains_with_fewer_parameters_lie_on_the_frames(chain, g1, g2):
    """Without Omega, omega, dA (chain 2) and Phi, phi, dC (chain 1): C = (4, 3, 7), (3, -4, 5)."""
    mechanism = load_mechanism("argos27", radius=10)
    names = {n.split(".")[1] for n in mechanism.parameters.names if f"chain{chain}." in n}
    model = new_model(mechanism, {f"chain{chain}.{k}": ARGOS[k] for k in names})
    rows = phi(model, [0, 0, 0], [1, 2, 3], CYCLE)
    assert rows[[chain - 1, chain + 2]] == pytest.approx([g1, g2], abs=1e-12)


def one_leg(leg, numbers):
    return {f"{leg}.{name}": value for name, value in numbers.items()}


STEWART = {  # CB = (3, 4, 12), 13 long
    "B_x": 1,
    "B_y": 2,
    "B_z": 3,
    "C_x": 4,
    "C_y": 2,
    "C_z": 4,
    "L0": 2,
}
STEWART_BY_HAND = {
    "": (0, 13 - 7),
    "q": (6, 13 - 8),
    "L0": (3, 13 - 8),
    "B_x": (2, 178**0.5 - 7),
    "B_y": (3, 194**0.5 - 7),
    "B_z": (4, 176**0.5 - 7),
    "C_x": (5, 164**0.5 - 7),
    "C_y": (3, 162**0.5 - 7),
    "C_z": (5, 146**0.5 - 7),
}


@pytest.mark.parametrize("changed", STEWART_BY_HAND, ids=lambda name: name or "nothing")
@pytest.mark.parametrize("leg", [0, 3, 5])
def test_stewart_leg_is_what_paper_and_pencil_say(changed, leg):
    value, expected = STEWART_BY_HAND[changed]
    numbers = {**STEWART, changed: value} if changed in STEWART else STEWART
    q = np.full(6, value if changed == "q" else 5)
    model = new_model("stewart42", one_leg(f"leg{leg + 1}", numbers))
    assert phi(model, q, [4, 5, 14], CYCLE)[leg] == pytest.approx(expected, abs=1e-12)


PLANAR = {  # CB = (3, 4); |3 + 4 i| = 5
    "B_x": 1,
    "B_y": 2,
    "C_x": 1,
    "C_y": 2,
    "L0": 3,
    "delta": RIGHT,
}
PLANAR_BY_HAND = {
    "": (0, 0),
    "q": (3, 5 - 18**0.5),
    "delta": (0, 5 - 7),
    "L0": (4, 5 - 32**0.5),
    "B_x": (2, 34**0.5 - 5),
    "B_y": (3, 20**0.5 - 5),
    "C_x": (2, 20**0.5 - 5),
    "C_y": (3, 18**0.5 - 5),
}


@pytest.mark.parametrize("changed", PLANAR_BY_HAND, ids=lambda name: name or "nothing")
@pytest.mark.parametrize("leg", [0, 1, 2])
def test_planar_leg_is_what_paper_and_pencil_say(changed, leg):
    value, expected = PLANAR_BY_HAND[changed]
    numbers = {**PLANAR, changed: value} if changed in PLANAR else PLANAR
    model = new_model("planar_stewart", one_leg(f"leg{leg + 1}", numbers))
    q = np.full(3, value if changed == "q" else 4)
    assert phi(model, q, [6, 5, 0], QUARTER)[leg] == pytest.approx(expected, abs=1e-12)
    back = Kinematics(model).inverse([6, 5, 0], QUARTER).joints[leg]
    if changed in ("", "delta"):
        assert back == pytest.approx(4 if changed == "" else 2, abs=1e-12)


LINEAR = {
    "D_x": 4,
    "D_y": 5,
    "D_z": 6,
    "alpha": RIGHT,
    "beta": 0,
    "Lb": 10,
    "dC_x": 3,
    "dC_y": -6,
    "dC_z": 3,
    "dLb": 2,
    "d_x": 1,
    "d_y": 2,
    "d_z": 3,
    "b_x": 1,
    "b_y": 2,
    "b_z": 3,
}
# On paper CB = (5, 10, -3) and dd = (-1, 5, -4) at reading 2; the rail runs along -y.
LINEAR_BY_HAND = {
    "": (0, 3.6, 3.7),
    "q": (3, 4.65, 4.2),
    "D_x": (5, 3.15, 3.8),
    "D_y": (6, 2.65, 3.2),
    "D_z": (7, 3.95, 4.1),
    "alpha": (0, 2.6, 3.5),
    "beta": (RIGHT, 1.0, 2.9),
    "Lb": (20, -5.7, 0.85),
    "dC_x": (4, 3.75, 3.2),
    "dC_y": (-5, 3.15, 2.7),
    "dC_z": (4, 4.05, 4.0),
    "dLb": (3, 3.35, 2.7),
    "d_x": (2, 4.3, 4.2),
    "d_y": (3, 2.8, 2.4),
    "d_z": (4, 4.0, 4.5),
    "b_x": (2, 4.2, 4.3),
    "b_y": (3, 2.4, 2.8),
    "b_z": (4, 4.5, 4.0),
}


@pytest.mark.parametrize("changed", LINEAR_BY_HAND, ids=lambda name: name or "nothing")
@pytest.mark.parametrize("chain", [0, 1, 2])
def test_linear_delta_chain_is_what_paper_and_pencil_say(changed, chain):
    value, g1, g2 = LINEAR_BY_HAND[changed]
    numbers = {**LINEAR, changed: value} if changed in LINEAR else LINEAR
    model = new_model("linear_delta", one_leg(f"chain{chain + 1}", numbers))
    around = rotation_matrix(np.array([0, 0, chain * 2 * np.pi / 3]))  # all turns with the chain
    q = np.full(3, value if changed == "q" else 2)
    rows = phi(model, q, around @ [7, 14, 4], around @ CYCLE @ around.T)
    assert rows[[chain, 3 + chain]] == pytest.approx([g1, g2], abs=1e-12)
    assert {n[7:] for n in model.table.names} == set(LINEAR_BY_HAND) - {"", "q"}


CRANK = {"a": 3, "b": 5, "q0": 0}
CRANK_BY_HAND = {  # changed -> (value, row) at x = 4 and a crank at right angles
    "": (0, 0),
    "a": (4, 0.7),
    "b": (10, -3.75),
    "q0": (RIGHT, 2.4),
    "q": (np.pi, 2.4),
}


@pytest.mark.parametrize("changed", CRANK_BY_HAND, ids=lambda name: name or "nothing")
def test_slider_crank_is_what_paper_and_pencil_say(changed):
    value, expected = CRANK_BY_HAND[changed]
    model = new_model("slider_crank", {**CRANK, **({changed: value} if changed in CRANK else {})})
    q = value if changed == "q" else RIGHT
    assert phi(model, [q], [4, 0, 0], EYE) == pytest.approx([expected], abs=1e-12)


FIVE = {"x": 1, "y": 2, "crank": 3, "rod": 5, "q0": 0}
FIVE_BY_HAND = {  # changed -> (value, row) at (5, 8), a crank at right angles ending at (1, 5)
    "": (0, 0),
    "x": (2, -0.7),
    "y": (1, 0.7),
    "crank": (6, -0.9),
    "rod": (2.5, 3.75),
    "q0": (RIGHT, 6.0),
    "q": (0, 1.2),
}


@pytest.mark.parametrize("side", ["left", "right"])
@pytest.mark.parametrize("changed", FIVE_BY_HAND, ids=lambda name: name or "nothing")
def test_five_bar_is_what_paper_and_pencil_say(changed, side):
    value, expected = FIVE_BY_HAND[changed]
    numbers = {**FIVE, **({changed: value} if changed in FIVE else {})}
    model = new_model("five_bar", one_leg(side, numbers))
    q = np.full(2, value if changed == "q" else RIGHT)
    row = phi(model, q, [5, 8, 0], EYE)[int(side == "right")]
    assert row == pytest.approx(expected, abs=1e-12)


def test_slider_crank_of_the_thesis_meets_the_axis_twice():
    """a = 80, b = 50 mm at sin q = 0.6: 64 +- 14 mm (eq. 5.11)."""
    kinematics = Kinematics(new_model("slider_crank"))
    both = direct_all(kinematics.model, np.arcsin([0.6]))
    assert both.position[:, 0] == pytest.approx([0.078, 0.050], abs=1e-15)
    angles = inverse_all(kinematics.model, [0.078, 0, 0]).joints[:, 0]
    assert angles == pytest.approx([np.arcsin(0.6), -np.arcsin(0.6)], abs=1e-14)


RSSR = {
    "a": 1,
    "alpha": RIGHT,
    "input.r": 2,
    "input.s": 3,
    "input.q0": 0,
    "output.r": 4,
    "output.s": 5,
    "output.q0": RIGHT,
    "L": 5,
}
RSSR_BY_HAND = {  # C = (1, -3, 2), B = (0, 4, 5)
    "": (0, 3.4),
    "q": (0, 5.8),
    "a": (2, 3.7),
    "alpha": (0, -1.6),
    "L": (10, -2.05),
    "input.r": (3, 2.9),
    "input.s": (4, 4.9),
    "input.q0": (RIGHT, 5.0),
    "output.r": (5, 4.9),
    "output.s": (6, 4.1),
    "output.q0": (0, 0.2),
}


@pytest.mark.parametrize("changed", RSSR_BY_HAND, ids=lambda name: name or "nothing")
def test_rssr_loop_is_what_paper_and_pencil_say(changed):
    value, expected = RSSR_BY_HAND[changed]
    model = new_model("rssr", {**RSSR, **({changed: value} if changed in RSSR else {})})
    q = value if changed == "q" else RIGHT
    assert phi(model, [q], [0, 0, 0], EYE) == pytest.approx([expected], abs=1e-12)
    assert set(model.table.names) == set(RSSR_BY_HAND) - {"", "q"}


CABLE = {
    "line2.A_x": 0,
    "line2.A_y": 0,
    "line2.A_z": 5,
    "line2.offset": 1,
    "line2.gear": 3,
    "line2.advantage": 2,
    "spool1.R": 6,
}
CABLE_BY_HAND = {  # |P - A| = 13, |A| = 5, one metre a radian, two radians, offset one
    "": (0, 5),
    "q": (3, 4),
    "line2.offset": (2, 4),
    "line2.gear": (6, 6),
    "line2.advantage": (4, 6),
    "spool1.R": (12, 3),
    "line2.A_x": (1, 164**0.5 - 26**0.5 - 3),
    "line2.A_y": (1, 162**0.5 - 26**0.5 - 3),
    "line2.A_z": (6, 146**0.5 - 6 - 3),
}


@pytest.mark.parametrize("changed", CABLE_BY_HAND, ids=lambda name: name or "nothing")
def test_cable_line_is_what_paper_and_pencil_say(changed):
    value, expected = CABLE_BY_HAND[changed]
    model = new_model("cable", {**CABLE, **({changed: value} if changed in CABLE else {})})
    q = np.full(4, value if changed == "q" else 2)
    assert phi(model, q, [3, 4, 17], EYE)[1] == pytest.approx(expected, abs=1e-12)


# ------------------------------------------------------------------------------ Argos


def test_argos_home_puts_every_ball_midway_between_two_axes():
    """On paper: u1 = (0, 1, -1), R v1 = (1, -2, -2) / 3 and so on, all perpendicular."""
    R = Kinematics(new_model("argos_nominal")).direct(np.zeros(3)).rotation
    expected = np.array([[1, -2, 2], [-2, 1, 2], [-2, -2, -1]]) / 3
    assert np.abs(R - expected).max() < 1e-15


def nominal_triples(joints, R):
    """(w x u) . R v of eq. 6.53 for the three chains of the nominal Argos."""
    a = joints + np.radians([-45, 45, -45])
    c, s, zero = np.cos(a), np.sin(a), np.zeros(len(a))
    u = [
        np.stack(row, 1)
        for row in (
            (zero, c[:, 0], s[:, 0]),
            (-c[:, 1], zero, s[:, 1]),
            (-c[:, 2], -s[:, 2], zero),
        )
    ]
    v = np.diag([1, 1, -1])
    return [np.sum(np.cross(EYE[i], u[i]) * (R @ v[i]), axis=1) for i in range(3)]


def test_argos_home_branch_is_the_one_the_pantographs_allow():
    """Eq. 6.53: left-handed for chains 1 and 2, right-handed for chain 3."""
    model = new_model("argos_nominal")
    x = solved_poses(model)
    first, second, third = nominal_triples(x[:, :3], x[:, 6:].reshape(-1, 3, 3))
    assert max(first.max(), second.max()) < -0.1
    assert third.min() > 0.1


@pytest.mark.parametrize("seed", range(5))
def test_nominal_argos_has_four_regular_orientations(seed):
    model = strayed("argos_nominal", seed)
    kinematics = Kinematics(model)
    q = solved_poses(model, 1, seed)[0, :3]
    found = direct_all(kinematics.model, q)
    assert [Status(s) for s in found.status] == [Status.CONVERGED] * 4
    assert found.residual.max() < 1e-15
    turns = rotation_vector(found.rotation[1:] @ found.rotation[0].T)
    assert np.linalg.norm(turns, axis=1) == pytest.approx([np.pi] * 3)


def test_a_ball_on_its_motor_axis_closes_but_is_no_answer():
    """The factor sin(theta2) = 0 of eq. 6.42: R = 1 puts all three balls on their axes."""
    model = new_model("argos_nominal")
    q = np.array([0.1, -0.2, 0.3])
    assert np.abs(phi(model, q, np.zeros(3), EYE)).max() < 1e-15
    found = direct_all(model, q)
    assert np.abs(found.rotation - EYE).max(axis=(1, 2)).min() > 0.5


def test_nominal_argos_is_solved_where_motor_1_is_level():
    """There both factors of the first equation of 6.45 vanish."""
    kinematics = Kinematics(new_model("argos_nominal"))
    q = np.array([np.pi / 4, 0.1, -0.1])
    found = direct_all(kinematics.model, q)
    assert len(found) == 4
    assert found.residual.max() < 1e-15


@pytest.mark.parametrize("name", ["argos_nominal", "argos9", "argos27"])
def test_every_argos_has_eight_joint_sets(name):
    model = strayed(name, 6)
    pose = Kinematics(model).direct(np.array([0.1, 0.2, -0.1]))
    found = inverse_all(model, pose.position, pose.rotation)
    # The centre of argos27 follows the joints: in further sets it lies centimetres away.
    near = np.linalg.norm(found.position - pose.position, axis=1) < 0.05
    assert near.sum() == 8
    assert found.complete == near.all() == (name != "argos27")
    assert found.residual.max() < 1e-10
    assert found.joints[0] == pytest.approx([0.1, 0.2, -0.1], abs=1e-10)


@pytest.mark.parametrize("name", ["argos_nominal", "argos9"])
@pytest.mark.parametrize("options", [{}, {"radius": 0.3}], ids=["mock-up", "larger"])
def test_small_argos_widened_answers_the_same(name, options):
    small = strayed(name, 7, **options)
    large = small.widen()
    q = solved_poses(small, 200)[:, :3]
    a, b = Kinematics(small).direct(q), Kinematics(large).direct(q)
    assert np.abs(a.rotation - b.rotation).max() < 1e-13
    assert np.abs(b.position).max() < 1e-14
    assert large.mechanism.length == small.mechanism.length


def test_argos_9_rows_are_the_first_ones_of_argos_27_anywhere():
    small = strayed("argos9", 8, radius=0.2)
    q, R = np.array([0.3, -0.4, 0.5]), rotation_matrix(np.array([0.4, 1.1, -0.7]))
    rows = phi(small.widen(), q, np.zeros(3), R)
    assert rows[:3] == pytest.approx(phi(small, q, np.zeros(3), R), abs=1e-15)
    assert np.abs(rows[3:]).max() < 1e-15


# ------------------------------------------------------------------------------ the others


def rotated(degrees, point):
    return rotation_matrix(np.array([0, 0, np.radians(degrees)])) @ point


def test_rssr_loop_is_two_arms_of_the_delta_mock_up_and_a_rod():
    """Arm tips of chains 1 and 2 by their place in the room (table 5.12): 240 mm apart."""
    kinematics = Kinematics(new_model("rssr"))
    for q in np.radians([45, 60, 75, 85]):
        w = rotation_vector(kinematics.direct(np.array([q])).rotation)[2]
        tip1 = np.array([0.1 + 0.12 * np.cos(q), 0.02, 0.12 * np.sin(q)])
        tip2 = rotated(120, np.array([0.1 + 0.12 * np.cos(w), -0.02, 0.12 * np.sin(w)]))
        assert np.linalg.norm(tip1 - tip2) == pytest.approx(0.24, abs=1e-12)


def test_angles_of_a_short_cut_loop_see_eight_of_nine_parameters():
    """A loop twice as large has the same angles: one length must be known."""
    turns = np.radians(np.arange(-180, 180, 3.0))
    numbers = {"a": 0.05, "alpha": -1.9, "input.r": 0.06, "input.s": 0.13, "L": 0.22}
    model = new_model("rssr", numbers)
    found = [direct_all(model, np.array([q])) for q in turns]
    rows = [np.r_[s.joints, s.position, s.rotation.ravel()] for f in found for s in f if s.ok]
    assert len(rows) > 100
    assert rank(model, np.array(rows)) == 8
    assert rank(model, np.array(rows), np.array([n == "L" for n in model.table.names])) == 8


def test_where_the_axes_meet_a_short_cut_loop_needs_two_known_lengths():
    model = new_model("rssr")
    x = solved_poses(model)
    assert rank(model, x) == 7
    assert rank(model, x, model.fixed) == 7 == int((~model.fixed).sum())


def test_free_parameters_of_a_cable_robot_are_all_seen():
    model = strayed("cable", seed=2)
    assert rank(model, solved_poses(model), model.fixed) == 4 * 4 + 2


@pytest.mark.parametrize("lean", [0, 30, 45])
def test_linear_delta_with_leaning_rails_has_its_home(lean):
    model = new_model(load_mechanism("linear_delta", inclination=np.radians(lean)))
    kinematics, home = Kinematics(model), model.mechanism.home
    pose = kinematics.direct(np.array(home.joints))
    assert pose.position == pytest.approx(home.position, abs=1e-12)
    out, up = home.joints[0] * np.sin(np.radians(lean)), home.joints[0] * np.cos(np.radians(lean))
    assert np.hypot(0.1 + out, up - home.position[2]) == pytest.approx(0.25, abs=1e-12)


def test_a_linear_deltas_towers_stand_where_its_direction_says():
    plain, turned = (
        Kinematics(new_model(load_mechanism("linear_delta", direction=turn))) for turn in (0, 0.7)
    )
    r = np.array([[0.03, -0.02, 0.1]])
    there = r @ rotation_matrix(np.array([0, 0, 0.7])).T
    assert turned.inverse(there).joints == pytest.approx(plain.inverse(r).joints, abs=1e-12)


def test_linear_delta_has_two_level_poses_and_eight_joint_sets():
    kinematics = Kinematics(new_model("linear_delta"))
    pose = kinematics.direct(np.array([0.3, 0.32, 0.31]))
    every = direct_all(kinematics.model, np.array([0.3, 0.32, 0.31]))
    assert every.count_complex == 40
    assert (np.abs(every.rotation - np.eye(3)).max(axis=(1, 2)) < 1e-9).sum() == 2
    assert every.position[0] == pytest.approx(pose.position)
    joints = inverse_all(kinematics.model, pose.position)
    assert (np.abs(joints.rotation - np.eye(3)).max(axis=(1, 2)) < 1e-9).sum() == 8


def test_cable_motors_turn_many_times():
    kinematics = Kinematics(new_model("cable"))
    target = np.array([[0.3, -0.2, 0.6]])
    joints = kinematics.inverse(target).joints[0]
    low = np.linalg.norm(target[0] - [0, -1.6, -0.11]) - np.linalg.norm([0, -1.6, -0.11])
    assert joints[0] == pytest.approx(low / (0.075 / 12.75 / 2), abs=1e-9)
    assert np.abs(joints).max() > 20 * np.pi


def test_lines_that_disagree_are_answered_by_least_squares():
    """No pose fits four readings with errors; the residual says by how much."""
    model = new_model("cable")
    kinematics = Kinematics(model)
    true = np.random.default_rng(0).uniform((-0.5, -0.5, 0), (0.5, 0.5, 0.8), (50, 3))
    q = kinematics.inverse(true).joints + np.array([0.0, 0, 0, 1.0])  # 1.5 mm of line 4
    answers = kinematics.direct(q)
    assert answers.ok.all()
    assert 2e-4 < answers.residual.min() < answers.residual.max() < 2e-3
    for i in (0, 20, 49):
        steps = answers.position[i] + 1e-4 * np.vstack([EYE, -EYE])
        worse = [np.linalg.norm(phi(model, q[i], p, EYE)) for p in steps]
        assert min(worse) > answers.residual[i]


@pytest.mark.parametrize("lines", ["three", "coplanar", "eight"])
def test_cable_robots_of_other_shapes_are_solved(lines):
    top = [[1, 1, 2], [-1, 1, 2], [-1, -1, 2], [1, -1, 2]]
    anchors = {
        "three": top[:3],
        "coplanar": top,
        "eight": [*top, [1, 1, -1], [-1, 1, -1], [-1, -1, -1], [1, -1, -1]],
    }[lines]
    model = new_model(load_mechanism("cable", anchors=anchors, spools=[1] * len(anchors)))
    kinematics = Kinematics(model)
    target = np.random.default_rng(0).uniform(-0.4, 0.4, (100, 3))
    back = kinematics.direct(kinematics.inverse(target).joints)
    assert np.abs(back.position - target).max() < 1e-12
    assert [n for n in model.table.names if "spool" in n] == ["spool1.R"]


PLANES = {
    "two lines": ([[-3, 4], [3, 4]], "xy"),
    "four lines": ([[-3, 4], [3, 4], [3, -4], [-3, -4]], "xy"),
    "collinear anchors": ([[-3, 4], [0, 4], [3, 4]], "xy"),
    "a wall": ([[-3, 0, 4], [3, 0, 4], [0, 0, -5]], "xz"),
}


@pytest.mark.parametrize("name", PLANES)
def test_a_planar_cable_robot_moves_in_the_plane_of_its_anchors(name):
    anchors, plane = PLANES[name]
    model = new_model(load_mechanism("cable", anchors=anchors))
    assert "".join(model.mechanism.moves) == "".join(model.mechanism.controls) == plane
    assert sum(".A_" in n for n in model.table.names) == 2 * len(anchors)
    kinematics, used = Kinematics(model), ["xyz".index(axis) for axis in plane]
    target = np.zeros((100, 3))
    target[:, used] = np.random.default_rng(0).uniform(-0.4, 0.4, (100, 2))
    back = kinematics.direct(kinematics.inverse(target).joints)
    assert np.abs(back.position - target).max() < 1e-12


def test_a_planar_line_is_what_paper_and_pencil_say():
    """From (0, 0) to (3, 4) the line from the anchor (-3, -4) grows from 5 m to 10 m, that from
    (3, -4) from 5 m to 8 m. The height of the point does not matter."""
    anchors = [[-3, -4], [3, -4]]
    model = new_model(load_mechanism("cable", anchors=anchors, radius=1.0))
    motors = 12.75 * np.array([5, 3])
    for height in (0, 0.7):
        assert phi(model, motors, [3, 4, height], EYE) == pytest.approx([0, 0], abs=1e-12)


def test_readings_of_a_cable_robot_with_own_anchors_are_lengths_of_line():
    """The Hangprinter's spools are not its own. From (0, 0) to (3, 4) the lines grow from 5 m to 10
    and to 8 m. Two strands of the second let out 6 m. From the anchors they are 10 and 8 m long."""
    anchors, target = [[-3, -4], [3, -4]], [3, 4, 0]
    model = new_model(load_mechanism("cable", anchors=anchors, advantages=[1, 2]))
    assert model.joints == ("line1", "line2")
    assert model.mechanism.joint_units == ("m", "m")
    assert not model.mechanism.winds
    assert phi(model, [5, 6], target, EYE) == pytest.approx([0, 0], abs=1e-12)
    whole = new_model(load_mechanism("cable", anchors=anchors, zero="anchors"))
    assert phi(whole, [10, 8], target, EYE) == pytest.approx([0, 0], abs=1e-12)
    assert whole.mechanism.home.joints == (5.0, 5.0)
    np.testing.assert_allclose(
        Kinematics(whole).direct(np.array([np.sqrt(40), 2.0])).position, [3, -2, 0], atol=1e-9
    )


@pytest.mark.parametrize(
    ("option", "words"),
    [
        ({"zero": "there"}, "zero 'there': expected 'origin' or 'anchors'"),
        ({"radius": [0.1, 0.2]}, r"radius \[0.1, 0.2\]: expected a number, or 4 of them"),
        ({"gear": 0}, "gear 0: expected numbers above 0"),
    ],
)
def test_a_wrong_option_of_a_cable_robot_is_an_error_that_says_what_is_expected(option, words):
    with pytest.raises(ModelError, match=words):
        load_mechanism("cable", **option)


@pytest.mark.parametrize("lines", [2, 4])
def test_heights_measured_at_a_planar_cable_robot_do_not_change_the_fit(lines):
    """0.1 mm of noise in the plane, 25 mm across it: the errors are those in the plane."""
    anchors = np.array([[-1.5, 1.2], [1.5, 1.1], [1.4, -1.2], [-1.6, -1.0]])[:lines]
    rng = np.random.default_rng(5)
    r = np.column_stack([rng.uniform(-0.8, 0.8, (80, 2)), np.zeros(80)])
    way = np.linalg.norm(r[:, None, :2] - anchors, axis=2) - np.linalg.norm(anchors, axis=1)
    off = np.round(anchors + rng.normal(0, 5e-3, anchors.shape), 3)
    mechanism = load_mechanism("cable", anchors=off.tolist(), radius=0.075)
    q = way * 12.75 / 0.0752 + 0.02 * rng.normal(size=way.shape)
    data = Dataset.from_arrays(
        mechanism.joints,
        q,
        r + rng.normal(size=r.shape) * [1e-4, 1e-4, 25e-3],
        pose_cov=np.diag(np.square([1e-4, 1e-4, 1e-4, np.nan, np.nan, np.nan])),
        joint_sigma=0.02,
    )
    found = fit(new_model(mechanism), data)
    low, high = chi2_band(found.estimate.dof)
    assert low < found.estimate.chi2_per_dof < high
    assert found.held_out.summary.position_rms < 0.3e-3
    assert found.model.value("spool1.R") == pytest.approx(0.0752, abs=3e-5)


def test_errors_across_the_plane_are_left_out_in_the_axes_of_the_device():
    """The device stands on its side: its y-axis is the base's z-axis, its z-axis the base's -y."""
    on_side = load_sensor("device_frame", quaternion=(np.sqrt(0.5), 0, 0, np.sqrt(0.5)))
    table = load_mechanism("cable", anchors=[[-3, 4], [3, 4]])
    apart = np.array([[1e-3, 25e-3, 2e-3]])
    kept = keep_moved_coordinates(new_model(table, sensors=[on_side]), apart, range(3))
    np.testing.assert_allclose(kept, [[1e-3, 0, 2e-3]], atol=1e-15)
    kept = keep_moved_coordinates(new_model(table), apart, range(3))
    np.testing.assert_allclose(kept, [[1e-3, 25e-3, 0]], atol=1e-15)
    kept = keep_moved_coordinates(new_model("cable"), apart, range(3))
    np.testing.assert_array_equal(kept, apart)


def test_wrong_cable_options_say_what_is_expected():
    with pytest.raises(ModelError, match="3 spools for 4 anchors, expected one for each"):
        load_mechanism("cable", spools=[1, 1, 2])
    with pytest.raises(ModelError, match="2 anchors given, expected at least 3 points"):
        load_mechanism("cable", anchors=[[0, 1, 1], [1, 1, 0]])
    with pytest.raises(ModelError, match=r"expected points \[x, y, z\], or all \[x, y\], in m"):
        load_mechanism("cable", anchors=[[0, 1, 1], [1, 1]])
    with pytest.raises(ModelError, match="are collinear with the origin: expected anchors that"):
        load_mechanism("cable", anchors=[[1, 0, 0], [2, 0, 0], [-1, 0, 0]])
    with pytest.raises(ModelError, match="at the origin: they pull along 1 of 2 independent"):
        load_mechanism("cable", anchors=[[1, 1], [1, 1]])
    with pytest.raises(ModelError, match="at the origin: they pull along 2 of 3 independent"):
        load_mechanism("cable", anchors=[[0, 1, 1], [1, 1, 1], [2, 1, 1]])
    with pytest.raises(ModelError, match=r"at home \[2.0, 1.0, 0.0\]: they pull along 1 of 2"):
        load_mechanism("cable", anchors=[[0, 1], [1, 1]], home=[2, 1])
    with pytest.raises(ModelError, match=r"an anchor is at home \[0.0, 1.0, 0.0\]"):
        load_mechanism("cable", anchors=[[0, 1], [1, 1]], home=[0, 1])
    with pytest.raises(ModelError, match=r"home \[1\]: expected \[x, y, z\] or \[x, y\], in m"):
        load_mechanism("cable", anchors=[[0, 1], [1, 1]], home=[1])
    with pytest.raises(ModelError, match=r"advantages \[2, 2, 0, 4\], expected numbers above 0"):
        load_mechanism("cable", advantages=[2, 2, 0, 4])


@pytest.mark.parametrize("radius", [0, -0.11])
def test_an_argos_without_size_is_refused(radius):
    with pytest.raises(ModelError, match=f"argos27: length is {float(radius)} m.*expected above 0"):
        load_mechanism("argos27", radius=radius)


HP4 = Path(__file__).parents[2] / "real/hangprinter_hp4/hp4_2021-12-14.csv"


def test_measured_cable_robot_is_fitted_to_the_known_error():
    """Anchors, offsets and two radii fitted to 37 poses leave 1.557 mm a line."""
    table = np.loadtxt(HP4, delimiter=",", skiprows=1)
    position, q = table[:, 1:4] * 1e-3, np.radians(table[:, 4:8])
    model = new_model("cable")
    free = ~model.fixed
    x = np.column_stack([q, position, np.tile(EYE.ravel(), (len(q), 1))])
    for _ in range(8):  # Gauss and Newton
        rows, _, J = model.structure.closure_batch(x, np.zeros((len(x), 0)), model.values)
        J = J.reshape(len(x), -1, 4).transpose(0, 2, 1).reshape(-1, len(model.values))[:, free]
        values = model.values.copy()
        values[free] -= np.linalg.lstsq(J, rows.ravel(), rcond=None)[0]
        model = model.with_values(values)
    assert np.sqrt(np.mean(rows**2)) == pytest.approx(1.557e-3, abs=2e-6)
    answers = Kinematics(model).direct(q)
    assert answers.ok.all()
    assert np.linalg.norm(answers.position - position, axis=1).mean() < 2.5e-3


# ------------------------------------------------------------------------------ presets

CONFIG = Path(__file__).parents[2] / "config"
PRESETS = (
    "argos_mockup_nominal argos9_mockup_identified argos27_mockup_identified stewart_planar "
    "stewart_general hangprinter_hp4"
).split()


@pytest.mark.parametrize("name", PRESETS)
def test_preset_is_read_and_solved_over_its_workspace(name):
    from parallel_cal.model.file.modelfile import read_model

    model = read_model(CONFIG / f"{name}.yaml")
    kinematics = Kinematics(model)
    r, R = poses_in_workspace(model.mechanism, 300, np.random.default_rng(0))
    there = kinematics.inverse(r, R)
    back = kinematics.direct(there.joints)
    assert there.ok.all()
    assert back.ok.all()
    assert np.abs(back.position - there.position).max() < 1e-12


@pytest.mark.parametrize("seed", range(4))
def test_every_pose_of_a_planar_platform_is_found(seed):
    rng = np.random.default_rng(seed)
    model = strayed("planar_stewart", seed, tolerances=20)
    robot = stewart.PlanarStewart(model.table.mapping(model.values))
    q = robot.inverse(*poses_in_workspace(model.mechanism, 1, rng))[0][0]
    found = direct_all(model, q)
    others = poses_from_anywhere(robot, q, rng)
    assert len(others) > 1
    for r, R in others:
        away = np.abs(found.position - r).max(axis=1) + np.abs(found.rotation - R).max(axis=(1, 2))
        assert away.min() < 1e-6
    assert len(found) == len({tuple(np.round(r, 6)) for r, _ in others})


def poses_from_anywhere(robot, q, rng):
    """The poses that scipy finds from 60 random starts, with repetitions."""
    from scipy.optimize import fsolve

    def placed(u):
        return np.array([*u[:2], 0.0]), rotation_matrix(np.array([0.0, 0.0, u[2]]))

    def gaps(u):
        return robot.gaps(q, *placed(u), robot.home)

    starts = rng.uniform([-0.4, -0.4, -np.pi], [0.4, 0.4, np.pi], (60, 3))
    ends = [fsolve(gaps, start, full_output=True) for start in starts]
    return [placed(u) for u, info, done, _ in ends if done == 1 and abs(info["fvec"]).max() < 1e-9]


def test_a_hexapod_is_stated_by_its_drawing():
    """Six points or a circle with angles, the height and nothing else: the readings at home are 0,
    and the closure holds there."""
    angles = [200, 220, 320, 340, 80, 100]
    circle = {"radius": 0.41, "angles": angles}
    points = 0.41 * np.array([[np.cos(a), np.sin(a), 0] for a in np.radians(angles)])
    platform = {"radius": 0.22, "angles": [210, 270, 330, 30, 90, 150]}
    models = [
        new_model(load_mechanism("stewart42", base=base, platform=platform, height=0.6))
        for base in (circle, points.tolist())
    ]
    np.testing.assert_allclose(models[0].values, models[1].values, atol=1e-12)
    for model in models:
        assert model.mechanism.home.joints == (0.0,) * 6
        home = np.array([model.mechanism.home.configuration])
        [closure, *_] = model.structure.closure_batch(home, np.zeros((1, 0)), model.values)
        np.testing.assert_allclose(closure, 0, atol=1e-12)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"base": [[0.1, 0.2, 0.0]]}, "base has the shape (1, 3); expected six points"),
        ({"base": {"radius": 0.4}}, "base: 'angles'; expected six points"),
        ({"height": "low"}, "height 'low'"),
        ({"limits": [0.3, 0.1]}, "expected the lower limit first"),
        ({"retracted": -1.0}, "expected legs longer than 0 m"),
    ],
)
def test_a_wrong_drawing_of_a_hexapod_is_refused(options, words):
    with pytest.raises(ModelError, match=re.escape(words)):
        load_mechanism("stewart42", **options)


def test_readings_may_be_whole_lengths_of_the_legs():
    whole = load_mechanism("stewart42", retracted=0.0, limits=[0.1, 0.6])
    C, B = (
        np.array(
            [
                [
                    whole.parameters.nominal[whole.parameters.index_of(f"leg{i}.{p}_{a}")]
                    for a in "xyz"
                ]
                for i in range(1, 7)
            ]
        )
        for p in "CB"
    )
    lengths = np.linalg.norm(B + whole.home.position - C, axis=1)
    np.testing.assert_allclose(whole.home.joints, lengths, atol=1e-12)


@pytest.mark.parametrize("height", [0.3, 0.6])
def test_a_hexapod_from_a_drawing_can_move_to_both_sides_of_home(height):
    """Its readings are relative to home, which must not be at a limit."""
    drawn = load_mechanism(
        "stewart42", base={"radius": 0.25, "angles": [0, 20, 120, 140, 240, 260]}, height=height
    )
    assert drawn.home.joints == (0.0,) * 6
    low, high = drawn.joint_limits[0]
    assert low == pytest.approx(-high)
    assert high == pytest.approx(0.1 * height / 0.3)
    measured = load_mechanism("stewart42", retracted=0.25)
    assert measured.joint_limits[0] == (0.0, 0.2)


@pytest.mark.parametrize("name", ["five_bar", "slider_crank"])
def test_zeros_of_encoders_have_a_tolerance_of_their_own_unit(name):
    """A degree of an angle, or a millimetre of a length: of these, no one stands for the other."""
    model = new_model(name)
    zeros = [one for one in model.table if one.name.split(".")[-1] == "q0"]
    assert zeros
    for one in zeros:
        assert one.tolerance == pytest.approx(np.radians(1) if one.unit == "rad" else 1e-3)
