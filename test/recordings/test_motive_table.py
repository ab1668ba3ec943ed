"""A take exported by OptiTrack's Motive, beside a log of joint readings on another clock."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from parallel_cal.recordings.csv_import import import_csv
from parallel_cal.recordings.table import read_table

STOPS = np.array([[0.1, 0.2, 0.3], [0.3, 0.1, 0.2], [0.2, 0.35, 0.1], [0.0, 0.2, 0.2]])
OFFSET = 100.0  # s that the joints' clock is ahead of the cameras' clock
DWELL, MOVE = 1.0, 0.5
COLUMNS = """
joints: {a: {column: a, unit: m}, b: {column: b, unit: m}, c: {column: c, unit: m}}
position: {columns: [platform.Position.X, platform.Position.Y, platform.Position.Z]}
orientation: [platform.Rotation.X, platform.Rotation.Y, platform.Rotation.Z, platform.Rotation.W]
log: {time: time}
"""


def path_at(time):
    """Positions at times (n,): smooth moves between the stops."""
    slot = np.clip((time // (DWELL + MOVE)).astype(int), 0, len(STOPS) - 1)
    s = np.clip((time - slot * (DWELL + MOVE) - DWELL) / MOVE, 0, 1)[:, None]
    blend = s**3 * (10 - 15 * s + 6 * s**2)
    return STOPS[slot] * (1 - blend) + STOPS[np.minimum(slot + 1, len(STOPS) - 1)] * blend


def take(unit="Millimeters", scale=1e3, id_row=True, occluded=()):
    """The text of an export; the platform's marker occurs as measured and as solved."""
    time = np.arange(0, len(STOPS) * (DWELL + MOVE), 0.01)
    lines = [
        f"Format Version,1.23,Take Name,one,Rotation Type,Quaternion,Length Units,{unit}",
        "",
        ",," + ",".join(["Rigid Body"] * 8 + ["Rigid Body Marker"] * 3 + ["Marker"] * 3),
        ",," + ",".join(["platform"] * 8 + ["platform:Marker1"] * 6),
        ",,"
        + ",".join(["Rotation"] * 4 + ["Position"] * 3 + ["Mean Marker Error"])
        + ","
        + ",".join(["Position"] * 6),
        "Frame,Time (Seconds),X,Y,Z,W,X,Y,Z,,X,Y,Z,X,Y,Z",
    ]
    if id_row:
        lines.insert(4, ",," + ",".join(['"4F2A01"'] * 14))
    quaternion = Rotation.from_rotvec([0.1, 0.2, 0.3]).as_quat()
    for k, (t, r) in enumerate(zip(time, path_at(time), strict=True)):
        shown = scale * r
        cells = [*quaternion, *shown, 0.0002, *shown, *shown]
        text = ["" for _ in cells] if k in occluded else [f"{c:.9f}" for c in cells]
        lines.append(",".join([str(k), f"{t:.6f}", *text]))
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize(("unit", "scale"), [("Millimeters", 1e3), ("Meters", 1.0)])
@pytest.mark.parametrize("id_row", [True, False])
def test_the_header_of_a_take_names_body_quantity_axis_and_unit(tmp_path, unit, scale, id_row):
    file = tmp_path / "take.csv"
    file.write_text(take(unit, scale, id_row))
    table = read_table(file)
    short = {"Millimeters": "mm", "Meters": "m"}[unit]
    assert table.header[:3] == ["Frame", "time", "platform.Rotation.X"]
    assert table.header[6] == f"platform.Position.X [{short}]"
    assert f"platform:Marker1.Position.Z [{short}]" in table.header
    assert f"platform:Marker1 (solved).Position.Z [{short}]" in table.header
    assert len(set(table.header)) == len(table.header)
    shown = table.column(f"platform.Position.X [{short}]") / scale
    assert shown[0] == pytest.approx(STOPS[0, 0])
    assert table.lines[0] == 7 + id_row


def test_a_take_and_a_log_of_joints_on_another_clock_make_samples(tmp_path):
    time = np.arange(0, len(STOPS) * (DWELL + MOVE), 0.01)
    joints = ["time,a,b,c"]
    for t, q in zip(time, path_at(time), strict=True):
        joints.append(",".join(f"{v:.9f}" for v in (t + OFFSET, *q)))
    (tmp_path / "joints.csv").write_text("\n".join(joints))
    text = take(occluded=range(10, 30))  # at rest: the markers are hidden for 0.2 s
    (tmp_path / "take.csv").write_text(text)
    (tmp_path / "columns.yaml").write_text(COLUMNS)
    tables = [tmp_path / "joints.csv", tmp_path / "take.csv"]
    data = import_csv(tables, tmp_path / "columns.yaml")
    # A take has many more columns than those of the body.
    assert not any("not used" in note for note in data.warnings)
    assert len(data) == len(STOPS)
    np.testing.assert_allclose(data.r, STOPS, atol=1e-6)
    np.testing.assert_allclose(data.q, STOPS, atol=1e-6)


def test_a_take_that_states_no_unit_is_in_metres(tmp_path):
    """Motive before version 2: its exports have no `Length Units`."""
    (tmp_path / "take.csv").write_text(take("Meters", 1.0).replace(",Length Units,Meters", ""))
    table = read_table(tmp_path / "take.csv")
    assert table.header[6] == "platform.Position.X"
    assert table.assumed_unit == "m"
