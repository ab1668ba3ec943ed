"""A CSV table and a column map become samples that every command takes; or one clear line."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest

import parallel_cal as pc
from parallel_cal.base.errors import DatasetError, ParallelCalError
from parallel_cal.cli import main as cli
from parallel_cal.cli.recordings import data_options
from parallel_cal.model.file.modelfile import dump_model, read_model
from parallel_cal.model.model import new_model
from parallel_cal.recordings.csv_import import import_csv
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.recordings.header_names import map_by_names
from parallel_cal.recordings.joining import join_datasets
from parallel_cal.recordings.loading import load_dataset, load_sessions
from parallel_cal.recordings.table import read_table
from parallel_cal.recordings.table_samples import make_dataset
from parallel_cal.session.session import Session

TABLE = """\
number,a_deg,b_mm,x,y,z,qx,qy,qz,qw,T,visit
1,90,100,1000,-2000,500,0,0,0,1,21.5,home

2,-180,0,0,0,0,0,0,0.70710678,0.70710678,22.5,corner
3,45,-20,1,2,3,1,0,0,0,23,home
"""
MAP = """\
joints:
  arm: {column: a_deg, unit: deg}
  slide: {column: b_mm, unit: mm}
position: {columns: [x, y, z], unit: mm}
orientation: [qx, qy, qz, qw]
conditions: {temperature: T, payload: 1.5}
group: visit
noise: {joint: 1.0e-4, position: 2.0e-5, orientation: 3.0e-5}
"""


@pytest.fixture
def files(tmp_path):
    """files(table, map): their paths."""

    def write(table=TABLE, columns=MAP):
        (tmp_path / "t.csv").write_text(table)
        (tmp_path / "map.yaml").write_text(columns)
        return tmp_path / "t.csv", tmp_path / "map.yaml"

    return write


def test_columns_become_samples_in_si(files):
    table, columns = files()
    data = import_csv(table, columns)
    assert data.joint_names == ("arm", "slide")
    np.testing.assert_allclose(data.q, [[np.pi / 2, 0.1], [-np.pi, 0], [np.pi / 4, -0.02]])
    np.testing.assert_allclose(data.r, [[1, -2, 0.5], [0, 0, 0], [1e-3, 2e-3, 3e-3]])
    np.testing.assert_allclose(data.R[1], [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-12)
    np.testing.assert_allclose(data.R[2], np.diag([1, -1, -1]), atol=1e-12)
    assert data.measured.all()
    visits = {f"{name}.{joint}" for name in ("direction", "travel") for joint in ("arm", "slide")}
    assert set(data.conditions) == {"temperature", "payload"} | visits  # rows have no time
    np.testing.assert_array_equal(data.conditions["temperature"], [21.5, 22.5, 23])
    np.testing.assert_array_equal(data.conditions["payload"], [1.5, 1.5, 1.5])
    assert data.pose_id[0] == data.pose_id[2] != data.pose_id[1]
    np.testing.assert_array_equal(data.joint_sigma, [1e-4, 1e-4])
    np.testing.assert_allclose(np.sqrt(np.diag(data.pose_cov[0])), [2e-5] * 3 + [3e-5] * 3)


def test_another_column_map_makes_other_samples_of_the_same_table(files):
    """A model that was fitted to the first ones was not fitted to the others."""
    data, again = (import_csv(*files()) for _ in range(2))
    assert len(data.sha256) == 64
    assert again.sha256 == data.sha256
    other = MAP.replace("b_mm, unit: mm", "b_mm, factor: 2, unit: mm")
    assert other != MAP
    assert import_csv(*files(columns=other)).sha256 != data.sha256


def test_samples_are_the_same_whatever_noise_is_stated_and_in_whatever_unit(files):
    """An error at them is in-sample, whoever wrote the column map."""
    data = import_csv(*files())
    noisier = MAP.replace("position: 2.0e-5", "position: 4.0e-5")
    assert import_csv(*files(columns=noisier)).sha256 == data.sha256
    in_m = TABLE.replace("1000,-2000,500", "1,-2,0.5").replace("1,2,3,1", "0.001,0.002,0.003,1")
    again = import_csv(*files(in_m, MAP.replace("[x, y, z], unit: mm", "[x, y, z], unit: m")))
    np.testing.assert_allclose(again.r, data.r)
    assert again.sha256 == data.sha256


def test_recordings_whose_noise_differs_in_the_last_digit_are_joined(files):
    data = import_csv(*files())
    other = replace(data, sha256="another", joint_sigma=data.joint_sigma * (1 - 1e-16 * 3))
    assert not np.array_equal(other.joint_sigma, data.joint_sigma)
    assert len(join_datasets([data, other])) == 6
    with pytest.raises(DatasetError, match="joint_sigma is "):
        join_datasets([data, replace(other, joint_sigma=1.01 * data.joint_sigma)])


def test_samples_have_the_names_of_their_rows(files, tmp_path):
    table, columns = files(columns=MAP + "name: visit\n")
    data = import_csv(table, columns)
    assert data.names == {0: "home", 1: "corner", 2: "home"}
    assert data.title(1) == "1 'corner'"
    kept = data.excluding({1: "touched"})
    assert kept.names == data.names  # samples keep their numbers, and excluded ones their names
    assert data.select([2, 1]).names == {0: "home", 1: "corner"}  # numbered anew
    data.to_json(tmp_path / "samples.json")
    assert Dataset.from_json(tmp_path / "samples.json").names == data.names
    other = replace(data, sha256="another", names={1: "again"})
    assert join_datasets([data, other]).names == {0: "home", 1: "corner", 2: "home", 4: "again"}
    without = import_csv(table, files(TABLE, MAP.replace("group: visit\n", ""))[1])
    assert without.names == {}  # a column map names all columns that count


def test_tables_and_messages_show_the_names_of_samples(tmp_path):
    model = pc.read_model("config/delta_mockup_nominal.yaml")
    known = pc.simulate(model, 30, seed=1).dataset()
    known.r[7] += 5e-3
    header = [f"{joint} [rad]" for joint in model.joints] + ["x [m]", "y [m]", "z [m]", "Shot"]
    rows = [
        [*map(repr, map(float, (*q, *r))), f"S{k + 1}"]
        for k, (q, r) in enumerate(zip(known.q, known.r, strict=True))
    ]
    table = tmp_path / "t.csv"
    table.write_text("\n".join(",".join(row) for row in (header, *rows)))
    data = pc.load_dataset(table, joints=model.joints)
    assert data.names[7] == "S8"
    assert not any("Shot" in words for words in data.warnings)
    shown = pc.show(pc.compare(model, data))
    assert re.search(r"^ +7 +S8 ", shown, flags=re.MULTILINE)
    assert "odd: sample 7 'S8' at" in shown


def test_a_motors_angle_becomes_the_travel_of_its_joint(files):
    """Revolutions, or degrees, of a motor that moves its joint by so much a revolution."""
    moved = MAP.replace(
        "slide: {column: b_mm, unit: mm}", "slide: {column: a_deg, per_rev: -72 mm}"
    )
    data = import_csv(*files(columns=moved))
    np.testing.assert_allclose(data.q[:, 1], [-0.018, 0.036, -0.009], atol=1e-12)
    geared = MAP.replace(
        "arm: {column: a_deg, unit: deg}", "arm: {column: n, unit: rev, per_rev: 36 deg}"
    )
    data = import_csv(*files(TABLE.replace("number", "n"), geared))
    np.testing.assert_allclose(data.q[:, 0], np.radians([36, 72, 108]))


@pytest.mark.parametrize("way", ["72", "72 furlong", "mm", "0 mm", "nan mm", "72mm"])
def test_an_invalid_travel_per_revolution_is_refused_with_line_and_key(files, way):
    columns = MAP.replace("unit: deg}", f"unit: deg, per_rev: '{way}'}}")
    words = r"map.yaml:2: joints.arm.per_rev: .*expected a number and a unit, as in 71.2 mm"
    with pytest.raises(ParallelCalError, match=words):
        import_csv(*files(columns=columns))


def test_a_length_is_no_motors_angle(files):
    columns = MAP.replace("unit: mm}\nposition", "unit: mm, per_rev: 72 mm}\nposition")
    words = "t.csv:1: column b_mm is in mm, but .*map.yaml has per_rev 72 mm, which needs an angle"
    with pytest.raises(ParallelCalError, match=words):
        import_csv(*files(columns=columns))


def test_what_the_map_does_not_name_is_not_measured(files):
    kept = [line for line in MAP.splitlines() if line.split(":")[0] not in ("orientation", "noise")]
    data = import_csv(*files(columns="\n".join(kept)))
    np.testing.assert_array_equal(data.measured, np.tile([True] * 3 + [False] * 3, (3, 1)))
    assert np.isnan(data.pose_cov).all()
    assert data.joint_sigma is None


def test_a_coordinate_without_a_column_is_not_measured(files):
    data = import_csv(*files(columns=MAP.replace("[x, y, z]", "[x, null, z]")))
    assert data.measured.tolist() == [[True, False, True, True, True, True]] * 3
    np.testing.assert_allclose(data.r, [[1, 0, 0.5], [0, 0, 0], [1e-3, 0, 3e-3]])


@pytest.mark.parametrize("columns", ["[x, y]", "[null, null, null]", "x"])
def test_a_position_of_two_columns_is_refused_with_what_to_write(files, columns):
    given = files(columns=MAP.replace("[x, y, z]", columns))
    with pytest.raises(ParallelCalError, match=r"map.yaml:4: position.columns: expected .* null\]"):
        import_csv(*given)


def test_orientations_alone_are_a_measurement(files):
    data = import_csv(*files(columns=MAP.replace("position: {columns: [x, y, z], unit: mm}", "")))
    np.testing.assert_array_equal(data.measured, np.tile([False] * 3 + [True] * 3, (3, 1)))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            ("T,visit\n", "temp,visit\n"),
            "t.csv:1: no column T, which .*map.yaml names; the table "
            "has number, a_deg, .*, temp, visit",
        ),
        ((",100,", ",,"), "t.csv:2: column b_mm contains '', expected a finite number"),
        ((",22.5,", ",nan,"), "t.csv:4: column T contains 'nan'"),
        ((",22.5,", ",cold,"), "t.csv:4: column T contains 'cold'"),
        ((",23,home", ",23"), "t.csv:5: 11 cells, but the header has 12"),
        ((",1,0,0,0,", ",1,1,0,0,"), "t.csv:5: .* are a quaternion of length 1.414, expected"),
        ((",1,0,0,0,", ",1e-200,0,0,0,"), "t.csv:5: .* are a quaternion of length 0, expected 1"),
        ((",23,home", ',"2\n3",home'), r"t.csv:6: column T contains '2\\n3', expected a finite"),
        ((",22.5,", ",1_000,"), "t.csv:4: column T contains '1_000'"),
        ((",22.5,", ',"22,5",'), "column T contains '22,5', .*decimal comma needs a semicolon"),
        (("number,a_deg", "x,a_deg"), "t.csv:1: column x occurs 2 times"),
        ((TABLE, "a,b\n"), "t.csv: no rows below the header 'a,b'; expected a header line"),
    ],
)
def test_a_bad_table_is_named_by_file_line_and_column(files, change, words):
    with pytest.raises(ParallelCalError, match=words):
        import_csv(*files(table=TABLE.replace(*change)))


def test_all_bad_cells_of_a_table_are_named_at_once(files):
    """Cells of joints, positions and conditions, of which the first five others are named."""
    lines = TABLE.splitlines()
    bad = TABLE.replace(",100,", ",,").replace(",22.5,", ",cold,")
    with pytest.raises(ParallelCalError, match="column b_mm contains ''") as told:
        import_csv(*files(table=bad))
    assert str(told.value).endswith(
        "expected a finite number. 2 cells have this fault, also line 4 column T ('cold'): enter "
        "numbers or remove the lines"
    )
    column = lines[0].split(",").index("T")
    rows = [[*line.split(",")] for line in lines[1:] * 4 if line]
    for row in rows:
        row[column] = "?"
    with pytest.raises(ParallelCalError, match=rf"{len(rows)} cells have this fault, .*more:"):
        import_csv(*files(table="\n".join([lines[0], *map(",".join, rows)])))


def test_all_lines_that_lack_a_cell_are_named_at_once(files):
    lines = TABLE.splitlines()
    short = [line.rsplit(",", 1)[0] for line in lines[1:]]
    words = r"11 cells, but the header has 12 \(3 lines have this fault, also 4, 5\)"
    with pytest.raises(ParallelCalError, match=words):
        import_csv(*files(table="\n".join([lines[0], *short])))


def test_a_decimal_comma_that_splits_cells_hides_no_other_bad_cell(files):
    lines = [line for line in [*TABLE.splitlines(), *TABLE.splitlines()[1:]] if line]
    first, *rest = lines[1].split(",")
    lines[1] = ",".join([f"{first},5", *rest])
    column = lines[0].split(",").index("T")
    for k, text in ((2, "n/a"), (5, '"21,5"')):
        cells = lines[k].split(",")
        cells[column] = text
        lines[k] = ",".join(cells)
    with pytest.raises(ParallelCalError) as told:
        import_csv(*files(table="\n".join(lines)))
    assert str(told.value).endswith(
        "t.csv:2: 13 cells, but the header has 12. Cells of other lines are no numbers: line 3 "
        "column T ('n/a'), line 6 column T ('21,5'). A decimal comma needs a semicolon or a tab "
        "between the cells"
    )


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("unit: deg", "unit: degree"), "map.yaml:2: joints.arm.unit: .*'deg'.*, found 'degree'"),
        (("z], unit: mm", "z], unit: inch"), "map.yaml:4: position.unit: .*'mm'.*, found 'inch'"),
        (("z], unit: mm", "z]"), "t.csv:1: column x has no unit; state it in .*map.yaml"),
        (("[x, y, z]", "[x, y]"), "map.yaml:4: position.columns: expected the columns of x"),
        (
            ("temperature: T", "temprature: T"),
            "map.yaml:6: conditions.temprature: unknown "
            "condition; expected one of time, temperature, .*direction.JOINT",
        ),
        (
            ("group:", "groups:"),
            r"map.yaml:7: groups: unknown key; did you mean 'group'\?; expected one of joints, pos",
        ),
        (
            ("z], unit: mm", "z], scale: 2"),
            "map.yaml:4: position.scale: unknown key; expected one of columns, unit$",
        ),
        (
            ("a_deg, unit: deg", "a_deg, gear: 2"),
            "map.yaml:2: joints.arm.gear: unknown key; expected one of unit, factor, per_rev, col",
        ),
        (
            ("noise: {joint: 1.0e-4", "matrix: [a, b, c, d, e, f, g, h, i]\nnoise: {joint: 1.0e-4"),
            "map.yaml:8: matrix: orientation is given as well: remove one of the two",
        ),
        (("joint: 1.0e-4", "joint: -1"), "map.yaml:8: noise.joint: expected 0 or more"),
        ((MAP, "joints: {a: {column: a_deg, unit: deg}}"), "neither position nor orientation"),
    ],
)
def test_a_bad_map_is_named_by_file_line_and_key(files, change, words):
    with pytest.raises(ParallelCalError, match=words):
        import_csv(*files(columns=MAP.replace(*change)))


MOCAP = "timestamp,L1,L2,px,py,pz,QX,QY,QZ,QW"
ROWS = ("1764200005.5,-12.5,3,115,969,1443,0,0,0,1", "1764200010,14,-7,73,973,1435,0,0,1,0")


def write_mocap(folder, header=MOCAP):
    path = folder / "mocap.csv"
    path.write_text("\n".join([header, *ROWS]) + "\n")
    return path


def test_a_header_without_units_is_answered_with_a_map_that_reads_the_table(tmp_path):
    path = write_mocap(tmp_path)
    with pytest.raises(DatasetError) as error:
        load_dataset(path, joints=("leg1", "leg2"))
    words = str(error.value)
    assert words.startswith(f"{path}:1: columns L1, L2, px, py, pz have no unit. Write it into the")
    (tmp_path / "mocap.columns.yaml").write_text(words[words.index("{joints") :])
    data = load_dataset(path, joints=("leg1", "leg2"))
    # Angles beyond a turn of rad, and lengths beyond 5 m, are usually in deg and mm.
    np.testing.assert_allclose(data.q[0], np.radians([-12.5, 3]))
    np.testing.assert_allclose(data.r[0], [0.115, 0.969, 1.443])
    assert data.measured.all()
    assert data.time[1] - data.time[0] == pytest.approx(4.5)


@pytest.mark.parametrize(
    "words", [("X", "Y", "Z"), ("tx", "ty", "tz"), ("Pos_X", "pos_y", "pos_z")]
)
def test_positions_are_found_by_their_usual_names(tmp_path, words):
    header = ",".join(["j1 [rad]", *(f"{word} [mm]" for word in words)])
    table = write(tmp_path, f"{header}\n0.1,1,2,3\n")
    assert map_by_names(table, ["j1"], tmp_path / "m.yaml").position.names == [*words]


def test_coordinates_under_names_of_several_kinds_are_no_position(tmp_path):
    table = write(tmp_path, "j1 [rad],x [mm],py [mm],tz [mm]\n0.1,1,2,3\n")
    with pytest.raises(DatasetError, match="no columns x, y, z"):
        map_by_names(table, ["j1"], tmp_path / "m.yaml")


def test_a_joint_is_no_position_and_a_date_is_no_time(tmp_path):
    table = write(tmp_path, "x [mm],X [mm],Y [mm],Z [mm],timestamp\n1,2,3,4,2026-11-29\n")
    found = map_by_names(table, ["x"], tmp_path / "m.yaml")
    assert found.position.names == ["X", "Y", "Z"]
    assert not found.conditions


def test_a_table_of_touches_names_the_command_that_knows_the_joints(tmp_path):
    table = write(tmp_path, "X,Y,Z\n10,20,0.1\n")
    with pytest.raises(DatasetError, match=r"import rrf .*t.csv config.g -o touches.json"):
        map_by_names(table, ["joint1", "joint2"], tmp_path / "m.yaml")


def write(folder, text):
    (folder / "t.csv").write_text(text)
    return read_table(folder / "t.csv")


HEADED = "arm [deg],x [mm],y [mm],z [mm],temperature [K],payload (g),time_ms,direction.arm\n"


def test_conditions_in_a_header_are_recorded_in_si(tmp_path):
    path = tmp_path / "t.csv"
    path.write_text(HEADED + "90,1,2,3,293.15,1500,0,1\n0,1,2,3,294.15,0,2500,-1\n")
    table = read_table(path)
    data = make_dataset([table], map_by_names(table, ["arm"], tmp_path / "m.yaml"), "the header")
    np.testing.assert_allclose(data.conditions["temperature"], [20, 21])
    np.testing.assert_allclose(data.conditions["payload"], [1.5, 0])
    np.testing.assert_allclose(data.conditions["time"], [0, 2.5])
    np.testing.assert_allclose(data.conditions["direction.arm"], [1, -1])


def test_a_condition_of_a_map_has_the_unit_of_its_header(files):
    data = import_csv(*files(TABLE.replace("T,visit", "T [degF],visit").replace("21.5", "68")))
    assert data.conditions["temperature"][0] == pytest.approx(20)


@pytest.mark.parametrize(("unit", "per_second"), [("s", 1), ("ms", 10**3), ("ns", 10**9)])
def test_times_since_1970_tell_their_unit_by_their_size(unit, per_second, tmp_path):
    path = tmp_path / "data.csv"
    rows = [f"{k},0.{k},0,0,{(1_700_000_000 + 20 * k) * per_second},ok" for k in range(4)]
    path.write_text("\n".join(["joint1 [m],x [m],y [m],z [m],time,remark", *rows]) + "\n")
    data = load_dataset(path, joints=("joint1",))
    assert data.time - data.time[0] == pytest.approx([0.0, 20.0, 40.0, 60.0])
    said = f"column time states no unit; its numbers are times since 1970 in {unit}"
    assert any(said in note for note in data.warnings) == (unit != "s")
    assert f"{path}: columns that are not used: remark" in data.warnings
    if unit != "s":
        path.write_text(path.read_text().replace("time,", "time [s],"))
        with pytest.raises(ParallelCalError, match=rf"no times in s: .* \(time \[{unit}\]\)"):
            load_dataset(path, joints=("joint1",))


@pytest.mark.parametrize(
    ("word", "words"),
    [
        ("temperature [bar]", r"t.csv:1: column temperature \[bar\]: 'bar' is no unit of temp.* K"),
        ("temperature [mm]", "is in mm, but temperature is in degC: expected one of degC, K, degF"),
    ],
)
def test_a_wrong_unit_of_a_condition_is_refused(word, words, tmp_path):
    path = tmp_path / "t.csv"
    path.write_text(HEADED.replace("temperature [K]", word) + "90,1,2,3,293.15,1500,0,1\n")
    table = read_table(path)
    with pytest.raises(DatasetError, match=words):
        make_dataset([table], map_by_names(table, ["arm"], tmp_path / "m.yaml"), "the header")


ROTATIONS = (
    # A quarter turn about z, half a turn about x, and a turn of 120 degrees about (1, 1, 1).
    "0,0,1.5707963267948966,0,-1,0,1,0,0,0,0,1\n"
    "3.141592653589793,0,0,1,0,0,0,-1,0,0,0,-1\n"
    "1.2091995761561452,1.2091995761561452,1.2091995761561452,0,0,1,1,0,0,0,1,0\n"
)


@pytest.mark.parametrize(
    "orientation",
    [
        "rotation_vector: {columns: [u, v, w], unit: rad}",
        "matrix: [r11, r12, r13, r21, r22, r23, r31, r32, r33]",
    ],
)
def test_rotation_vectors_and_matrices_are_orientations(files, orientation):
    header = "a,u,v,w,r11,r12,r13,r21,r22,r23,r31,r32,r33\n"
    rows = [f"{k},{line}" for k, line in enumerate(ROTATIONS.splitlines())]
    joints = "joints: {arm: {column: a, unit: deg}}\n"
    data = import_csv(*files(header + "\n".join(rows) + "\n", joints + orientation + "\n"))
    np.testing.assert_allclose(data.R[0], [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-12)
    np.testing.assert_allclose(data.R[1], np.diag([1, -1, -1]), atol=1e-12)
    np.testing.assert_allclose(data.R[2], [[0, 0, 1], [1, 0, 0], [0, 1, 0]], atol=1e-12)


def test_nine_numbers_that_are_no_rotation_are_refused(files):
    header, names = "a,b,c,d,e,f,g,h,i,j\n", "[b, c, d, e, f, g, h, i, j]"
    columns = f"joints: {{arm: {{column: a, unit: deg}}}}\nmatrix: {names}\n"
    with pytest.raises(DatasetError, match=r"t.csv:2: b, .* are no rotation matrix"):
        import_csv(*files(f"{header}0,1,0,0,0,1,0,0,0,-1\n", columns))


SHORT = "joints: {arm: {column: arm}, slide: {column: slide}}\n"


@pytest.mark.parametrize("apart", [",", ";", "\t"])
def test_units_of_the_header_are_taken_whatever_stands_between_cells(files, apart):
    rows = [
        ["arm [deg]", "slide_mm", "x (mm)", "y/um", "z in"],
        [90, 100, 1, 2, 1],
        [0, 5, 6, 7, 8],
    ]
    table = "# written by a tracker\n" + "\n".join(apart.join(map(str, row)) for row in rows)
    data = import_csv(*files(table, SHORT + "position: {columns: [x, y, z]}"))
    np.testing.assert_allclose(data.q[0], [np.pi / 2, 0.1])
    np.testing.assert_allclose(data.r[0], [1e-3, 2e-6, 0.0254])


def test_a_comma_may_be_the_decimal_point_where_another_character_separates_cells(files):
    table = "arm_deg;slide_mm;x_mm;y_mm;z_mm\n1,5;2,25;-0,5;0;1e-1\n"
    data = import_csv(*files(table, SHORT + "position: {columns: [x, y, z]}"))
    np.testing.assert_allclose(data.q[0], [np.radians(1.5), 2.25e-3])
    np.testing.assert_allclose(data.r[0], [-5e-4, 0, 1e-4])


GERMAN = "arm [°];slide [µm];x_mm;y_mm;z_mm\r\n1,5;2,25;-0,5;0;1e-1\r\n"


@pytest.mark.parametrize(
    "content",
    [
        GERMAN.encode("latin-1"),
        GERMAN.encode(),
        GERMAN.encode("utf-8-sig"),
        GERMAN.encode("utf-16"),
        GERMAN.replace("\r\n", "\r").encode("latin-1"),
        GERMAN.replace("arm [°]", '"arm\r\n[°]"').encode("cp1252"),
    ],
)
def test_encodings_and_line_ends_of_windows_programs_are_read(files, tmp_path, content):
    table, columns = files("", SHORT + "position: {columns: [x, y, z]}")
    table.write_bytes(content)
    data = import_csv(table, columns)
    np.testing.assert_allclose(data.q, [[np.radians(1.5), 2.25e-6]])
    np.testing.assert_allclose(data.r, [[-5e-4, 0, 1e-4]])


def test_a_file_that_is_not_text_is_refused(files):
    table, columns = files()
    table.write_bytes(b"\x89PNG\r\n\x1a\n\x00\xff")
    with pytest.raises(ParallelCalError, match=r"t.csv: not a CSV table: it is not text"):
        import_csv(table, columns)


def test_thousands_separators_are_refused_with_both_cells_and_lines(files):
    table = "arm_deg;slide_mm;x_mm;y_mm;z_mm\n1;2;3;4;0.5\n1;2;3;4;1,234\n"
    words = "t.csv:3: column z_mm contains '1,234', but '0.5' in line 2: .* thousands separators"
    with pytest.raises(ParallelCalError, match=words):
        import_csv(*files(table, SHORT + "position: {columns: [x, y, z]}"))


def test_a_unit_that_the_header_contradicts_is_refused(files):
    table = "arm_deg,slide_mm,x_mm,y_mm,z_mm\n1,2,3,4,5\n"
    with pytest.raises(
        ParallelCalError, match=r"t.csv:1: column x_mm is in mm, .*map.yaml states m$"
    ):
        import_csv(*files(table, SHORT + "position: {columns: [x, y, z], unit: m}"))


def test_readings_alone_are_a_measurement_and_an_empty_cell_is_not(files):
    table = "arm_deg,slide_mm,gauge_um\n1,2,30\n3,4,\n"
    data = import_csv(*files(table, SHORT + "readings: {probe: {column: gauge}}"))
    np.testing.assert_allclose(data.conditions["reading.probe"], [3e-5, np.nan])
    assert not data.measured.any()


def test_three_angles_turn_as_their_axes_say(files):
    table = "arm_deg,slide_mm,a_deg,b_deg,c_deg\n0,0,90,0,90\n"
    fixed, turned = (
        import_csv(*files(table, SHORT + f"angles: {{columns: [a, b, c], axes: {axes}}}")).R[0]
        for axes in ("xyz", "XYZ")
    )
    x, z = (
        np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]]),
        np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]]),
    )
    np.testing.assert_allclose(fixed, z @ x, atol=1e-12)
    np.testing.assert_allclose(turned, x @ z, atol=1e-12)


@pytest.fixture
def two(files, tmp_path):
    """two(joints, poses, join): the dataset of two tables."""

    def read(joints, poses, join):
        _, columns = files(columns=SHORT + f"position: {{columns: [x, y, z]}}\n{join}")
        (tmp_path / "joints.csv").write_text("no,t,arm_deg,slide_mm\n" + joints)
        (tmp_path / "poses.csv").write_text("no,t,x_mm,y_mm,z_mm\n" + poses)
        return import_csv([tmp_path / "joints.csv", tmp_path / "poses.csv"], columns)

    return read


def test_tables_are_joined_by_an_index_and_rows_without_a_partner_are_reported(two):
    data = two(
        "3,0,30,3\n1,0,10,1\n2,0,20,2\n", "1,0,1,1,1\n2,0,2,2,2\n4,0,4,4,4\n", "join: {by: no}"
    )
    np.testing.assert_allclose(data.r[:, 0] / data.q[:, 1], [1, 1])
    words = sorted(one.detail.rsplit("/", 1)[1] for one in data.dropped)
    assert words == [
        "joints.csv:2: no other table has its no",
        "poses.csv:4: no other table has its no",
    ]


def test_tables_are_joined_by_the_nearest_time_within_reach(two):
    log = "".join(f"{k},{0.1 * k},{k},{k}\n" for k in range(50))
    data = two(log, "1,1.02,10,0,0\n2,3.96,40,0,0\n3,9,99,0,0\n", "join: {by: t, within: 0.06}")
    np.testing.assert_allclose(data.q[:, 1], [0.010, 0.040])
    np.testing.assert_allclose(data.r[:, 0], [0.010, 0.040])
    [dropped] = data.dropped
    assert "poses.csv:4" in dropped.detail


@pytest.mark.parametrize(
    ("join", "words"),
    [
        ("", "3 rows in .*joints.csv and 2 rows in .*poses.csv: state in the column map how"),
        ("join: {by: visit}", "joints.csv:1: no column visit to join by"),
        ("join: {by: t}", "joints.csv:3: t 0 occurs twice"),
        ("join: {by: no, within: 0}", "join.within: "),
    ],
)
def test_tables_that_cannot_be_joined_are_reported(two, join, words):
    with pytest.raises(ParallelCalError, match=words):
        two("1,0,1,1\n2,0,2,2\n3,2,3,3\n", "1,0,1,1,1\n2,1,2,2,2\n", join)


def test_tables_without_a_key_are_matched_row_by_row_and_this_is_stated(two):
    data = two("1,0,10,1\n2,0,20,2\n", "7,5,1,1,1\n8,6,2,2,2\n", "")
    np.testing.assert_allclose(data.r[:, 0] / data.q[:, 1], [1, 1])
    assert any("joints.csv and " in w and "were matched row by row" in w for w in data.warnings)


VISITS = "arm_deg,slide_mm,x_mm,y_mm,z_mm\n" + "".join(
    f"{arm},{slide},{k},0,0\n" for k, (arm, slide) in enumerate([(0, 5), (10, 5), (30, 2), (25, 9)])
)


def test_directions_and_travels_follow_the_order_of_visits_and_this_is_stated(files):
    data = import_csv(*files(VISITS, SHORT + "position: {columns: [x, y, z]}"))
    np.testing.assert_array_equal(data.conditions["direction.arm"], [0, 1, 1, -1])
    np.testing.assert_allclose(data.conditions["travel.arm"], np.radians([0, 10, 30, -5]))
    np.testing.assert_array_equal(data.conditions["direction.slide"], [0, 0, -1, 1])
    np.testing.assert_allclose(data.conditions["travel.slide"], [0, 0, -3e-3, 7e-3], atol=1e-15)
    [note] = data.warnings
    assert "the joints came were taken from the order of the rows: if it is not that of" in note
    assert note.endswith("state visits: unordered, or columns direction.JOINT")


def test_what_several_recordings_share_is_stated_once_with_their_names(files, tmp_path):
    one = import_csv(*files(VISITS, SHORT + "position: {columns: [x, y, z]}"))
    other = replace(
        one,
        sha256="another",
        source="second.csv",
        warnings=tuple(w.replace(one.source, "second.csv") for w in one.warnings),
    )
    own = replace(one, sha256="third", source="third.csv", warnings=("third.csv: too short",))
    note, third = join_datasets([one, other, own]).warnings
    assert note.startswith(f"{one.source}, second.csv: the sides from which the joints came were")
    assert note.count("the joints came were taken") == 1
    assert third == "third.csv: too short"


def test_the_time_of_visits_counts_and_not_the_order_of_rows(files):
    header, *rows = VISITS.splitlines()
    table = "\n".join([header + ",t", *[f"{row},{k}" for k, row in enumerate(rows)][::-1]])
    columns = SHORT + "position: {columns: [x, y, z]}\nconditions: {time: t}"
    data = import_csv(*files(table, columns))
    np.testing.assert_array_equal(data.conditions["direction.arm"], [-1, 1, 1, 0])


@pytest.mark.parametrize("more", ["visits: unordered", "conditions: {direction.arm: 1}"])
def test_no_direction_is_taken_from_rows_without_order_or_beside_a_recorded_one(files, more):
    data = import_csv(*files(VISITS, SHORT + "position: {columns: [x, y, z]}\n" + more))
    assert not data.warnings
    assert {*data.conditions} <= {"direction.arm"}


def test_counts_become_lengths_by_a_factor_a_travel_and_an_offset(files):
    moved = MAP.replace(
        "slide: {column: b_mm, unit: mm}",
        "slide: {column: count, unit: rev, factor: 0.00025, per_rev: -5 mm, offset: 12.5 mm}",
    )
    data = import_csv(*files(TABLE.replace("number", "count").replace("\n1,", "\n8000,"), moved))
    np.testing.assert_allclose(data.q[0, 1], 0.0125 - 2 * 0.005)
    assert data.joint_units == ("rad", "m")


@pytest.mark.parametrize(
    ("entry", "words"),
    [
        ("unit: mm, offset: 3 deg", "t.csv:1: column b_mm gives a joint in m, but .* offset 3 deg"),
        ("unit: mm, offset: 3", "slide.offset: .*'3': expected a number and a unit"),
        ("unit: mm, factor: 0", "slide.factor: .*expected a number other than 0"),
    ],
)
def test_a_wrong_factor_or_offset_is_refused(files, entry, words):
    with pytest.raises(ParallelCalError, match=words):
        import_csv(*files(columns=MAP.replace("b_mm, unit: mm", f"b_mm, {entry}")))


def test_a_joint_may_be_a_sum_of_columns_with_factors(files):
    """J3 counted from the horizontal, a differential wrist, and a ball screw with a spline."""
    table = "J2_deg,J3_deg,m5_rad,m6_rad,nut_rev,spline_deg,x_m,y_m,z_m\n10,25,0.5,0.1,3,90,0,0,1\n"
    columns = """\
joints:
  joint2: {column: J2_deg}
  joint3: {J3_deg: 1, J2_deg: 1}
  bend: {columns: {m5_rad: 0.5, m6_rad: 0.5}}
  roll: {columns: {m5_rad: 0.5, m6_rad: -0.5}, offset: 90 deg}
  quill: {columns: {nut: {per_rev: 16 mm}, spline: {unit: deg, factor: -1, per_rev: 16 mm}},
          unit: rev, offset: 20 mm}
position: {columns: [x, y, z]}
"""
    columns = columns.replace("nut:", "nut_rev:").replace("spline:", "spline_deg:")
    data = import_csv(*files(table, columns))
    deg = np.pi / 180
    expected = [10 * deg, 35 * deg, 0.3, 0.2 + 90 * deg, 3 * 0.016 - 0.25 * 0.016 + 0.02]
    np.testing.assert_allclose(data.q, [expected], atol=1e-15)
    assert data.joint_units == ("rad", "rad", "rad", "rad", "m")


@pytest.mark.parametrize(
    ("entry", "words"),
    [
        (
            "{a_deg: 1, b_mm: 1}",
            "map.yaml adds lengths and angles to one joint: a_deg in rad, b_mm",
        ),
        ("{columns: {b_mm: 1, c_mm: 1}}", "no column c_mm, which .*map.yaml names"),
        ("{columns: {b_mm: 0}}", "slide.columns.b_mm.factor: expected a number other than 0"),
        (
            "{columns: {b_mm: {gear: 2}}}",
            "b_mm.gear: unknown key; expected one of unit, factor, pe",
        ),
        (
            "{columns: {b_mm: 1}, column: b_mm}",
            "slide: expected either column, or columns with the",
        ),
        ("{unit: mm}", "slide: expected either column, or columns with their factors"),
        ("{colum: b_mm}", "slide.colum: unknown key; did you mean 'column'"),
        ("{columns: {b_mm: 1}, factor: 2}", "slide: factor and per_rev are of one column: state"),
        ("{columns: {}}", "slide: expected either column, or columns with their factors"),
    ],
)
def test_a_wrong_sum_of_columns_is_refused(files, entry, words):
    with pytest.raises(ParallelCalError, match=words):
        import_csv(*files(columns=MAP.replace("{column: b_mm, unit: mm}", entry)))


def screw_model(tmp_path, drive=""):
    """A linear delta's model file whose first joint has a drive."""
    text = dump_model(new_model("linear_delta"))
    text = text.replace("joint: null, position: null", "joint: 1.0e-5, position: 1.0e-5")
    file = tmp_path / "m.yaml"
    file.write_text(text.replace("joint1: {unit: m,", f"joint1: {{unit: m, {drive}"))
    return read_model(file)


CARRIAGES = "joint1_rev,joint2_mm,joint3_mm,x_mm,y_mm,z_mm\n2,100,100,0,0,5\n6,110,90,1,2,3\n"


def test_a_motors_angle_becomes_a_length_by_the_drive_of_the_model(tmp_path):
    (tmp_path / "t.csv").write_text(CARRIAGES)
    model = screw_model(tmp_path, "drive: {kind: screw, per_rev: -0.01},")
    data = load_dataset(tmp_path / "t.csv", mechanism=model.mechanism)
    np.testing.assert_allclose(data.q, [[-0.02, 0.1, 0.1], [-0.06, 0.11, 0.09]])
    np.testing.assert_allclose(data.conditions["direction.joint1"], [0, -1])
    np.testing.assert_allclose(data.conditions["travel.joint1"], [0, -0.04])
    assert data.joint_units == ("m", "m", "m")
    data.to_json(tmp_path / "converted.json")
    again = load_dataset(tmp_path / "converted.json", mechanism=model.mechanism)
    np.testing.assert_array_equal(again.q, data.q)


def test_an_angle_for_a_length_without_a_drive_is_refused_with_both_cures(tmp_path):
    (tmp_path / "t.csv").write_text(CARRIAGES)
    words = (
        r"joint joint1 is an angle, but a length in the model \(linear_delta\).*joint1: \{unit: m, "
        r"\.\.\., drive: .*joint1: \{column: \.\.\., unit: rev, per_rev: 71.2 mm\}"
    )
    with pytest.raises(ParallelCalError, match=words):
        load_dataset(tmp_path / "t.csv", mechanism=screw_model(tmp_path).mechanism)


def test_a_length_for_an_angle_is_refused(tmp_path):
    (tmp_path / "t.csv").write_text("joint1_mm,joint2_deg,joint3_deg,x_mm,y_mm,z_mm\n1,2,3,0,0,1\n")
    with pytest.raises(
        ParallelCalError, match="joint joint1 is a length, but an angle in the model"
    ):
        load_dataset(tmp_path / "t.csv", mechanism=new_model("delta24").mechanism)


def test_samples_of_different_units_are_not_joined(tmp_path, files):
    table, columns = files()
    import_csv(table, columns).to_json(tmp_path / "a.json")
    columns.write_text(MAP.replace("b_mm, unit: mm", "n, unit: rev"))
    table.write_text(TABLE.replace("number", "n"))
    import_csv(table, columns).to_json(tmp_path / "b.json")
    with pytest.raises(ParallelCalError, match=r"joint_units is .*'rad'.*, but .*'m'"):
        load_sessions([tmp_path / "a.json", tmp_path / "b.json"])


def test_every_command_reads_a_table_whose_header_names_joints_and_units(tmp_path, capsys):
    (tmp_path / "t.csv").write_text(CARRIAGES.replace("joint1_rev", "joint1 [mm]"))
    screw_model(tmp_path)
    assert run("compare", tmp_path / "m.yaml", tmp_path / "t.csv", "--json") == 0
    assert json.loads(capsys.readouterr().out)["samples"] == 2


def test_a_table_is_read_by_the_map_beside_it_or_by_the_stated_one(files, tmp_path, capsys):
    table, columns = files()
    with pytest.raises(
        ParallelCalError, match=r"t.csv:1: no columns arm, slide; .*t.columns.yaml, or --d"
    ):
        load_dataset(table, joints=["arm", "slide", "a"])
    (tmp_path / "t.columns.yaml").write_text(MAP)
    np.testing.assert_array_equal(load_dataset(table).q, import_csv(table, columns).q)
    assert run("info", table, "--json") == 0
    assert json.loads(capsys.readouterr().out)["samples"] == 3
    (tmp_path / "t.columns.yaml").unlink()
    assert run("info", table, "--json") == 1
    assert "nothing states which columns are joints" in capsys.readouterr().err
    assert run("info", table, "--data", f"columns={columns}", "--json") == 0


def test_a_session_keeps_the_table_and_its_column_map(files, tmp_path):
    table, columns = files(CARRIAGES.replace("_rev", "_mm"), "")
    entries = "".join(f"  joint{i}: {{column: joint{i}}}\n" for i in (1, 2, 3))
    columns.write_text(f"joints:\n{entries}position: {{columns: [x, y, z]}}\n")
    reading = data_options([f"columns={columns}"])
    created = Session.new(tmp_path / "s", screw_model(tmp_path), [table], reading=reading)
    assert len(Session(created.folder).dataset) == 2


def run(*arguments):
    with pytest.raises(SystemExit) as ended:
        cli.main([str(a) for a in arguments])
    return ended.value.code


def test_imported_samples_are_read_like_a_recording_whatever_the_files_name(
    files, tmp_path, capsys
):
    table, columns = files()
    for name in ("samples.json", "samples"):
        out = tmp_path / name
        assert run("import-csv", table, "--columns", columns, "-o", out, "--json") == 0
        assert json.loads(capsys.readouterr().out)["samples"] == 3
        data = load_dataset(out, joints=["slide", "arm"])
        np.testing.assert_allclose(data.q[0], [0.1, np.pi / 2])
        assert run("look", out) == 0
        assert "3 samples (dwell) of 2 poses" in capsys.readouterr().out
    assert run("import-csv", table, "--columns", columns, "-o", out) == 0
    assert f"written: {out}" in capsys.readouterr().out.replace("\n", " ")


def test_a_joint_missing_from_the_column_map_is_reported(files, tmp_path, capsys):
    table, columns = files()
    assert run("import-csv", table, "--columns", columns, "-o", tmp_path / "s.json") == 0
    assert run("new", "delta24", "-o", tmp_path / "m.yaml") == 0
    assert run("fit", tmp_path / "m.yaml", tmp_path / "s.json") == 1
    assert "in the samples: arm, slide; not found: joint1" in capsys.readouterr().err


def test_files_that_are_not_there_are_named(files, tmp_path, capsys):
    table, columns = files()
    assert run("import-csv", tmp_path / "no.csv", "--columns", columns, "-o", tmp_path / "o") == 1
    assert "no.csv: the table cannot be read: No such file" in capsys.readouterr().err
    assert run("import-csv", table, "--columns", tmp_path / "no.yaml", "-o", tmp_path / "o") == 1
    assert "no.yaml: No such file" in capsys.readouterr().err
    assert not (tmp_path / "o").exists()


CORNERS = (
    "arm_deg,slide_mm,reading.camera.0.u [px],reading.camera.0.v [px]\n1,2,640.5,12.25\n3,4,,\n"
)


GANTRY = "x [mm],y [mm],z [mm],tool_x [mm],tool_y [mm],tool_z [mm]\n1,2,3,4,5,6\n7,8,9,10,11,12\n"
GANTRY_MAP = """\
joints: {x: {column: x}, y: {column: y}, z: {column: z}}
position: {columns: [tool_x, tool_y, tool_z]}
"""


def test_joints_named_like_the_position_are_not_taken_for_it(files, tmp_path):
    table, columns = files(GANTRY, GANTRY_MAP)
    words = (
        r"t.csv:1: the model has joints x, y, z, so no column contains the position; .* such as "
        r"tool_x \[mm\], and state all .*t.columns.yaml.* joints: \{x: \{column: x\}, .*tool_z\]\}"
    )
    with pytest.raises(DatasetError, match=words):
        load_dataset(table, joints=["x", "y", "z"])
    data = load_dataset(table, joints=["x", "y", "z"], columns=str(columns))
    np.testing.assert_allclose(data.q, [[0.001, 0.002, 0.003], [0.007, 0.008, 0.009]])
    np.testing.assert_allclose(data.r, [[0.004, 0.005, 0.006], [0.010, 0.011, 0.012]])


def test_a_joint_and_the_position_cannot_share_a_column(files):
    words = "map.yaml:2.*position: column x is that of a joint, too; expected one of its own"
    with pytest.raises(ParallelCalError, match=words):
        import_csv(*files(GANTRY, GANTRY_MAP.replace("tool_x", "x")))


def test_pixels_of_a_camera_are_readings_in_px(files):
    text = SHORT + "readings: {camera.0.u: {column: u}, camera.0.v: {column: v, unit: px}}"
    table = CORNERS.replace("reading.camera.0.u [px]", "u [px]").replace(
        "reading.camera.0.v [px]", "v"
    )
    data = import_csv(*files(table, text))
    np.testing.assert_array_equal(data.conditions["reading.camera.0.u"], [640.5, np.nan])
    np.testing.assert_array_equal(data.conditions["reading.camera.0.v"], [12.25, np.nan])


def test_a_table_with_the_names_of_channels_needs_no_map_for_them(files):
    table = read_table(files(CORNERS)[0])
    wanted = map_by_names(table, ["arm", "slide"], table.path.with_suffix(".yaml"))
    assert {name: one.column for name, one in wanted.readings.items()} == {
        "camera.0.u": "reading.camera.0.u",
        "camera.0.v": "reading.camera.0.v",
    }
    data = make_dataset([table], wanted, "the model")
    np.testing.assert_array_equal(data.conditions["reading.camera.0.v"], [12.25, np.nan])


def test_a_length_in_px_is_refused(files):
    with pytest.raises(DatasetError, match=r"column x \[px\] is in px, expected a length"):
        import_csv(
            *files(TABLE.replace(",x,y,z,", ",x [px],y,z,"), MAP.replace("z], unit: mm", "z]"))
        )


# The arm goes up three times, down, and up again. Nobody measured at 10, 50 and 45 degrees.
SHOTS = "1,0,0,0\n2,1,10,0\n3,2,30,0\n4,3,50,0\n5,4,40,0\n6,5,45,0\n"


def test_visits_that_nobody_measured_count_for_the_directions_of_the_others(two):
    """From shot 3 (30 degrees) to 5 (40 degrees) the arm came down from 50 degrees."""
    data = two(SHOTS, "1,0,0,0,0\n3,2,0,0,0\n5,4,0,0,0\n", "join: {by: no}")
    np.testing.assert_array_equal(data.conditions["direction.arm"], [0, 1, -1])
    np.testing.assert_allclose(data.conditions["travel.arm"], np.radians([0, 30, -10]))
    assert data.sides_from_order
    assert any("from the order of all rows of" in w and "joints.csv" in w for w in data.warnings)


def test_no_direction_is_taken_from_tables_that_list_the_rows_in_different_orders(two):
    data = two(SHOTS, "5,4,0,0,0\n1,0,0,0,0\n3,2,0,0,0\n", "join: {by: no}")
    assert not any(name.startswith(("direction", "travel")) for name in data.conditions)
    assert not data.sides_from_order
    assert any("list the rows in different orders" in w for w in data.warnings)


def test_samples_keep_the_directions_of_the_whole_table_however_they_are_picked(files):
    data = import_csv(*files(VISITS, SHORT + "position: {columns: [x, y, z]}"))
    picked = data.select([3, 1])
    np.testing.assert_array_equal(picked.conditions["direction.arm"], [-1, 1])
    np.testing.assert_array_equal(data.excluding([2]).conditions["direction.arm"], [0, 1, -1])
