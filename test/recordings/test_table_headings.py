"""Tables as programs and people write them are the same samples; or one clear line."""

import numpy as np
import pytest

from parallel_cal.base.errors import DatasetError
from parallel_cal.model.file.modelfile import write_model
from parallel_cal.model.model import new_model
from parallel_cal.model.shelf import load_mechanism
from parallel_cal.recordings.csv_import import import_csv
from parallel_cal.recordings.loading import load_dataset
from parallel_cal.recordings.table import read_table

MAP = """\
joints: {a: {column: j1, unit: rad}, b: {column: j2, unit: rad}}
position: {columns: [x, y, z], unit: mm}
"""
Q = [[0.1, 0.21], [0.2, 0.22], [0.35, 0.3]]
R = [[1.0, 11.0, 2.0], [2.5, 12.0, 2.0], [3.0, -13.0, 2.25]]  # mm
ROWS = [[f"{v:g}" for v in (*q, *r)] for q, r in zip(Q, R, strict=True)]
NAMES = ["j1", "j2", "x", "y", "z"]


def text_of(names=NAMES, apart=",", before="", after="", end="", line_end="\n", rows=ROWS):
    lines = [apart.join(row) + end for row in [names, *rows]]
    return before + line_end.join(lines) + line_end + after


DATA = text_of().split("\n", 1)[1]
SHAPES = {
    "plain": text_of(),
    "savetxt": "# j1,j2,x,y,z\n" + DATA,
    "savetxt without a space": "#j1,j2,x,y,z\n" + DATA,
    "savetxt with spaces": "# j1 j2 x y z\n" + DATA.replace(",", " "),
    "Matlab": "% j1 j2 x y z\n" + DATA.replace(",", "\t").replace("\t", " "),
    "remarks, then savetxt": "# 2026-05-01, lab 3\n# j1,j2,x,y,z\n" + DATA,
    "remarks": text_of(before="# a log, of the arm, on Monday\n#\n"),
    "a title": text_of(before="Calibration of arm 3\nOperator: K. N.\n\n"),
    "spaces": text_of(apart=" "),
    "columns of spaces": text_of(apart="    ", line_end=" \n"),
    "spaces before": text_of(apart="  ").replace("\n", "\n  "),
    "tabs": text_of(apart="\t"),
    "semicolons": text_of(apart=";"),
    "decimal commas": text_of(apart=";").replace(".", ","),
    "decimal commas and spaces": text_of(apart="  ").replace(".", ","),
    "a blank after each comma": text_of(apart=", "),
    "Excel's first line": "sep=;\n" + text_of(apart=";"),
    "a last separator": text_of(end=","),
    "two last separators": text_of(end=",,"),
    "a last separator of the rows": text_of().replace("\n", ",\n").replace("z,\n", "z\n"),
    "empty last lines": text_of(after="\n\n   \n"),
    "lines of separators": text_of(after=",,,,\n,,,,\n"),
    "a last remark": text_of(after="# end of the log\n"),
    "Windows": text_of(line_end="\r\n"),
    "byte order mark": "\ufeff" + text_of(),
    "byte order mark and savetxt": "\ufeff# j1,j2,x,y,z\n" + DATA,
    "quoted": text_of(names=[f'"{name}"' for name in NAMES]),
    "units": text_of(names=["j1 [rad]", "j2 [rad]", "x [mm]", "y (mm)", "z_mm"]),
    "units and spaces": text_of(
        names=["j1 [rad]", "j2 [rad]", "x [mm]", "y [mm]", "z [mm]"], apart=" "
    ),
    "units in a line": text_of(rows=[["rad", "rad", "mm", "mm", "mm"], *ROWS]),
    "units in brackets in a line": text_of(rows=[[*2 * ["[rad]"], *3 * ["[mm]"]], *ROWS]),
    "a heading of two lines": text_of(names=['"j1\n[rad]"', "j2", '"x\n(mm)"', "y", "z"]),
    "unused columns of one name": text_of(
        names=[*NAMES, "note", "note"], rows=[[*row, "p", "q"] for row in ROWS]
    ),
    "unnamed columns": text_of(names=[*NAMES, "", ""], rows=[[*row, "p", "q"] for row in ROWS]),
    "an unnamed column between": text_of(
        names=["j1", "", "", *NAMES[1:]], rows=[[row[0], "p", "q", *row[1:]] for row in ROWS]
    ),
    "a column of numbers": text_of(
        names=["#", *NAMES], rows=[[str(k), *row] for k, row in enumerate(ROWS)]
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", SHAPES)
def test_a_table_is_read_however_it_was_written(tmp_path, name):
    (tmp_path / "map.yaml").write_text(MAP)
    (tmp_path / "t.csv").write_bytes(SHAPES[name].encode("utf-8"))
    data = import_csv(tmp_path / "t.csv", tmp_path / "map.yaml")
    np.testing.assert_allclose(data.q, Q)
    np.testing.assert_allclose(data.r, np.array(R) * 1e-3)


def test_units_below_the_heading_are_those_of_the_columns(tmp_path):
    rows = [["deg", "mrad", "um", "mm", "m"], *ROWS]
    (tmp_path / "t.csv").write_text(text_of(rows=rows))
    (tmp_path / "map.yaml").write_text(
        "joints: {a: {column: j1}, b: {column: j2}}\nposition: {columns: [x, y, z]}\n"
    )
    data = import_csv(tmp_path / "t.csv", tmp_path / "map.yaml")
    np.testing.assert_allclose(data.q, np.array(Q) * [np.pi / 180, 1e-3])
    np.testing.assert_allclose(data.r, np.array(R) * [1e-6, 1e-3, 1.0])


def test_lines_are_counted_as_an_editor_counts_them(tmp_path):
    (tmp_path / "t.csv").write_text("A title\n\n# j1,j2,x,y,z\n" + DATA.replace("12", "1Z"))
    (tmp_path / "map.yaml").write_text(MAP)
    with pytest.raises(DatasetError, match=r"t.csv:5: column y contains '1Z', expected a finite"):
        import_csv(tmp_path / "t.csv", tmp_path / "map.yaml")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (text_of(names=["j1", "j2", "x", "x", "z"]), "t.csv:1: column x occurs 2 times .columns 3"),
        (text_of(names=["j1", "j2", "x [mm]", "x [um]", "z"]), "column x occurs 2 times"),
        (text_of(names=["j1", "j2", "x", "y"]), "t.csv:2: 5 cells, but the header has 4"),
        (text_of(end=",").replace("0.2,", "", 1), "t.csv:3: 4 cells, but the header has 5"),
        ("", "the file is empty; expected a header line"),
        ("# only a remark\n", "expected a header line and rows"),
    ],
)  # fmt: skip
def test_a_table_that_cannot_be_read_is_named(tmp_path, text, words):
    (tmp_path / "t.csv").write_text(text)
    (tmp_path / "map.yaml").write_text(MAP)
    with pytest.raises(DatasetError, match=words):
        import_csv(tmp_path / "t.csv", tmp_path / "map.yaml")


def arm(folder, joints):
    """A table of an arm with these headings of its joints, and its model."""
    model = new_model("delta24")
    write_model(model, folder / "m.yaml")
    rows = [
        ["0.5", "0.55", "0.6", "0.01", "0.02", "0.2"],
        ["0.6", "0.5", "0.55", "0", "0.01", "0.21"],
    ]
    units = [f"{name} [rad]" for name in joints] + ["x [m]", "y [m]", "z [m]"]
    (folder / "t.csv").write_text(text_of(names=units, rows=rows))
    return model


RTDE = ["actual_q_0", "actual_q_1", "actual_q_2"]


@pytest.mark.parametrize("joints", [["j1", "j2", "j3"], RTDE, ["q[3]", "q[1]", "q[2]"]])
def test_joints_that_are_numbered_alike_are_those_of_the_model(tmp_path, joints):
    """As `import-csv` and `fit` read them: from samples, and from the table itself."""
    model = arm(tmp_path, joints)
    columns = ", ".join(f"'{name}': {{column: '{name}'}}" for name in joints)
    (tmp_path / "map.yaml").write_text(f"joints: {{{columns}}}\nposition: {{columns: [x, y, z]}}\n")
    import_csv(tmp_path / "t.csv", tmp_path / "map.yaml").to_json(tmp_path / "s.json")
    order = np.argsort(joints)
    for file in ("s.json", "t.csv"):
        data = load_dataset(tmp_path / file, joints=model.joints)
        assert data.joint_names == model.joints
        np.testing.assert_allclose(data.q[0], np.array([0.5, 0.55, 0.6])[order])
        assert {f"direction.{joint}" for joint in model.joints} <= {*data.conditions}
        assert any("matched by their numbers" in warning for warning in data.warnings)


@pytest.mark.parametrize(
    "joints", [["j1", "j2", "j4"], ["left", "right", "back"], ["j1", "k2", "k3"]]
)
def test_joints_that_are_not_numbered_alike_are_not_guessed(tmp_path, joints):
    model = arm(tmp_path, joints)
    with pytest.raises(DatasetError, match="no columns joint1, joint2, joint3"):
        load_dataset(tmp_path / "t.csv", joints=model.joints)


def planar_table(folder, names):
    rows = [names, *(["100", "120", "10.5", "-400", "0"][: len(names)] for _ in range(3))]
    (folder / "t.csv").write_text("\n".join(map(",".join, rows)))
    return folder / "t.csv"


def test_a_robot_in_the_plane_of_x_and_y_needs_no_column_z(tmp_path):
    """A plotter on two belts, measured by tape."""
    plotter = load_mechanism("cable", anchors=[[-0.5, 0], [0.5, 0]], home=[0, -0.4])
    table = planar_table(tmp_path, ["line1 [mm]", "line2 [mm]", "x [mm]", "y [mm]"])
    data = load_dataset(table, mechanism=plotter)
    np.testing.assert_allclose(data.r[0, :2], [10.5e-3, -0.4])
    assert not data.measured[:, 2:].any()
    table = planar_table(tmp_path, ["line1 [mm]", "line2 [mm]", "x [mm]", "why [mm]"])
    with pytest.raises(DatasetError, match=r"t.csv:1: no columns x, y; the table has"):
        load_dataset(table, mechanism=plotter)


def test_a_robot_that_moves_in_space_needs_x_y_and_z(tmp_path):
    names = ["joint1 [rad]", "joint2 [rad]", "joint3 [rad]", "x [mm]", "y [mm]"]
    with pytest.raises(DatasetError, match="no columns x, y, z; the table has"):
        load_dataset(planar_table(tmp_path, names), mechanism=load_mechanism("delta24"))


def test_two_groups_of_joints_are_not_guessed(tmp_path):
    model = arm(tmp_path, ["q1", "q2", "q3"])
    text = (tmp_path / "t.csv").read_text().splitlines()
    more = ["target1 [rad],target2 [rad],target3 [rad]", "1,2,3", "1,2,3"]
    (tmp_path / "t.csv").write_text("\n".join(map(",".join, zip(text, more, strict=True))))
    with pytest.raises(DatasetError, match="no columns joint1, joint2, joint3"):
        load_dataset(tmp_path / "t.csv", joints=model.joints)


def take(unit=""):
    """A take of Motive with two bodies, whose markers have one name."""
    body = ["Rigid Body"] * 8 + ["Rigid Body Marker"] * 4
    names = ["A"] * 8 + ["1"] * 4, ["B"] * 8 + ["1"] * 4
    quantity = ["Rotation"] * 4 + ["Position"] * 3 + ["Error"] + ["Position"] * 3 + ["Quality"]
    axes = ["X", "Y", "Z", "W", "X", "Y", "Z", "", "X", "Y", "Z", ""]
    first = "Format Version,1.1,Take Name,t" + (f",Length Units,{unit}" if unit else "")
    lines = [
        first,
        "",
        ",," + ",".join(2 * body),
        ",," + ",".join([*names[0], *names[1]]),
        ",," + ",".join(2 * quantity),
        "Frame,Time," + ",".join(2 * axes),
    ]
    for k in range(3):
        one = [0, 0, 0, 1, 0.1 * k, 0.2, 0.3, 0, 9, 9, 9, 1]
        two = [0, 0, 0, 1, 0.5, 0.6, 0.1 * k, 0, 8, 8, 8, 1]
        lines.append(",".join(map(str, [k, 0.01 * k, *one, *two])))
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize(("unit", "scale"), [("", 1.0), ("Millimeters", 1e-3)])
def test_markers_of_one_name_do_not_matter_beside_two_bodies(tmp_path, unit, scale):
    (tmp_path / "take.csv").write_text(take(unit))
    (tmp_path / "joints.csv").write_text("time,a [rad]\n0,0.1\n0.01,0.2\n0.02,0.3\n")
    for body, expected in (("A", [0.1, 0.2, 0.3]), ("B", [0.5, 0.6, 0.1])):
        columns = ", ".join(f"{body}.Position.{axis}" for axis in "XYZ")
        (tmp_path / "map.yaml").write_text(
            f"joints: {{a: {{column: a}}}}\nposition: {{columns: [{columns}]}}\n"
            "join: {by: time, within: 0.001, offset: 0.0}\n"
        )
        data = import_csv([tmp_path / "joints.csv", tmp_path / "take.csv"], tmp_path / "map.yaml")
        np.testing.assert_allclose(data.r[1], np.array(expected) * scale)
        assert any("states no unit" in warning for warning in data.warnings) == (not unit)
    with pytest.raises(DatasetError, match=r"column 1 \(solved\).Position.X occurs 2 times"):
        read_table(tmp_path / "take.csv").find("1 (solved).Position.X")
