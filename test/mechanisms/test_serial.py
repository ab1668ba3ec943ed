"""Serial arms: hand-worked numbers, plain homogeneous matrices, the inverse problem, refusals."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import parameter_counts
import pytest
import yaml

from parallel_cal.base.errors import ModelError
from parallel_cal.base.rotation import quaternion_to_matrix, rotation_matrix
from parallel_cal.identification import completeness
from parallel_cal.identification.observations import observe
from parallel_cal.identification.prediction_errors import errors
from parallel_cal.kinematics.all_solutions import inverse_all
from parallel_cal.kinematics.kinematics import Kinematics, Status
from parallel_cal.model.file.modelfile import read_model, write_model
from parallel_cal.model.mechanism import Home, Workspace
from parallel_cal.model.model import new_model
from parallel_cal.model.shelf import load_mechanism
from parallel_cal.planning.plan import plan
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.recordings.simulate import with_noise

QUARTER = np.pi / 2

# An arm of two joints with one link of every kind, in whole numbers.
CORNER = [
    {"joint": None, "free": ["theta", "d", "a", "b", "alpha", "beta"], "a": 1, "b": 2, "d": 3},
    {"joint": "R", "free": ["theta", "d", "a", "b", "alpha", "beta"], "a": 4},
    {"joint": "P", "free": ["theta", "d", "a", "b", "alpha", "beta"], "d": 5},
]
# Changed number -> position of {P}, worked on paper. Straight: (1,2,3) + (4,0,0) + (0,0,5).
# A quarter turn about z takes (5,2,8) to (-2,5,8); about x, with (4,0,5) behind it, to
# (1,2,3) + (4,-5,0); about y to (1,2,3) + (5,0,-4).
BY_HAND = {
    "": (0, (5, 2, 8)),
    "joint1": (QUARTER, (1, 6, 8)),
    "joint2": (2, (5, 2, 10)),
    "base.theta": (QUARTER, (-2, 5, 8)),
    "base.d": (4, (5, 2, 9)),
    "base.a": (2, (6, 2, 8)),
    "base.b": (3, (5, 3, 8)),
    "base.alpha": (QUARTER, (5, -3, 3)),
    "base.beta": (QUARTER, (6, 2, -1)),
    "link1.theta": (QUARTER, (1, 6, 8)),
    "link1.d": (1, (5, 2, 9)),
    "link1.a": (5, (6, 2, 8)),
    "link1.b": (1, (5, 3, 8)),
    "link1.alpha": (QUARTER, (5, -3, 3)),
    "link1.beta": (QUARTER, (10, 2, 3)),
    "link2.d": (6, (5, 2, 9)),
    "link2.a": (1, (6, 2, 8)),
    "link2.b": (1, (5, 3, 8)),
    "link2.theta": (QUARTER, (5, 2, 8)),
    "link2.alpha": (QUARTER, (5, 2, 8)),
    "link2.beta": (QUARTER, (5, 2, 8)),
}
# Those that turn {P}: rows are where its axes point, from the right hand.
X_TO_Y = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
Y_TO_Z = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
Z_TO_X = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]
TURNS = {"theta": X_TO_Y, "alpha": Y_TO_Z, "beta": Z_TO_X, "joint1": X_TO_Y}

DEGREE = np.pi / 180
PUMA = {
    "links": [
        {"joint": None, "axes": "coincident"},
        {"joint": "R", "axes": "perpendicular", "alpha": -90 * DEGREE, "d": 0.67},
        {"joint": "R", "axes": "parallel", "a": 0.43},
        {"joint": "R", "axes": "perpendicular", "alpha": 90 * DEGREE, "a": -0.02, "d": 0.15},
        {"joint": "R", "axes": "perpendicular", "alpha": -90 * DEGREE, "d": 0.43},
        {"joint": "R", "axes": "perpendicular", "alpha": 90 * DEGREE},
        {"joint": "R", "d": 0.06},
    ],
    "home": (0.1, 0.6, -0.4, 0.2, 0.9, -0.3),
}


def screw(theta, d, a, alpha, beta):
    """Eq. 3.6 as five 4 x 4 matrices, written down once more, in NumPy."""

    def turn(axis, angle):
        c, s = np.cos(angle), np.sin(angle)
        i, j = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
        T = np.eye(4)
        T[i, i], T[i, j], T[j, i], T[j, j] = c, -s, s, c
        return T

    along_z, along_x = np.eye(4), np.eye(4)
    along_z[2, 3], along_x[0, 3] = d, a
    return turn("z", theta) @ along_z @ along_x @ turn("x", alpha) @ turn("y", beta)


def scara_by_matrices(p, q):
    """Eq. 3.7 with table 3.7."""

    def link(name, turn=0.0, rise=0.0):
        k = {n: p.get(f"{name}.{n}", 0.0) for n in ("theta", "d", "a", "alpha", "beta")}
        return screw(k["theta"] + turn, k["d"] + rise, k["a"], k["alpha"], k["beta"])

    base, tool = link("base"), link("platform")
    return base @ link("link1", q[0]) @ link("link2", q[1]) @ link("link3", rise=q[2]) @ tool


def off_nominal(name, seed, size=1.0, **options):
    mechanism = load_mechanism(name, **options)
    t = mechanism.parameters
    error = size * t.tolerance * np.random.default_rng(seed).standard_normal(len(t))
    return new_model(mechanism).with_values(t.nominal + error)


def phi(model, q, r, R):
    x = np.concatenate([q, r, np.asarray(R, dtype=float).ravel()])
    return np.array(model.structure.closure(x, [], model.values)[0]).ravel()


@pytest.mark.parametrize("changed", BY_HAND, ids=lambda name: name or "nothing")
def test_every_number_moves_the_platform_as_paper_and_pencil_say(changed):
    value, position = BY_HAND[changed]
    arm = load_mechanism("serial", links=CORNER)
    q = [value if changed == joint else 0.0 for joint in arm.joints]
    model = new_model(arm, {changed: value} if "." in changed else {})
    rotation = TURNS.get(changed.split(".")[-1], np.eye(3))
    assert phi(model, q, position, rotation) == pytest.approx(np.zeros(6), abs=1e-12)


def test_the_closure_is_the_distance_in_metres_and_the_angle_in_radians():
    model = new_model(load_mechanism("serial", links=CORNER))
    turned = [[1, 0, 0], [0, 0.6, -0.8], [0, 0.8, 0.6]]  # about x, with tan(angle / 2) = 1/2
    rows = phi(model, [0, 0], [5.1, 2.2, 8.3], turned)
    assert rows == pytest.approx([0.1, 0.2, 0.3, 1.0, 0.0, 0.0], abs=1e-12)
    # Counted about the axes of {P}: the same turn after the arm has swung by a quarter.
    rows = phi(model, [QUARTER, 0], [1, 6, 8], np.array(X_TO_Y) @ turned)
    assert rows == pytest.approx([0, 0, 0, 1.0, 0.0, 0.0], abs=1e-12)
    half_a_turn = phi(model, [0, 0], [5, 2, 8], np.diag([1.0, -1, -1]))
    assert not np.isfinite(half_a_turn).all()  # and not zero: the platform is the wrong way up


def test_table_3_5_gives_each_topology_its_parameters():
    names = load_mechanism("serial", **PUMA).parameters.names
    assert [n for n in names if n.startswith("base")] == [
        "base.a",
        "base.b",
        "base.alpha",
        "base.beta",
    ]
    assert [n for n in names if n.startswith("link1")] == [
        "link1.theta",
        "link1.d",
        "link1.a",
        "link1.alpha",
    ]
    assert [n for n in names if n.startswith("link2")] == [
        "link2.theta",
        "link2.a",
        "link2.alpha",
        "link2.beta",
    ]
    assert len(names) == 4 * 6 + 6  # eq. 3.1


def test_a_slide_gets_only_its_direction():
    links = [
        {"joint": None, "axes": "perpendicular", "alpha": 1.5},
        {"joint": "P", "axes": "perpendicular", "alpha": 1.5},
        {"joint": "P", "axes": "parallel"},
        {"joint": "P"},
    ]
    arm = load_mechanism("serial", links=links)
    names = [n.split(".")[1] for n in arm.parameters.names]
    assert names == [*("theta", "alpha"), *("theta", "alpha"), *("alpha", "beta")] + [
        "theta",
        "d",
        "a",
        "b",
        "alpha",
        "beta",
    ]
    assert len(names) == 2 * 3 + 6
    assert set(arm.joint_units) == {"m"}


@pytest.mark.parametrize("seed", range(3))
def test_the_scara_is_a_product_of_homogeneous_matrices(seed):
    model = off_nominal("scara16", seed, size=5)
    numbers = model.table.mapping(model.values)
    low, high = np.array(model.mechanism.joint_limits).T
    q = np.random.default_rng(seed).uniform(low, high, (50, 3))
    found = Kinematics(model).direct(q)
    expected = np.array([scara_by_matrices(numbers, row) for row in q])
    assert found.ok.all()
    assert np.abs(found.position - expected[:, :3, 3]).max() < 1e-14
    assert np.abs(found.rotation - expected[:, :3, :3]).max() < 1e-13


def test_the_nominal_scara_by_hand():
    # First axis at (-0.25, 0); joint 1 at 0 points along +x; elbow a quarter turn to the left.
    s = Kinematics(new_model("scara16")).direct([0, QUARTER, 0.03])
    assert s.position == pytest.approx([-0.25 + 0.20, 0.16, 0.03], abs=1e-15)
    # x of {P} follows the forearm (+y), y of {P} is up, z of {P} is their cross product.
    assert s.rotation == pytest.approx(np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]]), abs=1e-15)


@pytest.mark.parametrize("size", [0, 1])
def test_scara_round_trip_over_the_workspace(size):
    model = off_nominal("scara16", 4, size)
    position = model.mechanism.sample(300, np.random.default_rng(0))
    kinematics = Kinematics(model)
    inverse = kinematics.inverse(position)
    direct = kinematics.direct(inverse.joints)
    assert inverse.ok.all()
    assert direct.ok.all()
    assert np.abs(direct.position - position).max() < 1e-12
    assert np.abs(direct.rotation - inverse.rotation).max() < 1e-12


def test_the_scara_reaches_a_point_with_its_elbow_on_either_side():
    model = off_nominal("scara16", 1)
    both = inverse_all(model, [0.02, 0.03, 0.01])
    assert len(both) == 2
    assert both.status[0] == Status.CONVERGED
    assert both.status[1] == Status.OUTSIDE_LIMITS  # the elbow's stop is on that side
    assert both.joints[0, 1] == pytest.approx(-both.joints[1, 1], abs=0.1)


def test_puma_round_trip_in_six_coordinates():
    model = off_nominal("serial", 3, **PUMA)
    kinematics, home = Kinematics(model), np.array(model.mechanism.home.joints)
    q = home + np.random.default_rng(2).uniform(-0.2, 0.2, (50, 6))
    pose = kinematics.direct(q)
    back = kinematics.inverse(pose.position, pose.rotation)
    assert back.ok.all()
    assert np.abs(back.joints - q).max() < 1e-11


def test_a_puma_has_several_ways_to_one_pose():
    model = off_nominal("serial", 3, **PUMA)
    kinematics = Kinematics(model)
    pose = kinematics.direct(model.mechanism.home.joints)
    ways = inverse_all(kinematics.model, pose.position, pose.rotation)
    assert len(ways) == 8  # shoulder, elbow, wrist
    for way in ways:
        again = kinematics.direct(way.joints)
        assert np.abs(again.position - pose.position).max() < 1e-9


def test_no_way_to_a_pose_is_wound_up_by_whole_turns():
    """Within half a turn of home, or a turn off where only there the joint's stops allow it."""
    model = off_nominal("serial", 3, **PUMA)
    kinematics, home = Kinematics(model), np.array(model.mechanism.home.joints)
    low, high = np.array(model.mechanism.joint_limits).T
    for q in home + np.random.default_rng(6).uniform(-0.3, 0.3, (5, 6)):
        pose = kinematics.direct(q)
        ways = inverse_all(kinematics.model, pose.position, pose.rotation)
        inside = (ways.joints >= low) & (ways.joints <= high)
        assert np.abs(ways.joints - home)[~inside].max(initial=0) <= np.pi
        for turn in (-2 * np.pi, 2 * np.pi):
            elsewhere = (ways.joints + turn >= low) & (ways.joints + turn <= high)
            assert not (elsewhere & ~inside).any()
        expected = np.where(inside.all(axis=1), Status.CONVERGED, Status.OUTSIDE_LIMITS)
        assert ways.status.tolist() == expected.tolist()


def test_a_wrist_that_was_flipped_when_measured_is_no_joint_error():
    """The same pose is reached with the wrist turned over: joint 4 half a turn further, and read
    a whole turn further by an encoder that counts turns."""
    model, q = off_nominal("serial", 3, **PUMA), np.array(PUMA["home"])
    flipped = q + [0, 0, 0, np.pi, -2 * q[4], np.pi]
    flipped = flipped + 2 * np.pi * np.array([[0] * 6, [0, 0, 0, -1, 0, 0], [0, 0, 0, 1, 0, -1]])
    pose = Kinematics(model).direct(flipped)
    accuracy = np.tile(1e-10 * np.eye(6), (3, 1, 1))
    data = Dataset.from_arrays(
        model.joints,
        flipped,
        pose.position,
        pose.rotation,
        pose_cov=accuracy,
        joint_sigma=[1e-4] * 6,
    )
    assert np.abs(errors(model, observe(model, data)).joint).max() < 1e-9


DOCS = (Path(__file__).parents[2] / "docs/serial_links.md").read_text(encoding="utf-8")
DESCRIBED = [yaml.safe_load(block) for block in re.findall(r"```yaml\n(.*?)```", DOCS, flags=re.S)]


def test_the_puma_of_the_documentation_is_a_puma():
    """Paul's zero position: a2 + a3 in front, d3 aside, d4 and the flange above (mm)."""
    arm = load_mechanism("serial", links=DESCRIBED[0])
    found = Kinematics(new_model(arm)).direct(np.zeros(6))
    assert found.position == pytest.approx([0.4318 + 0.0203, -0.15005, 0.4318 + 0.056], abs=1e-15)
    assert found.rotation == pytest.approx(np.eye(3), abs=1e-15)
    assert len(arm.parameters) == parameter_counts.serial(R=6, P=0)


def test_the_scara_of_the_documentation_moves_as_model_16_and_is_complete():
    arm = load_mechanism("serial", links=DESCRIBED[1], home=(-0.7, 1.6, 0.0))
    q = np.random.default_rng(0).uniform([-1, 0.3, -0.1], [1, 2.5, 0.1], (20, 3))
    found, known = (Kinematics(new_model(m)).direct(q) for m in (arm, "scara16"))
    assert np.abs(found.position - known.position).max() < 1e-15
    assert completeness.compute_completeness(arm).rank == parameter_counts.serial(R=2, P=1)


def test_an_arm_is_described_in_its_model_file(tmp_path):
    model = off_nominal("serial", 0, **PUMA)
    write_model(model, tmp_path / "puma.yaml")
    again = read_model(tmp_path / "puma.yaml")
    assert (again.values == model.values).all()
    assert again.mechanism.home == model.mechanism.home
    q = np.array(PUMA["home"]) + 0.1
    assert (Kinematics(again).direct(q).position == Kinematics(model).direct(q).position).all()


def arm_towards(turn):
    """A PUMA whose last link is turned so that home has the rotation vector `turn`."""
    mechanism = load_mechanism("serial", **PUMA)
    R = rotation_matrix(np.array([turn]))[0]
    # Euler angles of the tool: R_home Rz Rx Ry = R
    tool = quaternion_to_matrix(mechanism.home.quaternion).T @ R
    alpha = np.arcsin(tool[2, 1])
    theta = np.arctan2(-tool[0, 1], tool[1, 1])
    beta = np.arctan2(-tool[2, 0], tool[2, 2])
    *others, last = PUMA["links"]
    last = {**last, "theta": theta, "alpha": alpha, "beta": beta}
    free = ["theta", "d", "a", "b"]
    return load_mechanism("serial", **{**PUMA, "links": [*others, {**last, "free": free}]})


# A tool that points down is half a turn about a horizontal axis from {B}: there the rotation
# vector of a pose jumps to the other side.
TURNS_OF_HOME = [(0.0, 0.0, 0.0), (1.8, 1.4, 1.0), (np.pi, 0.0, 0.0), (0.0, -np.pi + 0.05, 0.0)]


@pytest.mark.parametrize("turn", TURNS_OF_HOME)
def test_the_workspace_of_an_arm_is_around_its_home(turn):
    mechanism = arm_towards(turn)
    low, high = np.array(mechanism.workspace.low), np.array(mechanism.workspace.high)
    home = np.array([*mechanism.home.position, *mechanism.home.rotation_vector])
    assert rotation_matrix(home[None, 3:])[0] == pytest.approx(
        rotation_matrix(np.array([turn]))[0], abs=1e-12
    )
    assert (low + high) / 2 == pytest.approx(home, abs=1e-12)
    drawn = mechanism.sample(200, np.random.default_rng(0))
    assert mechanism.controlled_coordinates(*mechanism.poses(drawn)) == pytest.approx(drawn)


@pytest.mark.wide
@pytest.mark.parametrize("turn", TURNS_OF_HOME)
def test_poses_are_planned_for_an_arm_whatever_its_orientation(turn):
    model = with_noise(new_model(arm_towards(turn)))
    assert len(plan(model, 40, free=["link2.*"], seed=0, pool=100).poses) == 40


def test_a_pose_between_both_sides_of_half_a_turn_is_inside_the_workspace():
    """Rotations by pi + 0.1 and pi - 0.1 about x differ by 0.2 rad, their vectors by 6 rad."""
    mechanism = arm_towards((np.pi - 0.02, 0.0, 0.0))
    sides = rotation_matrix(np.array([[np.pi - 0.1, 0, 0], [np.pi + 0.1, 0, 0]]))
    at = np.tile(mechanism.home.position, (2, 1))
    found = mechanism.controlled_coordinates(at, sides)[:, 3:]
    assert found == pytest.approx(np.array([[np.pi - 0.1, 0, 0], [np.pi + 0.1, 0, 0]]), abs=1e-12)
    # A workspace on the other side, with the same rotations, has the other vectors.
    mechanism.workspace = Workspace(
        (*mechanism.workspace.low[:3], -np.pi - 0.2, -0.2, -0.2),
        (*mechanism.workspace.high[:3], -np.pi + 0.2, 0.2, 0.2),
    )
    found = mechanism.controlled_coordinates(at, sides)[:, 3:]
    assert found[:, 0] == pytest.approx([-np.pi - 0.1, -np.pi + 0.1], abs=1e-12)


def test_an_older_file_with_orientations_around_none_gets_those_around_home(tmp_path):
    """Until version 1.0.0 the default workspace had the orientations -0.2 to 0.2 rad, wherever
    the arm works; a workspace of the owner's own is read as it is written."""
    model = new_model(arm_towards((1.8, 1.4, 1.0)))
    file = tmp_path / "arm.yaml"
    box = model.mechanism.workspace

    def read_with(low, high):
        model.mechanism.workspace = Workspace((*box.low[:3], *low), (*box.high[:3], *high))
        write_model(model, file)
        return read_model(file).mechanism.workspace

    older = read_with((-0.2, -0.2, -0.2), (0.2, 0.2, 0.2))
    assert older.low == pytest.approx(box.low)
    assert older.high == pytest.approx(box.high)
    own = (1.0, 1.0, 0.5), (2.0, 2.0, 1.5)
    found = read_with(*own)
    assert (found.low[3:], found.high[3:]) == own
    # A home that the box contains needs no other box.
    model.mechanism.home = replace(model.mechanism.home, quaternion=Home(()).quaternion)
    assert read_with((-0.2, -0.2, -0.2), (0.2, 0.2, 0.2)).low[3:] == (-0.2, -0.2, -0.2)


@pytest.mark.parametrize(
    ("links", "words"),
    [
        ([{"joint": None}], "at least one link"),
        ([{"joint": "S"}], "expected R, P"),
        ([{"joint": "R", "lenght": 1}], "unknown key"),
        ([{"joint": "R", "axes": "parallel"}, {"joint": "R"}], "coincide"),
        ([{"joint": "R", "axes": "perpendicular", "a": 1}, {"joint": "R"}], "parallel"),
        ([{"joint": "R", "axes": "skew"}, {"joint": "R"}], "expected perpendicular"),
        ([{"joint": "R", "alpha": QUARTER}], "same rotation"),
        ([{"joint": "R", "free": ["gamma"]}], "gamma"),
        ([{"joint": "R", "free": "alpha"}], "expected a list"),
        ([{"joint": "R", "a": "30 mm"}], "link1: a is '30 mm', expected a number in m"),
        ([{"joint": "R", "theta": np.inf}], "link1: theta is inf, expected a number in rad"),
        ([{"joint": "R", "low": "-90"}], "low is '-90', expected a number in rad or m"),
        ([3], r"links \[3\], expected a list such as"),
        ({"joint": "R"}, "expected a list such as"),
        (3, "links 3, expected a list such as"),
    ],
)
def test_links_that_make_no_good_model_are_refused_with_the_reason(links, words):
    with pytest.raises(ModelError, match=words):
        load_mechanism("serial", links=links)


@pytest.mark.wide
def test_a_scara_errs_more_than_a_delta_of_the_same_tolerances():
    """Section 3.6: 0.5 mm and 0.2 mm on the mean for one draw of each; here medians of many."""
    from bench.documents.error_propagation import ROBOTS, milling

    means = []
    for robot in ROBOTS:
        rng, points = np.random.default_rng(1), robot.plane(0.18, 4)
        errors = [milling(robot, robot.true(rng), points) for _ in range(12)]
        means.append(np.median(np.linalg.norm(errors, axis=2).mean(axis=1)))
    scara, delta = means
    assert 0.25e-3 < scara < 0.7e-3
    assert 0.1e-3 < delta < 0.3e-3
    assert scara > 1.5 * delta
