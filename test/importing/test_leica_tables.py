"""Exports of a Leica T-Mac or T-Probe: quaternions with the scalar first, temperatures and times.

The names and the order are those of Leica's own interface emScon: its example program computes the
axes of the probe from dQuaternion0 to dQuaternion3, and `axes_of_emscon` states its formula.
"""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from parallel_cal.importing.controller_files import samples
from parallel_cal.recordings.loading import load_dataset

TURNS = Rotation.from_rotvec([[0.1, 0.2, 0.3], [-0.5, 0.0, 0.9], [1.2, -0.7, 0.2]])
PLACES = [[100.5, -20.25, 300.0], [0.0, 10.0, 250.125], [5.0, 5.0, 5.0]]  # mm


def axes_of_emscon(q0, q1, q2, q3):
    """The rotation matrix, as the example program writes it."""
    return np.array(
        [
            [q0**2 + q1**2 - q2**2 - q3**2, 2 * (q1 * q2 - q0 * q3), 2 * (q1 * q3 + q0 * q2)],
            [2 * (q1 * q2 + q0 * q3), q0**2 - q1**2 + q2**2 - q3**2, 2 * (q2 * q3 - q0 * q1)],
            [2 * (q1 * q3 - q0 * q2), 2 * (q3 * q2 + q0 * q1), q0**2 - q1**2 - q2**2 + q3**2],
        ]
    )


def scalar_first():
    return np.roll(TURNS.as_quat(), 1, axis=1)


def write(tmp_path, names):
    """A table of poses and a table of joints."""
    head = f"Point Name;X [mm];Y [mm];Z [mm];{';'.join(names)};Temperature [degC];Timestamp"
    lines = [
        ";".join([f"P{i}", *map(repr, place), *map(repr, map(float, q)), str(20.5 + i), clock])
        for i, (place, q, clock) in enumerate(
            zip(PLACES, scalar_first(), ("10:00:00.5", "10:00:10.5", "10:01:00.5"), strict=True)
        )
    ]
    (tmp_path / "tmac.csv").write_text("\n".join([head, *lines]) + "\n")
    joints = "Point Name,leg1 [mm],leg2 [mm]\nP0,1,2\nP1,3,4\nP2,5,7\n"
    (tmp_path / "joints.csv").write_text(joints)
    return [tmp_path / "tmac.csv", tmp_path / "joints.csv"]


@pytest.mark.parametrize("name", ["Q{}", "q{}", "dQuaternion{}", "Quaternion{}"])
def test_the_axes_are_those_of_the_makers_own_formula(tmp_path, name):
    data = samples("table", write(tmp_path, [name.format(k) for k in range(4)]))
    assert data.joint_names == ("leg1", "leg2")
    np.testing.assert_allclose(data.R, [axes_of_emscon(*q) for q in scalar_first()], atol=1e-12)
    np.testing.assert_allclose(data.r, 1e-3 * np.array(PLACES))
    assert data.measured.all()


def test_temperature_and_times_are_conditions(tmp_path):
    data = samples("table", write(tmp_path, ["Q0", "Q1", "Q2", "Q3"]))
    np.testing.assert_allclose(data.conditions["temperature"], [20.5, 21.5, 22.5])
    np.testing.assert_allclose(data.conditions["time"], [0.0, 10.0, 60.0])


def test_one_table_with_joints_needs_no_column_map(tmp_path):
    rows = [
        ",".join(map(repr, map(float, [k, 2 * k, *place, *q])))
        for k, (place, q) in enumerate(zip(PLACES, scalar_first(), strict=True))
    ]
    head = "leg1 [mm],leg2 [mm],x [mm],y [mm],z [mm],Q0,Q1,Q2,Q3"
    (tmp_path / "all.csv").write_text("\n".join([head, *rows]) + "\n")
    data = load_dataset(tmp_path / "all.csv", joints=("leg1", "leg2"))
    np.testing.assert_allclose(data.R, TURNS.as_matrix(), atol=1e-12)


def test_four_joints_named_q0_to_q3_are_no_quaternion(tmp_path):
    rows = ["0.1,0.2,0.3,0.4,1,2,3", "0.5,0.5,0.5,0.5,4,5,6"]
    head = "q0 [rad],q1 [rad],q2 [rad],q3 [rad],x [mm],y [mm],z [mm]"
    (tmp_path / "arm.csv").write_text("\n".join([head, *rows]) + "\n")
    data = load_dataset(tmp_path / "arm.csv", joints=("q0", "q1", "q2", "q3"))
    assert not data.measured[:, 3:].any()
    assert samples("table", [tmp_path / "arm.csv"]).joint_names == ("q0", "q1", "q2", "q3")
