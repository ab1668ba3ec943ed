"""Tables that log a moving robot are read as a recording, with the offset between two clocks."""

import re

import numpy as np
import pytest
import virtual_cable_motion as vm

from parallel_cal.base.errors import ParallelCalError
from parallel_cal.base.rotation import matrix_to_quaternion
from parallel_cal.importing.controller_files import samples
from parallel_cal.mechanisms.stewart42 import BASE, PLATFORM, RETRACTED
from parallel_cal.recordings.csv_import import import_csv
from parallel_cal.recordings.options import ReadOptions
from parallel_cal.virtual import robot as vr

PLOTTER = """joints: {line1: {column: line1, unit: mm}, line2: {column: line2, unit: mm},
  line3: {column: line3, unit: mm}, line4: {column: line4, unit: mm}}
position: {columns: [x, y, null], unit: mm}
log: {time: t}
"""
OFFSET = 1.815  # s by which the cameras' clock is ahead
LEGS = [f"leg{i}" for i in range(1, 7)]
MAP = """joints: {leg1: {column: leg1}, leg2: {column: leg2}, leg3: {column: leg3},
  leg4: {column: leg4}, leg5: {column: leg5}, leg6: {column: leg6}}
position: {columns: [x, y, z]}
orientation: [qx, qy, qz, qw]
"""


def smooth_motion(stops=13, seed=0):
    """Return a function of time: lengths (n, 6), positions (n, 3) and rotations (n, 3, 3) of a
    hexapod that moves for 1 s to each of some poses and rests there for 1 s."""
    rng = np.random.default_rng(seed)
    places = rng.uniform(-1, 1, (stops, 6)) * [0.04, 0.04, 0.03, 0.15, 0.15, 0.15]

    def at(t):
        k, part = np.divmod(np.clip(t, 0, 2 * (stops - 1) - 1e-9), 2.0)
        k, s = k.astype(int), np.clip(part, 0, 1)[:, None]
        s = s**3 * (10 - 15 * s + 6 * s**2)
        x = places[k] + s * (places[k + 1] - places[k])
        r, R = x[:, :3] + [0, 0, 0.3], vr.turn(x[:, 3:])
        ends = r[:, None] + np.einsum("nij,kj->nki", R, PLATFORM) - BASE
        return np.linalg.norm(ends, axis=2) - RETRACTED, r, R

    return at


def write(path, header, rows):
    np.savetxt(path, rows, delimiter=",", header=",".join(header), comments="", fmt="%.9f")
    return path


@pytest.fixture
def logs(tmp_path):
    """logs(offset): a log of the legs at 100 Hz and one of the cameras at 60 Hz, and a map."""

    def make(clock="log: {time: t}", offset=OFFSET, robot_epoch=0.0, seconds=24.0):
        rng = np.random.default_rng(1)
        at = smooth_motion()
        t, seen = np.arange(0.0, seconds, 0.01), np.arange(0.2, seconds - 0.2, 1 / 60)
        q = at(t)[0] + 2e-6 * rng.standard_normal((len(t), 6))
        _, r, R = at(seen)
        r = r + 20e-6 * rng.standard_normal(r.shape)
        joints = write(
            tmp_path / "joints.csv",
            ["t", *(f"{leg}_mm" for leg in LEGS)],
            np.column_stack([t + robot_epoch, 1e3 * q]),
        )
        poses = write(
            tmp_path / "poses.csv",
            ["t", "x_mm", "y_mm", "z_mm", "qx", "qy", "qz", "qw"],
            np.column_stack([seen + robot_epoch + offset, 1e3 * r, matrix_to_quaternion(R)]),
        )
        (tmp_path / "map.yaml").write_text(MAP + clock)
        return [joints, poses], tmp_path / "map.yaml"

    return make


def offset_in(data):
    """The offset and its margin as the note of the import states them, s."""
    [note] = [w for w in data.warnings if "the two clocks differ" in w]
    found = re.search(r"csv was stamped ([\d.]+) s (\w+) than .*\(\+- ([\d.e-]+) s with", note)
    return float(found[1]) * {"later": 1, "earlier": -1}[found[2]], float(found[3])


def legs_of(data):
    """Lengths of the ideal legs at the measured poses."""
    ends = data.r[:, None] + np.einsum("nij,kj->nki", data.R, PLATFORM) - BASE
    return np.linalg.norm(ends, axis=2) - RETRACTED


def test_the_offset_of_the_clocks_is_found_from_motion_and_stated(logs):
    data = import_csv(*logs())
    offset, margin = offset_in(data)
    assert margin < 5e-3
    assert abs(offset - OFFSET) < margin
    assert data.mode == "dwell"
    assert len(data) == 12
    np.testing.assert_allclose(data.q, legs_of(data), atol=30e-6)
    assert {f"direction.{leg}" for leg in LEGS} <= set(data.conditions)
    assert data.joint_units == ("m",) * 6


@pytest.mark.parametrize("epoch", [0.0, 1.7e9])
def test_clocks_that_never_overlap_are_aligned_too(logs, epoch):
    data = import_csv(*logs(offset=-5e5, robot_epoch=epoch))
    offset, margin = offset_in(data)
    assert abs(offset + 5e5) < margin < 8e-3
    np.testing.assert_allclose(data.q, legs_of(data), atol=30e-6)


def test_a_moving_robot_is_paired_with_each_pose_on_one_clock(logs):
    paths, columns = logs()
    moving = import_csv(paths, columns, ReadOptions(mode="continuous"))
    assert len(moving) > 1000
    assert np.sqrt(np.mean((moving.q - legs_of(moving)) ** 2)) < 60e-6


def test_rests_are_joined_by_the_nearest_time_on_one_clock(logs):
    data = import_csv(*logs("join: {by: t, within: 0.02}"))
    offset, margin = offset_in(data)
    assert abs(offset - OFFSET) < margin < 8e-3
    speed = np.abs(np.gradient(data.q, axis=0)).max(axis=1)
    np.testing.assert_allclose((data.q - legs_of(data))[speed < 1e-5], 0, atol=120e-6)


def test_rows_without_numbers_and_a_group_of_names_do_not_hide_the_offset(logs):
    paths, columns = logs("join: {by: t, within: 0.02}\ngroup: place")
    header, *rows = paths[1].read_text().split()
    rows = [f"{row},home" for row in rows]
    first = rows[0].split(",")  # far from any row of the joints, and not seen by the cameras
    rows[0] = ",".join(["-9", *["nan"] * (len(first) - 2), "home"])
    paths[1].write_text("\n".join([header + ",place", *rows]))
    offset, margin = offset_in(import_csv(paths, columns))
    assert abs(offset - OFFSET) < margin < 8e-3


@pytest.mark.parametrize(
    "clock", ["log: {time: t, offset: %s}", "join: {by: t, within: 1, offset: %s}"]
)
def test_a_stated_offset_is_used_and_not_estimated(logs, clock):
    data = import_csv(*logs(clock % OFFSET))
    assert not any("clocks differ" in w for w in data.warnings)
    still = np.abs(np.gradient(data.q, axis=0)).max(axis=1) < (1e-5 if "join" in clock else 1)
    np.testing.assert_allclose((data.q - legs_of(data))[still], 0, atol=80e-6)


def test_one_clock_has_no_offset(logs):
    data = import_csv(*logs(offset=0.0))
    assert not any("clocks differ" in w for w in data.warnings)
    np.testing.assert_allclose(data.q, legs_of(data), atol=30e-6)


def test_times_in_milliseconds_give_the_same_samples(logs, tmp_path):
    paths, columns = logs()
    seconds = import_csv(paths, columns)
    for path in paths:
        header, rows = path.read_text().split("\n", 1)
        numbers = np.loadtxt(rows.splitlines(), delimiter=",")
        numbers[:, 0] *= 1e3
        write(path, header.split(","), numbers)
    columns.write_text(MAP + "log: {time: t, unit: ms}")
    np.testing.assert_allclose(import_csv(paths, columns).q, seconds.q, atol=1e-7)


def test_an_importer_of_two_tables_finds_the_offset_too(logs):
    paths, _ = logs()
    found = samples("table", paths, within=0.02, by="t", joint_sigma=1e-5)
    offset, margin = offset_in(found)
    assert abs(offset - OFFSET) < margin < 8e-3


def test_one_table_may_log_joints_and_slower_poses_with_gaps_and_a_temperature(tmp_path):
    at = smooth_motion()
    t = np.arange(0.0, 24.0, 0.01)
    q, r, R = at(t)
    quaternion = matrix_to_quaternion(R)
    header = ["t", *(f"{leg}_m" for leg in LEGS), *"xyz", "qx", "qy", "qz", "qw", "T"]
    lines = [",".join(header)]
    for k in range(len(t)):
        pose = [f"{v:.9f}" for v in (*r[k], *quaternion[k])] if k % 4 == 0 else [""] * 7
        lines.append(",".join([f"{t[k]:.3f}", *(f"{v:.9f}" for v in q[k]), *pose, f"{20 + t[k]}"]))
    (tmp_path / "t.csv").write_text("\n".join(lines))
    columns = MAP.replace("[x, y, z]", "[x, y, z], unit: m")
    (tmp_path / "map.yaml").write_text(
        columns + "conditions: {temperature: T, payload: 1.5}\nlog: {time: t}"
    )
    data = import_csv(tmp_path / "t.csv", tmp_path / "map.yaml")
    assert len(data) == 12
    np.testing.assert_allclose(data.q, legs_of(data), atol=1e-6)
    np.testing.assert_allclose(data.conditions["temperature"], 20 + data.time, atol=0.02)
    np.testing.assert_array_equal(data.conditions["payload"], [1.5] * 12)
    blank = [lines[0], *(line.rsplit(",", 1)[0] + "," for line in lines[1:])]
    (tmp_path / "t.csv").write_text("\n".join(blank))
    with pytest.raises(ParallelCalError, match=r"t.csv: column T is empty, expected numbers"):
        import_csv(tmp_path / "t.csv", tmp_path / "map.yaml")
    lines[5] = lines[5].replace(f"{quaternion[4][3]:.9f}", "")
    (tmp_path / "t.csv").write_text("\n".join(lines))
    with pytest.raises(ParallelCalError, match=r"t.csv:6: some cells of the pose are empty"):
        import_csv(tmp_path / "t.csv", tmp_path / "map.yaml")


@pytest.mark.parametrize(
    ("clock", "words"),
    [
        ("log: {time: when}", "joints.csv:1: no column when, which states the time of its rows"),
        ("conditions: {time: t}\nlog: {time: t}", "map.yaml:5: conditions.time: a log cannot"),
        ("log: {time: T}", "no column T, which states the time"),
        ("log: {time: t}\njoin: {by: t}", "map.yaml:6: join: log is given as well"),
        ("log: {time: t, unit: min}", "map.yaml:5: log.unit: .*'ms'.*, found 'min'"),
    ],
)
def test_a_wrong_clock_is_an_error_with_file_and_key(logs, clock, words):
    with pytest.raises(ParallelCalError, match=words):
        import_csv(*logs(clock))


def test_times_in_nanoseconds_without_a_unit_are_refused_with_line_and_cure(logs):
    paths, columns = logs()
    lines = paths[0].read_text().split("\n")
    lines[3] = "1700000000000000000" + lines[3][lines[3].index(",") :]
    paths[0].write_text("\n".join(lines))
    words = r"joints.csv:4: column t contains '17.*', which is 1.7e\+18 s, .*unit: ms, us or ns"
    with pytest.raises(ParallelCalError, match=words):
        import_csv(paths, columns)


def test_an_offset_that_motion_does_not_show_must_be_stated(logs):
    paths, columns = logs(offset=100.0, seconds=0.9)
    words = (
        r"the times never overlap: .*joints.csv from 0.000 to .*state it in the column map \(off"
    )
    with pytest.raises(ParallelCalError, match=words):
        import_csv(paths, columns)


def test_clocks_are_compared_where_only_two_coordinates_are_measured(tmp_path):
    """A plotter in a plane, at up to 1.5 m/s, with drives that are not late."""
    plotter = vm.Plotter.drawn(0, lags=(0.0,) * 4)
    vm.write_tables(tmp_path, plotter, vm.Path2D(0, 1.5), vm.Clock(0.08), duration=30.0)
    (tmp_path / "map.yaml").write_text(PLOTTER)
    tables = [tmp_path / "joints.csv", tmp_path / "tracker.csv"]
    data = import_csv(tables, tmp_path / "map.yaml", ReadOptions(mode="continuous"))
    assert data.measured.tolist() == [[True] * 2 + [False] * 4] * len(data)
    offset, margin = offset_in(data)
    assert margin < 5e-3
    assert offset == pytest.approx(0.08, abs=margin)
