"""The branch of home is kept under any reading, as other constructions of the robots show."""

import ctypes
import re
import subprocess
from pathlib import Path

import numpy as np
import pytest

from parallel_cal.base.errors import ModelError, ModelFileError
from parallel_cal.exporting.targets.c import files
from parallel_cal.kinematics.kinematics import Kinematics, Status
from parallel_cal.kinematics.problem import Problem
from parallel_cal.kinematics.singularity import distances
from parallel_cal.kinematics.solving import direct
from parallel_cal.model.file.modelfile import parse_model
from parallel_cal.model.file.writer import dump_model
from parallel_cal.model.mechanism import Home
from parallel_cal.model.model import new_model
from parallel_cal.model.shelf import load_mechanism

ANGLES = 2 * np.pi / 3 * np.arange(3)
RODS = 0.34  # m, of the rotary Delta below


def three_spheres(centres, radius):
    """Both points at one distance from three centres, the one on the side of their normal first;
    None if there is none. Solved by least squares, not by the package's formula."""
    a, b = centres[1] - centres[0], centres[2] - centres[0]
    A = np.array([a, b])
    foot = centres[0] + np.linalg.lstsq(A, [a @ a / 2, b @ b / 2], rcond=None)[0]
    height = radius**2 - np.sum((foot - centres[0]) ** 2)
    if height < 0:
        return None
    normal = np.cross(a, b) / np.linalg.norm(np.cross(a, b))
    return foot + np.sqrt(height) * normal, foot - np.sqrt(height) * normal


def elbows(q, radius, arm):
    """Elbows (3, 3) of a rotary Delta, shifted inwards by the platform's radius."""
    out = radius + arm * np.cos(q)
    return np.column_stack([out * np.cos(ANGLES), out * np.sin(ANGLES), arm * np.sin(q)])


def rotary_delta(home, below=False):
    """A Delta with arms of 250 mm on a base hardly larger than the platform."""
    size = {"base": 0.0876, "platform": 0.08, "arm": 0.25, "rod": RODS, "limits": [-0.5, 2.3]}
    return new_model(load_mechanism("delta24", **size, home=home, below=below))


def readings(model, n, seed=0):
    limits = np.array(model.mechanism.joint_limits)
    return np.random.default_rng(seed).uniform(*limits.T, (n, len(limits)))


@pytest.mark.parametrize("side", [0, 1])
@pytest.mark.parametrize("home", [0.3, 0.8, 1.5])
def test_a_rotary_delta_stays_on_the_side_of_its_elbows_on_which_home_lies(home, side):
    model = rotary_delta(home, below=side == 1)
    q = readings(model, 400)
    found = Kinematics(model).direct(q)
    poses = [three_spheres(elbows(one, 0.0076, 0.25), RODS) for one in q]
    exists = np.array([pose is not None for pose in poses])
    expected = np.array([pose[side] for pose in poses if pose is not None])
    assert exists.sum() > 390
    assert found.ok[exists].all()
    np.testing.assert_allclose(found.position[exists], expected, atol=1e-9)
    assert (found.status[~exists] == Status.UNREACHABLE).all()


def test_iterations_that_end_on_the_other_side_of_a_singularity_do_not_settle():
    """A linear Delta with carriages at one height: its platform hangs below them, and the mirrored
    pose above them solves the closure just as well."""
    model = new_model("linear_delta")  # offset 100 mm, rods 250 mm
    height = np.sqrt(0.25**2 - 0.1**2)
    problem = Problem(model, "direct", compile=False)
    below, above = (
        np.array([0.08, 0.08, 0.08, 0.0, 0.0, z, *np.eye(3).ravel()])
        for z in (0.08 - height, 0.08 + height)
    )
    ends, settled = problem.settle(np.array([below, above]), np.zeros((2, 0)))
    np.testing.assert_allclose(ends[0], below, atol=1e-12)
    closure = model.structure.closure
    np.testing.assert_allclose(closure(above, [], model.values)[0], 0, atol=1e-12)
    assert settled.tolist() == [True, False]


@pytest.mark.wide
def test_a_linear_deltas_platform_stays_below_its_carriages():
    model = new_model("linear_delta")  # offset 100 mm, rods 250 mm
    assert Kinematics(model).direct([0.08] * 3).position[2] == pytest.approx(
        0.08 - np.sqrt(0.25**2 - 0.1**2)
    )
    q = readings(model, 600)
    found = Kinematics(model).direct(q)
    sides = distances(model, found).direct_sign
    [home] = distances(model, Kinematics(model).direct([[0.08] * 3])).direct_sign
    for one, pose, status, side in zip(q, found.position, found.status, sides, strict=True):
        carriages = 0.1 * np.column_stack([np.cos(ANGLES), np.sin(ANGLES), one / 0.1])
        points = three_spheres(carriages, 0.25)
        if points is None:  # the six rods may close with a turned platform, but no path leads there
            assert status in (Status.UNREACHABLE, Status.OTHER_BRANCH)
        elif status != Status.SINGULAR:  # beyond a singularity, the platform could have turned
            assert status == (Status.CONVERGED if side == home else Status.OTHER_BRANCH)
            np.testing.assert_allclose(pose, points[1], atol=1e-8)


def test_a_five_bar_keeps_home_s_side_of_its_elbows_and_its_own_elbows():
    model = new_model("five_bar")  # cranks 100 mm at x = +-50 mm, rods 150 mm
    model.mechanism.home = Home(joints=(np.pi / 3, 2 * np.pi / 3), position=(0.0, 0.2365, 0.0))
    x, y = np.random.default_rng(1).uniform([-0.03, 0.15], [0.03, 0.22], (200, 2)).T
    found = Kinematics(model).inverse(np.column_stack([x, y, 0 * x]))
    for side, q in zip((-1, 1), found.joints.T, strict=True):
        away = np.array([x - 0.05 * side, y])
        distance = np.linalg.norm(away, axis=0)
        bend = np.arccos((0.1**2 + distance**2 - 0.15**2) / (0.2 * distance))
        # Both cranks lean inwards at home, so the elbows are inside the lines from axis to point.
        np.testing.assert_allclose(np.arctan2(*away[::-1]) + side * bend, q, atol=1e-9)


def test_no_stewart_platform_converges_on_the_other_side_of_its_base():
    model = new_model("stewart42")
    found = Kinematics(model).direct(readings(model, 600, seed=3))
    home = distances(model, Kinematics(model).direct([model.mechanism.home.joints]))
    ok = found[found.ok]
    assert len(ok) > 500
    assert (ok.position[:, 2] > 0).all()
    assert (distances(model, ok).direct_sign == home.direct_sign).all()
    other = found[found.status == Status.OTHER_BRANCH]
    assert (other.residual < 1e-10).all()  # they close, and are not to be used
    assert (other.position[:, 2] < 0).any()


def test_a_start_on_another_branch_is_kept_and_a_jump_from_a_start_is_undone():
    model = new_model("delta54")
    kinematics = Kinematics(model)
    above = kinematics.direct([0.5] * 3)
    mirrored = next(p for p in direct(model, np.full(3, 0.5), {}, every=True) if p.position[2] < 0)
    near = kinematics.direct([0.55] * 3, start=mirrored)
    assert near.status == Status.CONVERGED
    assert near.position[2] < 0
    far = kinematics.direct([0.6, 0.4, 0.5], start=above)
    assert far.position[2] > 0


@pytest.mark.wide
@pytest.mark.parametrize("name", ["linear_delta", "stewart42"])
def test_exported_c_answers_as_python_at_any_reading(name, tmp_path: Path):
    model = new_model(name)
    for file, text in files(model, "robot", poses=2).items():
        (tmp_path / file).write_text(text)
    command = "cc -std=c99 -O2 -shared -fPIC robot.c -o robot.so -lm"
    subprocess.run(command.split(), cwd=tmp_path, check=True)
    robot = ctypes.CDLL(str(tmp_path / "robot.so"))
    q, n = readings(model, 300, seed=3), len(model.joints)
    found, statuses = Kinematics(model).direct(q), set()
    for one, expected in zip(q, found, strict=True):
        answer = (ctypes.c_double * (n + 12))()
        status = robot.robot_direct((ctypes.c_double * n)(*one), None, None, answer, None)
        assert status == expected.status
        statuses.add(status)
        if expected.solved:
            np.testing.assert_allclose(answer, expected.configuration.rows, atol=1e-7)
    assert {Status.CONVERGED, Status.OTHER_BRANCH} <= statuses


def test_the_numbers_of_the_statuses_are_those_of_the_ros_message():
    text = (Path(__file__).parents[2] / "msg_defs/msg/Solution.msg").read_text()
    for status in Status:
        assert re.search(rf"^uint8 {status.name} = {int(status)}\b", text, re.M)


def test_a_home_that_the_joints_do_not_lead_to_is_refused_with_the_poses_they_lead_to():
    text = dump_model(new_model("delta24"))
    edited = re.sub(r"(La_x: \{value: )0.119963(.*?nominal: )0.119963", r"\g<1>0.25\g<2>0.25", text)
    edited = re.sub(r"(Lb: \{value: )0.24(.*?nominal: )0.24", r"\g<1>0.34\g<2>0.34", edited)
    assert edited.count("0.34") == 6
    parse_model(edited)  # 0.2 m is clearly nearer to one of the positions: the branch is known
    edited = edited.replace("position: [0.0, 0.0, 0.2]", "position: [0.0, 0.0, 0.12]")
    with pytest.raises(ModelFileError, match=r"home: .* but to \[.*\] or \[.*\] m") as refused:
        parse_model(edited)
    # arms of 250 mm at 30.65 degrees, with the encoder's offset of -3 mm across them
    arm = elbows(np.full(3, np.radians(30.65)), 0.0, 1.0)[0]
    out = 0.076 + 0.25 * arm[0] + 0.003 * arm[2]
    up = -0.0165 + 0.25 * arm[2] - 0.003 * arm[0]
    for side in (1, -1):
        assert f"{up + side * np.sqrt(0.34**2 - out**2):.6f}"[:7] in str(refused.value)


@pytest.mark.parametrize("name", ["delta24", "delta54", "delta_nominal"])
def test_a_rotary_delta_is_made_from_its_size_and_read_again(name):
    size = {"base": 0.2, "platform": 0.07, "arm": 0.25, "rod": 0.55}
    for below, side in ((False, 0), (True, 1)):
        model = new_model(load_mechanism(name, **size, below=below))
        again = parse_model(dump_model(model))
        q = again.mechanism.home.joints
        expected = three_spheres(elbows(np.array(q), 0.13, 0.25), 0.55)[side]
        np.testing.assert_allclose(again.mechanism.home.position, expected, atol=1e-12)
        assert Kinematics(again).direct(q).ok
        assert (expected[2] < 0) == below


def test_a_linear_delta_and_a_five_bar_are_made_from_their_size():
    model = new_model(load_mechanism("linear_delta", base=0.14, platform=0.035, rod=0.215))
    height = np.sqrt(0.215**2 - 0.105**2)
    assert Kinematics(model).direct([0.3] * 3).position[2] == pytest.approx(0.3 - height)
    bars = new_model(load_mechanism("five_bar", base=0.08, crank=0.2, rod=0.25, below=True))
    crank = np.array([0.04 + 0.2 * np.cos(np.pi / 3), 0.2 * np.sin(np.pi / 3)])
    y = crank[1] - np.sqrt(0.25**2 - crank[0] ** 2)
    np.testing.assert_allclose(bars.mechanism.home.position, [0, y, 0], atol=1e-12)


@pytest.mark.parametrize(
    ("name", "options", "words"),
    [
        ("delta24", {"arm": -1}, "arm is -1: expected one number, above 0"),
        ("delta54", {"rod": 0.01}, "rod is 0.01 m: too short"),
        ("linear_delta", {"rod": 0.05}, "rod is 0.05 m: too short"),
        ("linear_delta", {"limits": [3, 1]}, "limits is .3, 1.: expected two numbers in m"),
        ("five_bar", {"rod": "x"}, "rod is 'x': expected one number"),
        ("five_bar", {"rod": 0.01}, "the rods do not meet at home"),
    ],
)
def test_an_impossible_size_is_refused(name, options, words):
    with pytest.raises(ModelError, match=words):
        load_mechanism(name, **options)
