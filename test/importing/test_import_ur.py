"""The numbers of a Universal Robots arm: its drawing, and its factory calibration."""

import numpy as np
import pytest

from parallel_cal.base.errors import ParallelCalError
from parallel_cal.importing.controller_files import configured
from parallel_cal.kinematics.kinematics import Kinematics

UR3 = """\
[DH]
a = [0.00000, -0.24365, -0.21325, 0.00000, 0.00000, 0.0000]
d = [0.1519, 0.00000, 0.00000, 0.11235, 0.08535, 0.0819]
alpha = [ 1.570796327, 0, 0, 1.570796327, -1.570796327, 0 ]
q_home_offset = [0, -1.570796327, 0, -1.570796327, 0, 0]
"""
# The calibration of a UR3 that its owner published, rounded.
CALIBRATION = """\
[mounting]
delta_theta = [ 4.618e-05, -0.0596918, 0.1879825, -0.1284214, 1.8692e-05, -3.70877e-05]
delta_a = [ 3.7464e-05, 0.000432751, 0.00151546, 3.54739e-05, 5.12409e-05, 0]
delta_d = [ 0.000223224, -6.29131988, 8.56941731, -2.27804645, -7.31386e-05, 0.00041072]
delta_alpha = [ 0.0001182, 0.00230511, 0.0120016, 0.000466335, -0.000233983, 0]
"""


def written(folder, *texts):
    names = ("urcontrol.conf", "calibration.conf")
    for name, text in zip(names, texts, strict=False):
        (folder / name).write_text(text)
    return [folder / name for name, _ in zip(names, texts, strict=False)]


def numbers(text, name):
    line = next(line for line in text.splitlines() if line.split(" = ")[0] == name)
    return np.array([float(word) for word in line.split("[")[1].strip(" ]").split(",")])


def turned(axis, angle):
    c, s = np.cos(angle), np.sin(angle)
    i, j = {"x": (1, 2), "z": (0, 1)}[axis]
    T = np.eye(4)
    T[[i, i, j, j], [i, j, i, j]] = c, -s, s, c
    return T


def by_dh(q, calibrated):
    """The flange by the four motions of each joint."""
    T = np.eye(4)
    for i in range(6):
        theta, d, a, alpha = (
            (numbers(UR3, n)[i] if n != "theta" else q[i])
            + (numbers(CALIBRATION, f"delta_{n}")[i] if calibrated else 0.0)
            for n in ("theta", "d", "a", "alpha")
        )
        shift = np.eye(4)
        shift[[0, 2], 3] = a, d
        T = T @ turned("z", theta) @ shift @ turned("x", alpha)
    return T


@pytest.mark.parametrize("calibrated", [False, True])
def test_the_poses_are_those_of_the_controllers_own_numbers(calibrated, tmp_path):
    files = written(tmp_path, *((UR3, CALIBRATION) if calibrated else (UR3,)))
    found = configured(files)
    q = np.random.default_rng(1).uniform(-3, 3, (20, 6))
    poses = Kinematics(found.model).direct(q)
    for row, r, R in zip(q, poses.position, poses.rotation, strict=True):
        T = by_dh(row, calibrated)
        np.testing.assert_allclose(r, T[:3, 3], atol=1e-11)
        np.testing.assert_allclose(R, T[:3, :3], atol=1e-11)
    assert found.model.joints[2] == "elbow_joint"


def test_metres_of_d_become_small_numbers_of_hayati_and_are_named(tmp_path):
    """With axes 1 mrad apart, d of 574 m and -574 m would be as usual."""
    far = CALIBRATION.replace("-6.29131988, 8.56941731", "574.123, -571.845")
    for text, size in ((CALIBRATION, "d2 = -6.29132 m"), (far, "d2 = 574.123 m")):
        found = configured(written(tmp_path, UR3, text))
        assert any(size in r and "shoulder_lift, elbow" in r for r in found.remarks)
    found = configured(written(tmp_path, UR3, CALIBRATION))
    lengths = [p for p in found.model.table if p.unit == "m"]
    assert max(abs(p.nominal) for p in lengths) < 0.3
    assert "link2.beta" in found.model.table.names
    assert "link2.d" not in found.model.table.names


def test_without_a_calibration_the_arm_is_as_drawn_and_a_remark_says_so(tmp_path):
    """The stretched arm: 0.24365 + 0.21325 m, and 0.0819 m of the flange across."""
    found = configured(written(tmp_path, UR3))
    assert any("give calibration.conf" in remark for remark in found.remarks)
    at = Kinematics(found.model).direct(np.zeros((1, 6))).position[0]
    np.testing.assert_allclose(at, [-0.4569, -0.19425, 0.06655], atol=1e-8)


@pytest.mark.parametrize(
    ("texts", "message"),
    [
        (
            (UR3, CALIBRATION.replace("-6.29131988", "x")),
            r"calibration.conf:4: delta_d is ' x', e|'x'",
        ),
        (
            (UR3.replace("0.0819]", "0.0819, 1]"),),
            r"urcontrol.conf:3: d is .* expected six numbers",
        ),
        ((UR3.replace("alpha =", "beta ="),), r"no alpha, expected six numbers in rad \(urcontrol"),
        (
            (
                UR3,
                CALIBRATION.replace("delta_a =", "dela ="),
            ),
            r"no delta_a, expected six numbers in m",
        ),
    ],
)
def test_a_broken_file_is_named_with_line_and_key(texts, message, tmp_path):
    with pytest.raises(ParallelCalError, match=message):
        configured(written(tmp_path, *texts))


def test_a_calibration_alone_asks_for_the_numbers_of_the_arm(tmp_path):
    (tmp_path / "calibration.conf").write_text(CALIBRATION)
    with pytest.raises(ParallelCalError, match=r"no d, expected six numbers in m \(urcontrol.conf"):
        configured([tmp_path / "calibration.conf"])
