"""Every mechanism of the package against the robot built another way.

The virtual robots know points, rods and lines; the package knows closures. Both get the same
numbers, strayed from nominal by their tolerances, and must agree at poses all over the workspace.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
import virtual_paper as vp
import virtual_serial as vs
import virtual_shelf as vf
import virtual_small as vm
from marks import keep

from parallel_cal.base.rotation import quaternion_to_matrix, rotation_vector
from parallel_cal.kinematics import solving
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.model import new_model
from parallel_cal.model.shelf import list_plugins, load_mechanism
from parallel_cal.virtual import argos as va
from parallel_cal.virtual import stewart as vt
from parallel_cal.virtual.linear_delta import LinearDelta
from parallel_cal.virtual.robot import turn

SHELF = list_plugins("mechanisms")
SIX_LINES = [(1, 1, 2), (-1, 1, 2), (0, -1.4, 2.1), (1.1, -1, 0.1), (-1, -1, 0), (0, 1.5, -0.1)]
# Waist, two parallel arms, and three wrist axes through one point; the last frame is anywhere.
SIX_R = [
    {"axes": "parallel", "a": 0.1},
    {"joint": "R", "axes": "perpendicular", "d": 0.66, "alpha": -np.pi / 2},
    {"joint": "R", "axes": "parallel", "a": 0.43},
    {"joint": "R", "axes": "perpendicular", "a": 0.02, "alpha": -np.pi / 2},
    {"joint": "R", "axes": "perpendicular", "d": 0.43, "alpha": np.pi / 2},
    {"joint": "R", "axes": "perpendicular", "alpha": -np.pi / 2},
    {"joint": "R", "axes": "frame", "d": 0.05},
]


@dataclass(frozen=True)
class Case:
    """A mechanism with its options, and how to build the same robot from its parameters."""

    name: str
    build: Any
    options: Any = ()

    def __str__(self) -> str:
        return self.name + (f" with {', '.join(dict(self.options))}" if self.options else "")


# Home of a five-bar whose tool is beyond the rods' hinge: pose, readings and angle of its rod.
BEYOND = ((0.0184, 0.249, 0.0), (2 * np.pi / 3, np.pi / 3), 0.841)
# Two arms on one axis: the forearm of 0.14 m leads back over its elbow. Its tail is the left crank.
MORGAN = (
    ((-0.2022, 0.1282, 0.0), (3.2 + np.pi, 2.0), 3.2 + np.pi),
    (
        *(("base", 0.0), ("crank", [0.03, 0.15]), ("rod", [0.15, 0.03])),
        *(("tool", [-0.17, 0.0]), ("carrier", "right"), ("home", [3.2 + np.pi, 2.0])),
        ("below", True),
    ),
)
# A plotter that carries its motors, lines below its wheels, and a ring on which it does not tilt.
CARRIAGE = (
    ("anchors", [[-0.65, 0.1], [0.65, 0.0]]),
    ("mounts", [[-0.04, 0.03], [0.05, 0.02]]),
    *(("below", 0.03), ("radius", 0.0063), ("wheels", "sled"), ("standoff", 0.041)),
    ("home", [0.05, -0.4]),
)
CASES = [
    Case("argos27", va.Argos),
    Case("argos9", lambda p: va.Argos(va.spherical(p))),
    Case("argos_nominal", lambda p: va.Argos(va.spherical(p))),
    Case("stewart42", vt.Stewart),
    Case("planar_stewart", vt.PlanarStewart),
    Case("scara16", vs.Serial),
    Case("slider_crank", vm.SliderCrank),
    Case("rssr", vm.Rssr),
    Case("five_bar", vm.FiveBar),
    Case("five_bar", lambda p: vm.FiveBarWithTool(p, 0, *BEYOND), (("tool", [0.05, 0.02]),)),
    Case("five_bar", lambda p: vm.FiveBarWithTool(p, 1, *MORGAN[0]), MORGAN[1]),
    Case("deltesian", vm.Deltesian),
    Case("cable", vm.Cable),
    Case(
        "cable",
        lambda p: vm.Cable(p, (1, 1, 2, 2, 3, 3)),
        (("anchors", SIX_LINES), ("spools", [1, 1, 2, 2, 3, 3])),
    ),
    Case("linear_delta", LinearDelta),
    Case("linear_delta", lambda p: LinearDelta(p, 0.3), (("inclination", 0.3),)),
    Case("parallelogram", vp.Parallelogram),
    Case("parallelogram_simple", vp.SimpleParallelogram),
    Case("delta51", vp.Delta51),
    Case("stewart_rss", vf.StewartRss),
    Case("hexaglide", vf.Hexaglide),
    Case("ankle_2rsu", vf.Ankle2Rsu),
    Case("ankle_2rsu", lambda p: vf.Ankle2Rsu(p, "roll"), (("first", "roll"),)),
    Case("quattro", vf.Quattro),
    Case("quattro", vf.Quattro, (("gear", 2.0),)),
    Case("tripod_prs", vf.TripodPrs),
    Case("tripod_prs", lambda p: vf.TripodPrs(p, 0.3), (("inclination", 0.3),)),
    Case("plate_rrs", vf.PlateRrs),
    Case("tripod_struts", vf.TripodStruts),
    Case("pentapod", vf.Pentapod),
    Case("hanging_sled", vf.HangingSled),
    Case("hanging_sled", lambda p: vf.HangingSled(p, over=False), (("over", False),)),
    Case("hanging_sled", lambda p: vf.HangingSled(p, "sled", home=(0.05, -0.4)), CARRIAGE),
    Case("palletizer", vf.Palletizer),
    Case("palletizer", lambda p: vf.Palletizer(p, False), (("flange", False),)),
]
ELSEWHERE = {"delta54", "delta24", "delta_nominal", "serial", "chain"}  # test_delta.py; below
each_case = pytest.mark.parametrize("case", CASES, ids=str)
# Every parameter is strayed in each of them, and 100 poses are tried.
each_seed = pytest.mark.parametrize(
    "seed",
    [pytest.param(k, marks=pytest.mark.slow if k else pytest.mark.wide) for k in range(3)],
)


def strayed(mechanism, seed):
    """A model whose every parameter is off by its tolerance's size."""
    model = new_model(mechanism)
    draw = np.random.default_rng(seed).standard_normal(len(model.values))
    return model.with_values(model.values + model.table.tolerance * draw)


def wanted(mechanism, n, seed):
    """Poses all over the workspace (m, rotation vectors); what is not controlled is as at home."""
    home = rotation_vector(quaternion_to_matrix(mechanism.home.quaternion))
    rows = np.tile([*mechanism.home.position, *home], (n, 1))
    rows[:, mechanism.controlled] = mechanism.sample(n, np.random.default_rng(seed))
    return rows[:, :3], turn(rows[:, 3:])


def phi(model, q, r, R):
    configuration = np.concatenate([q, r, R.ravel()])
    return np.array(model.structure.closure(configuration, np.zeros(0), model.values)[0]).ravel()


def largest_gap(model, joints, positions, rotations):
    rows = zip(joints, positions, rotations, strict=True)
    return max(np.abs(phi(model, *row)).max() for row in rows)


def situation(case, seed, n=100):
    """A strayed model, and joints and poses at which its virtual twin closes."""
    mechanism = load_mechanism(case.name, **dict(case.options))
    model = strayed(mechanism, seed)
    robot = case.build(model.table.mapping(model.values))
    position, rotation = wanted(mechanism, n, seed)
    given = (position,) if isinstance(robot, vs.Serial) else (position, rotation)
    return model, robot.inverse(*given)


@each_case
@each_seed
def test_closure_is_zero_where_the_virtual_robot_closes(case, seed):
    model, poses = situation(case, seed)
    assert largest_gap(model, *poses) < 1e-12


@each_case
@each_seed
def test_direct_and_inverse_problem_are_solved_as_the_virtual_robot_stands(case, seed):
    model, (q, r, R) = situation(case, seed)
    poses, joints = Kinematics(model).direct(q), Kinematics(model).inverse(r, R)
    np.testing.assert_allclose(poses.position, r, atol=1e-9)
    np.testing.assert_allclose(poses.rotation, R, atol=1e-9)
    np.testing.assert_allclose(joints.joints, q, rtol=1e-12, atol=1e-9)
    np.testing.assert_allclose(joints.position, r, atol=1e-9)
    np.testing.assert_allclose(joints.rotation, R, atol=1e-9)


CLOSED = [  # where the documents give one, or geometry at once does
    *[("direct", n) for n in ("slider_crank", "rssr", "parallelogram", "parallelogram_simple")],
    *[("direct", n) for n in ("scara16", "cable", "five_bar", "tripod_struts")],
    *[("inverse", n) for n in ("slider_crank", "rssr", "argos_nominal", "argos9")],
    *[("inverse", n) for n in ("stewart42", "planar_stewart", "cable", "five_bar")],
    *[("inverse", n) for n in ("stewart_rss", "hexaglide", "quattro", "tripod_struts")],
]


@pytest.mark.parametrize(("problem", "name"), CLOSED)
def test_a_closed_form_answers_as_the_virtual_robot_stands(problem, name):
    case = next(case for case in CASES if case.name == name)
    model, (q, r, R) = situation(case, 4, n=20)
    if problem == "direct":
        found = solving.direct(model, q, {}, solver="closed_form")
    else:
        found = solving.inverse(model, r, R, {}, solver="closed_form")
    np.testing.assert_allclose(found.position, r, atol=1e-9)
    np.testing.assert_allclose(found.rotation, R, atol=1e-9)
    np.testing.assert_allclose(found.joints, q, rtol=1e-12, atol=1e-9)


# An arm, rods, lines, a plane loop, orientations alone. The closures of the others are compared
# with every parameter strayed (above).
KINDS = ("scara16", "stewart_rss", "cable", "five_bar", "argos9")


@pytest.mark.wide
@pytest.mark.parametrize("case", keep(CASES, *(c for c in CASES if str(c) in KINDS)), ids=str)
def test_every_parameter_alone_moves_both_robots_alike(case):
    """One parameter at a time, ten tolerances more: no error hides behind another."""
    model, (q, r, R) = situation(case, 1, n=3)
    for i, parameter in enumerate(model.table):
        more = np.eye(len(model.values))[i] * 10 * parameter.tolerance
        other = model.with_values(model.values + more)
        twin = case.build(other.table.mapping(other.values))
        given = (r,) if isinstance(twin, vs.Serial) else (r, R)
        there = twin.inverse(*given, start=q)
        felt = max(np.abs(a - b).max() for a, b in zip(there, (q, r, R), strict=True)) > 1e-9
        assert largest_gap(other, *there) < 1e-12, parameter.name
        assert (largest_gap(other, q, r, R) > 1e-10) == felt, parameter.name


def name_of(case):
    """A case's name, whether it is marked or not."""
    return (case if isinstance(case, Case) else case.values[0]).name


@pytest.mark.parametrize("seed", range(3))
def test_the_papers_delta_agrees_but_for_its_tilted_axes(seed):
    model = strayed("delta51", seed)
    tilt = [i for i, name in enumerate(model.table.names) if ".beta_" in name]
    straight = model.values.copy()
    straight[tilt] = 0.0
    position, rotation = wanted(model.mechanism, 100, seed)
    for values, close in ((straight, 1e-12), (model.values, 1e-6)):
        exact = model.with_values(values)
        twin = vp.Delta51(exact.table.mapping(values))
        assert largest_gap(exact, *twin.inverse(position, rotation)) < close


def test_every_mechanism_of_the_shelf_has_a_virtual_twin():
    assert set(SHELF) <= {name_of(case) for case in CASES} | ELSEWHERE


@pytest.mark.parametrize("seed", range(3))
def test_a_six_axis_arm_stands_as_its_homogeneous_matrices_say(seed):
    model = strayed(load_mechanism("serial", links=SIX_R), seed)
    kinds = [("base", "")] + [(f"link{i}", "R") for i in range(1, 7)]
    twin = vs.Serial(model.table.mapping(model.values), kinds)
    q = np.random.default_rng(seed).uniform(-0.8, 0.8, (100, 6))
    r, R = twin.forward(q)
    assert largest_gap(model, q, r, R) < 1e-12
    answer = Kinematics(model).direct(q)
    np.testing.assert_allclose(answer.position, r, atol=1e-12)
    np.testing.assert_allclose(answer.rotation, R, atol=1e-12)
    back = twin.forward(Kinematics(model).inverse(r[:20], R[:20]).joints)
    np.testing.assert_allclose(back[0], r[:20], atol=1e-9)


def test_nominal_values_of_the_argos_are_those_of_table_5_21():
    table = new_model("argos27").table
    assert table.mapping(table.nominal) == pytest.approx(va.TABLE_5_21)


def test_nominal_values_of_the_parallelogram_are_those_of_table_2():
    table = new_model("parallelogram").table
    assert table.mapping(table.nominal) == pytest.approx(vp.TABLE_2)


def test_nominal_values_of_the_slider_crank_are_those_of_equation_5_8():
    table = new_model("slider_crank").table
    assert table.mapping(table.nominal) == pytest.approx({"a": 0.08, "b": 0.05, "q0": 0.0})
