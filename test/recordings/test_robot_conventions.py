"""`robot: fanuc` in a column map: joints and poses as the makers of arms state them."""

import numpy as np
import pytest

from parallel_cal.base.errors import ParallelCalError
from parallel_cal.cli.main import main
from parallel_cal.recordings.csv_import import import_csv

ANGLES = (20, -35, 50)  # degrees
# RoboDK-API 84099bb (robomath.py), run with these angles: Fanuc_2_Pose, KUKA_2_Pose,
# Staubli_2_Pose; UR_2_Pose with the rotation vector (0.3, -0.6, 0.9) rad.
BY_ROBODK = {
    "fanuc": (
        (0.526540785, -0.845944974, -0.0844506),
        (0.627506872, 0.453744239, -0.632733192),
        (0.573576436, 0.2801665, 0.769751131),
    ),
    "kuka": (
        (0.769751131, -0.632733192, -0.0844506),
        (0.2801665, 0.453744239, -0.845944974),
        (0.573576436, 0.627506872, 0.526540785),
    ),
    "staubli": (
        (0.526540785, -0.627506872, -0.573576436),
        (0.593747647, 0.754301309, -0.2801665),
        (0.60845586, -0.193040571, 0.769751131),
    ),
    "ur": (
        (0.473902392, -0.803494064, -0.36029684),
        (0.641617877, 0.595309532, -0.483666271),
        (0.60311112, -0.001962291, 0.797654766),
    ),
}
# By hand: 0.7 + 0.1 i - 0.5 j + 0.5 k; and half a right angle about z and a right angle about y.
BY_HAND = {
    "abb": ((0, -0.8, -0.6), (0.6, 0.48, -0.64), (0.8, -0.36, 0.48)),
    "kawasaki": ((0, -(0.5**0.5), 0.5**0.5), (0, 0.5**0.5, 0.5**0.5), (-1, 0, 0)),
}
HEADERS = {
    "abb": ("J1,J2,J3,J4,J5,J6,X,Y,Z,Q1,Q2,Q3,Q4", (0.7, 0.1, -0.5, 0.5)),
    "fanuc": ("J1,J2,J3,J4,J5,J6,X,Y,Z,W,P,R", ANGLES),
    "kawasaki": ("JT1,JT2,JT3,JT4,JT5,JT6,X,Y,Z,O,A,T", (45, 90, 0)),
    "kuka": ("A1,A2,A3,A4,A5,A6,X,Y,Z,A,B,C", ANGLES),
    "staubli": ("J1,J2,J3,J4,J5,J6,X,Y,Z,RX,RY,RZ", ANGLES),
    "ur": (",".join([f"actual_q_{i}" for i in range(6)]) + ",x,y,z,rx,ry,rz", (0.3, -0.6, 0.9)),
}
JOINTS = (10, 20, 30, 40, 50, 60)


def table(folder, robot, header=None):
    names, turn = HEADERS[robot]
    cells = ",".join(map(str, (*JOINTS, 100, 200, 300, *turn)))
    (folder / "shots.csv").write_text(f"{header or names}\n{cells}\n{cells}\n")
    return folder / "shots.csv"


@pytest.mark.parametrize("robot", HEADERS)
def test_a_table_is_read_as_the_maker_of_the_robot_states_joints_and_poses(robot, tmp_path):
    data = import_csv(table(tmp_path, robot), robot=robot)
    np.testing.assert_allclose(data.R[0], (BY_ROBODK | BY_HAND)[robot], atol=1e-9)
    unit = 1.0 if robot == "ur" else 1e-3
    np.testing.assert_allclose(data.r[0], np.array([100, 200, 300]) * unit)
    expected = np.array(JOINTS, float)
    expected[2] += 20 if robot == "fanuc" else 0  # J3 counts from the horizontal
    joints = expected if robot == "ur" else np.radians(expected)
    np.testing.assert_allclose(data.q[0], joints)


def read(folder, text, header=None, robot="fanuc"):
    (folder / "map.yaml").write_text(text)
    return import_csv(table(folder, robot, header), folder / "map.yaml")


def test_what_a_column_map_states_counts_before_the_convention(tmp_path):
    """Six names of joints, a position that a device measured, and a joint that is not coupled."""
    names = "joints: [base, shoulder, elbow, w1, w2, w3]\n"
    data = read(tmp_path, f"robot: fanuc\n{names}position: {{columns: [X, Y, Z], unit: um}}\n")
    assert data.joint_names == ("base", "shoulder", "elbow", "w1", "w2", "w3")
    np.testing.assert_allclose(data.r[0], [1e-4, 2e-4, 3e-4])
    assert data.q[0, 2] == pytest.approx(np.radians(50))
    assert data.measured[0].tolist() == [True] * 3 + [False] * 3
    own = read(tmp_path, "robot: fanuc\njoints: {elbow: {column: J3, unit: deg}}\n")
    assert own.q[0, 0] == pytest.approx(np.radians(30))


def test_a_table_of_a_tracker_has_positions_only(tmp_path):
    header = HEADERS["kuka"][0].replace("A,B,C", "day,shift,by")
    data = import_csv(table(tmp_path, "kuka", header), robot="kuka")
    assert data.measured[0].tolist() == [True] * 3 + [False] * 3
    np.testing.assert_allclose(data.r[0], [0.1, 0.2, 0.3])


def test_angles_of_other_columns_have_the_axes_of_the_maker(tmp_path):
    header = HEADERS["kuka"][0].replace("A,B,C", "a,b,c")
    text = "robot: kuka\nangles: {columns: [a, b, c]}\n"
    data = read(tmp_path, text, header, "kuka")
    np.testing.assert_allclose(data.R[0], BY_ROBODK["kuka"], atol=1e-9)


def test_what_is_wrong_is_said(tmp_path):
    path = table(tmp_path, "fanuc")
    for given, message in (
        ({"robot": "kuka"}, "no column A1, which robot=kuka names; the table has J1, J2"),
        (
            {"robot": "fanucc"},
            "robot=fanucc; did you mean 'fanuc'?: expected one of abb, fanuc, ka",
        ),
        ({}, "no column map and no robot: state a column map (--columns MAP.yaml) or the maker"),
        ({"robot": "ur", "columns": "m.yaml"}, "write 'robot: ur' into m.yaml"),
    ):
        with pytest.raises(ParallelCalError) as error:
            import_csv(path, **given)
        assert message in str(error.value)
    with pytest.raises(ParallelCalError, match=r"map.yaml:1: .*robot is 'fanucc', expected"):
        read(tmp_path, "robot: fanucc\n")


def test_the_command_needs_no_column_map(tmp_path, capsys):
    arguments = [str(table(tmp_path, "fanuc")), "--robot", "fanuc"]
    with pytest.raises(SystemExit) as ended:
        main(["import-csv", *arguments, "-o", str(tmp_path / "s.json")])
    assert ended.value.code == 0
    assert "joint3  0.8727 rad" in capsys.readouterr().out
