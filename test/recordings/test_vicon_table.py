"""A capture exported by Vicon's Tracker or Nexus, beside a log of joint readings."""

import numpy as np
import pytest
from test_motive_table import DWELL, MOVE, OFFSET, STOPS, path_at

from parallel_cal.recordings.csv_import import import_csv
from parallel_cal.recordings.table import read_table

RATE = 100  # Hz


def capture(kind="Objects", unit="mm", hidden=(), after=""):
    """The text of an export of two bodies, in frames counted from 1."""
    axes = ["X", "Y", "Z"] if kind == "Trajectories" else ["RX", "RY", "RZ", "TX", "TY", "TZ"]
    turned = len(axes) - 3
    lines = [
        kind,
        str(RATE),
        ",," + ",".join(["platform:base", *[""] * (len(axes) - 1), "wand:wand"]),
        "Frame,Sub Frame," + ",".join(axes * 2),
        ",," + ",".join([*["deg"] * turned, *[unit] * 3] * 2),
    ]
    time = np.arange(0, len(STOPS) * (DWELL + MOVE), 1 / RATE)
    factor = {"mm": 1e3, "m": 1.0}[unit]
    for k, r in enumerate(path_at(time), start=1):
        cells = [*[0.0] * turned, *factor * r, *[9.0] * len(axes)]
        shown = ["" if k in hidden else f"{c:.9f}" for c in cells]
        lines.append(",".join([str(k), "0", *shown]))
    return "\n".join(lines) + "\n" + after


@pytest.mark.parametrize("kind", ["Objects", "Segments", "Trajectories"])
@pytest.mark.parametrize("unit", ["mm", "m"])
def test_the_header_names_body_axis_and_unit_and_frames_become_times(tmp_path, kind, unit):
    file = tmp_path / "capture.csv"
    # The markers follow as a second table, which is not the first one's.
    file.write_text(
        capture(kind, unit, after="\nTrajectories\n100\n,,a,,\nFrame,Sub Frame,X,Y,Z\n")
    )
    table = read_table(file)
    axis = "X" if kind == "Trajectories" else "TX"
    assert table.header[:3] == ["time", "Frame", "Sub Frame"]
    assert f"platform:base.{axis} [{unit}]" in table.header
    assert f"wand:wand.{axis} [{unit}]" in table.header
    assert table.column("time")[[0, 1]] == pytest.approx([1 / RATE, 2 / RATE])
    shown = table.column(f"platform:base.{axis} [{unit}]")
    assert len(shown) == len(STOPS) * (DWELL + MOVE) * RATE
    assert shown[0] == pytest.approx(STOPS[0, 0] * {"mm": 1e3, "m": 1.0}[unit])
    assert table.lines[0] == 6


def test_a_capture_and_a_log_of_joints_make_samples(tmp_path):
    time = np.arange(0, len(STOPS) * (DWELL + MOVE), 0.01)
    joints = ["time,a,b,c"]
    for t, q in zip(time, path_at(time), strict=True):
        joints.append(",".join(f"{v:.9f}" for v in (t + OFFSET, *q)))
    (tmp_path / "joints.csv").write_text("\n".join(joints))
    (tmp_path / "capture.csv").write_text(capture(hidden=range(10, 30)))
    (tmp_path / "columns.yaml").write_text(
        "joints: {a: {column: a, unit: m}, b: {column: b, unit: m}, c: {column: c, unit: m}}\n"
        "position: {columns: [platform:base.TX, platform:base.TY, platform:base.TZ]}\n"
        "log: {time: time}\n"
    )
    tables = [tmp_path / "joints.csv", tmp_path / "capture.csv"]
    data = import_csv(tables, tmp_path / "columns.yaml")
    np.testing.assert_allclose(data.r, STOPS, atol=1e-6)
    np.testing.assert_allclose(data.q, STOPS, atol=1e-6)


def test_the_table_of_force_plates_that_nexus_writes_in_front_is_passed_over(tmp_path):
    plates = "Devices\n1000\n,,Force - Force,,\nFrame,Sub Frame,Fx,Fy,Fz\n,,N,N,N\n1,0,1,2,3\n\n"
    (tmp_path / "plain.csv").write_text(capture("Trajectories"))
    (tmp_path / "nexus.csv").write_text(plates + capture("Trajectories"))
    plain, nexus = (read_table(tmp_path / name) for name in ("plain.csv", "nexus.csv"))
    assert nexus.header == plain.header
    assert nexus.rows == plain.rows
    assert nexus.lines[0] == plain.lines[0] + 7
