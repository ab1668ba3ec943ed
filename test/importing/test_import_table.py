"""Exports of trackers and measuring machines, and logs of joints, become samples; or one line."""

import numpy as np
import pytest

from parallel_cal.base.errors import ParallelCalError
from parallel_cal.cli import main as cli
from parallel_cal.importing.controller_files import samples
from parallel_cal.recordings.dataset import Dataset

TRACKER = """\
// SpatialAnalyzer export, job 17
// Units: Millimeters
Instrument: AT960 level 2

Point Name; X; Y; Z; RMS; Timestamp;
P1; 100,5; -20,25; 300; 0,01; 2026-11-22T10:00:00.5;
# remeasured below
P2; 0; 10; 250,125; 0,02; 2026-11-22T10:00:10.5;
P3; 5; 5; 5; 0,02; 2026-11-22T10:00:20.5;
"""
JOINTS = """\
point name\tjoint1 [deg]\tjoint2 [deg]\tslide [mm]\tTimestamp
P2\t90\t-45.0\t10\t2026-11-22T10:00:10
P1\t30\t60\t-5\t2026-11-22T10:00:00
P7\t0\t0\t0\t2026-11-22T10:01:00
"""


@pytest.fixture
def files(tmp_path):
    """files(tracker, joints): their paths."""

    def write(tracker=TRACKER, joints=JOINTS):
        (tmp_path / "tracker.txt").write_text(tracker, encoding="utf-8")
        (tmp_path / "joints.txt").write_text(joints, encoding="utf-8")
        return [tmp_path / "tracker.txt", tmp_path / "joints.txt"]

    return write


def test_points_find_their_joints_by_the_index_that_both_have(files):
    data = samples("table", files(), sigma=2e-5, joint_sigma=1e-5)
    assert data.joint_names == ("joint1", "joint2", "slide")
    np.testing.assert_allclose(data.r, [[0, 0.01, 0.250125], [0.1005, -0.02025, 0.3]][::-1])
    turned = np.radians([[30, 60], [90, -45]])
    np.testing.assert_allclose(data.q, np.column_stack([turned, [-0.005, 0.01]]))
    np.testing.assert_array_equal(data.measured, [[True] * 3 + [False] * 3] * 2)
    np.testing.assert_allclose(np.sqrt(np.diag(data.pose_cov[0])[:3]), 2e-5)
    np.testing.assert_array_equal(data.joint_sigma, [1e-5] * 3)
    assert [d.detail.split(": ")[0].split("/")[-1] for d in data.dropped] == [
        "tracker.txt:9",
        "joints.txt:4",
    ]


@pytest.mark.parametrize(
    ("clock", "joints"),
    [
        ("2026-11-22 10:00:", "2026-11-22T10:00:"),
        ("9:00:", "09:00:"),
        ("2026-11-22T10:00:", "2026-11-22T10:00:"),
        ("10:00:", "10:00:"),
        ("", ""),
    ],
)
def test_points_find_their_joints_by_the_nearest_time(files, clock, joints):
    tracker = TRACKER.replace("2026-11-22T10:00:", clock)
    log = JOINTS.replace("2026-11-22T10:00:", joints)
    log = log.replace("2026-11-22T10:01:00", "99" if not joints else joints + "59")
    data = samples(
        "table", files(tracker, log), by="Timestamp", within=0.6, joints=["joint1", "joint2"]
    )
    np.testing.assert_allclose(np.degrees(data.q), [[30, 60], [90, -45]])
    np.testing.assert_allclose(data.r[:, 1], [-0.02025, 0.01])
    with pytest.raises(ParallelCalError, match=r"no row of .* is within 0.4 s \(Timestamp\)"):
        samples("table", files(tracker, log), by="Timestamp", within=0.4)


def test_clocks_may_stand_in_other_zones(files):
    """Half past eleven in Paris's winter is half past ten in Greenwich."""
    tracker = (
        "t,x [m],y [m],z [m]\n2026-11-22T10:30:00.1234567Z,1,2,3\n2026-11-22T10:30:09Z,4,5,6\n"
    )
    log = "t,q [rad]\n2026-11-22T11:30:00.1+01:00,7\n2026-11-22 11:30:09+0100,8\n"
    data = samples("table", files(tracker, log), within=0.03)
    np.testing.assert_array_equal(data.q[:, 0], [7, 8])
    with pytest.raises(ParallelCalError, match=r"t is '2026-13-22 11:30:09.0100', exp"):
        samples("table", files(tracker, log.replace("11-22 1", "13-22 1")), within=0.03)


def test_one_table_may_hold_both_and_other_names_are_reported(files):
    table = "nr,A1,A2,XA,YA,ZA\n1,0.5,1,0.1,0.2,0.3\n2,0.25,2,0.4,0.5,0.6\n"
    path = files(table)[:1]
    data = samples(
        "table", path, position=["xa", "YA", "ZA"], unit="in", joints=["A2", "A1"], joint_unit="rad"
    )
    np.testing.assert_allclose(data.q, [[1, 0.5], [2, 0.25]])
    np.testing.assert_allclose(data.r[1], np.array([0.4, 0.5, 0.6]) * 0.0254)


@pytest.mark.parametrize(
    ("unit", "metres"),
    [
        ("MM", 1e-3),
        ("cm", 1e-2),
        ("Feet", 0.3048),
        ("mil", 25.4e-6),
        ("nm", 1e-9),
        ("Metre", 1.0),
    ],
)
@pytest.mark.parametrize(
    ("angle", "turn"),
    [
        ("gon", 400),
        ("arcsec", 1_296_000),
        ("Revolutions", 1),
        ("mrad", 2000 * np.pi),
        ("Deg", 360),
    ],
)
def test_lengths_and_angles_have_the_unit_of_the_header(files, unit, metres, angle, turn):
    tracker = f"nr,X ({unit}),Y ({unit}),Z ({unit})\n1,3,4,5\n"
    data = samples("table", files(tracker, f"nr,joint1 [{angle}]\n1,{turn / 4}\n"))
    np.testing.assert_allclose(data.r[0], np.array([3, 4, 5]) * metres)
    np.testing.assert_allclose(data.q[0], np.pi / 2)


LEICA = """\
Messung 3, °C 21,5
X [mm];Y [mm];Z [mm]
100,5;-20,25;300
0;10;250,125
"""
ANGLES = "joint1 [°];joint2 [°]\n30;60\n90;-45\n"


def write_leica(tmp_path, angles=ANGLES):
    paths = [tmp_path / "leica.txt", tmp_path / "joints.csv"]
    for path, text in zip(paths, (LEICA, angles), strict=True):
        path.write_bytes(text.replace("\n", "\r\n").encode("latin-1"))
    return paths


def test_latin_1_tables_without_a_key_are_matched_row_by_row(tmp_path):
    data = samples("table", write_leica(tmp_path))
    np.testing.assert_allclose(data.r, [[0.1005, -0.02025, 0.3], [0, 0.01, 0.250125]])
    np.testing.assert_allclose(data.q, np.radians([[30, 60], [90, -45]]))
    assert any("leica.txt and " in w and "matched row by row" in w for w in data.warnings)


def test_tables_without_a_key_and_of_different_lengths_are_refused(tmp_path):
    paths = write_leica(tmp_path, ANGLES + "1;2\n")
    words = "leica.txt, .*joints.csv: no column that all tables have, and 2 and 3 rows: expected"
    with pytest.raises(ParallelCalError, match=words):
        samples("table", paths)


def test_rows_may_be_matched_although_the_tables_share_a_column(files):
    joints = JOINTS.replace("\nP7\t0", "\nP2\t0").replace("P2\t90", "P1\t90")
    data = samples("table", files(joints=joints), by="row", joints=["joint1", "slide"])
    np.testing.assert_allclose(data.q[:, 1], [0.01, -0.005, 0])
    np.testing.assert_allclose(data.r[:, 1], [-0.02025, 0.01, 0.005])


def test_joints_named_like_the_position_need_other_names_of_the_position(tmp_path):
    axes, points = tmp_path / "axes.csv", tmp_path / "points.csv"
    axes.write_text("point,x [mm],y [mm],z [mm]\n1,1,2,3\n2,4,5,6\n")
    text = "point,X [mm],Y [mm],Z [mm]\n1,7,8,9\n2,10,11,12\n"
    points.write_text(text)
    words = r"2 of the tables have the columns x, y, z; give those of the position other names"
    with pytest.raises(ParallelCalError, match=words):
        samples("table", [points, axes])
    points.write_text(text.replace("X", "X1").replace("Y", "Y1").replace("Z", "Z1"))
    data = samples("table", [points, axes], position=["X1", "Y1", "Z1"])
    assert data.joint_names == ("x", "y", "z")
    np.testing.assert_allclose(data.q[1], [0.004, 0.005, 0.006])
    np.testing.assert_allclose(data.r[1], [0.010, 0.011, 0.012])


def test_the_command_writes_samples(files, tmp_path):
    words = ["import", "table", *map(str, files()), "-o", str(tmp_path / "s.json")]
    with pytest.raises(SystemExit) as ended:
        cli.main([*words, "--option", "sigma=2.0e-5"])
    assert ended.value.code == 0
    assert len(Dataset.from_json(tmp_path / "s.json")) == 2


BROKEN = {
    "word": (
        ("-20,25", "-2O,25"),
        {},
        "tracker.txt:6: column Y [mm] contains '-2O,25', expected a",
    ),
    "cell": (("; 10; 250,125", "; 250,125"), {}, "tracker.txt:8: 5 cells, but the header has 6"),
    "no unit": (("Units: Millimeters", ""), {}, "tracker.txt:1: column X has no unit; state it"),
    "no x": (("; X;", "; Xx;"), {}, "none of the tables has the columns x, y, z; state which"),
    "two x": (
        ("slide [mm]\tT", "X\tY\tZ\tT"),
        {},
        "2 of the tables have the columns x, y, z; give those of the position other names",
    ),
    "no index": (
        ("point name", "number"),
        {},
        "joined by Timestamp: state the largest time difference (--option with",
    ),
    "no column": (("Timestamp", "at"), {"by": "nr"}, "tracker.txt:1: no column nr to join by"),
    "two": (("P2;", "P1;"), {}, "tracker.txt:8: Point Name P1 occurs twice"),
    "time": (
        ("10.5;", "1O.5;"),
        {"by": "Timestamp", "within": 1.0},
        "tracker.txt:8: Timestamp is '2026-11-22T10:00:1O.5', expected seconds, 14:03:05.2",
    ),
    "unit": (("", ""), {"unit": "ell"}, "unit=ell: expected one of rad, mrad, deg, arcmin"),
    "joint unit": (("joint1 [deg]", "joint1"), {}, "joints.txt:1: column joint1 has no unit"),
    "empty": (
        (TRACKER, ""),
        {},
        "tracker.txt:1: the file is empty; expected a header line",
    ),
    "option": (("", ""), {"x": 1}, "its options: by="),
}


@pytest.mark.parametrize("name", BROKEN)
def test_a_broken_file_is_named_with_line_and_field(files, name):
    (old, new), options, message = BROKEN[name]
    paths = files(TRACKER.replace(old, new, 1), JOINTS.replace(old, new, 1))
    with pytest.raises(ParallelCalError) as error:
        samples("table", paths, **options)
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_a_table_without_joint_readings_is_named(files):
    """It ended with a traceback of the library that checks column maps."""
    [tracker, _] = files(tracker="X [mm],Y [mm],Z [mm]\n1,2,3\n4,5,6\n")
    with pytest.raises(ParallelCalError, match="no column is a joint reading: expected a second"):
        samples("table", [tracker])
