"""Valid cases of formats in which readers differ, with the values of the real reader.

docs/formats.md has one row for each case; every row names its test. The expected values come from
the software itself, in the versions that the page states.
"""

import re
from pathlib import Path

import numpy as np
import pytest
import yaml
from test_import_urdf import TURN, joint, robot

from parallel_cal.base.errors import DatasetError, ModelError, ModelFileError
from parallel_cal.base.rotation import rotation_matrix
from parallel_cal.exporting.export import export_into
from parallel_cal.importing.controller_files import configured
from parallel_cal.importing.gcode import split_commands
from parallel_cal.importing.importers import linuxcnc
from parallel_cal.importing.mjcf import read_mjcf
from parallel_cal.importing.urdf import arm
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.file.modelfile import dump_model, parse_model
from parallel_cal.model.model import new_model
from parallel_cal.recordings.csv_import import import_csv

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "formats.md"
HEAD = ("Versions: ", "Question: ", 'Guess: "', "True: ", "Matters: ")
ROW = re.compile(r"^\| (?!case |--)(.*) \|$", re.MULTILINE)


def test_every_row_names_a_test_that_exists():
    rows = [row.split(" | ") for row in ROW.findall(PAGE.read_text())]
    assert len(rows) >= 25
    known = {
        name
        for path in (ROOT / "test").rglob("test_*.py")
        for name in re.findall(r"^def (test_\w+)", path.read_text(), re.MULTILINE)
    }
    for row in rows:
        assert len(row) == 4, row
        assert re.fullmatch(r"`(test_\w+)`", row[-1]), row
        assert row[-1].strip("`") in known, row


def test_findings_have_the_form_that_the_contributors_page_states():
    listed = re.findall(
        r"^\| `([^`]*)` \|", (ROOT / "findings/README.md").read_text(), re.MULTILINE
    )
    scripts = sorted((ROOT / "findings").glob("*.sh"))
    assert sorted(listed) == [path.name for path in scripts]
    assert len(scripts) >= 12
    for path in scripts:
        text = path.read_text()
        head = text.split("\ncd ")[0]
        keys = re.findall(r"^# (\w+: \"?)", head, re.MULTILINE)
        assert len(keys) == len(HEAD), path
        for key, expected in zip(keys, HEAD, strict=True):
            assert key.startswith(expected), path
        assert re.search(r"\./with_packages .*==", text), path
        assert "\n# Seen:\n#   " in text, path
        assert "assert" in text, path  # it fails if the behaviour changes
        assert "parallel_cal" not in text, path


# ------------------------------------------------------------------------------------- LinuxCNC

HAL = "setp lineardeltakins.R [MACHINE]RADIUS\nsetp lineardeltakins.L 250\n"
INI = "[MACHINE]\nRADIUS = 150\n[TRAJ]\nLINEAR_UNITS = mm\n"


@pytest.fixture
def machine(tmp_path):
    """machine(ini, **included): the files of a linear Delta of LinuxCNC."""

    def write(ini, **included):
        (tmp_path / "machine.hal").write_text(HAL)
        (tmp_path / "machine.ini").write_text(ini)
        for name, text in included.items():
            (tmp_path / f"{name}.inc").write_text(text)
        return [tmp_path / "machine.hal", tmp_path / "machine.ini"]

    return write


def radius(paths):
    return 1e3 * linuxcnc.kinematics(linuxcnc.settings(paths)).radius[0]


@pytest.mark.parametrize(
    "ini",
    [
        INI.replace("RADIUS = 150", "RADIUS = 150\nRADIUS = 140"),
        INI + "[MACHINE]\nRADIUS = 140\n",
    ],
)
def test_the_first_of_two_equal_keys_counts_in_linuxcnc(machine, ini):
    paths = machine(ini)
    assert radius(paths) == pytest.approx(150)
    wider = configured(machine(INI.replace("150", "151"))).model
    paths = machine(ini)
    export_into(wider, "linuxcnc", paths)
    assert radius(paths) == pytest.approx(151)
    assert "RADIUS = 140" in paths[1].read_text()  # what does not count stays


@pytest.mark.parametrize("line", ["  RADIUS = 150", "\tRADIUS=150", "RADIUS   =   150 # wide"])
def test_blanks_around_a_key_of_linuxcnc_do_not_matter(machine, line):
    assert radius(machine(INI.replace("RADIUS = 150", line))) == pytest.approx(150)


def test_linuxcnc_reads_an_included_file_at_its_place(machine):
    before = "[MACHINE]\n#INCLUDE size.inc\nRADIUS = 150\n[TRAJ]\nLINEAR_UNITS = mm\n"
    paths = machine(before, size="RADIUS = 140\n")
    assert radius(paths) == pytest.approx(140)
    after = INI.replace("RADIUS = 150\n", "RADIUS = 150\n#INCLUDE size.inc\n")
    assert radius(machine(after, size="RADIUS = 140\n")) == pytest.approx(150)
    wider = configured(machine(INI.replace("150", "151"))).model
    paths = machine(before, size="RADIUS = 140\n")
    with pytest.raises(
        ModelError, match=r"size\.inc:1: lineardeltakins\.R is '140': .*--into .*inc"
    ):
        export_into(wider, "linuxcnc", paths)
    assert radius(paths) == pytest.approx(140)
    export_into(wider, "linuxcnc", [*paths, paths[0].with_name("size.inc")])
    assert radius(paths) == pytest.approx(151)
    assert "RADIUS = 150" in paths[1].read_text()


def test_an_included_file_of_linuxcnc_that_is_missing_is_named(machine):
    found = configured(machine(INI + "#INCLUDE elsewhere.inc\n"))
    assert any("elsewhere.inc was not found and not read" in text for text in found.remarks)


def test_files_of_linuxcnc_that_include_each_other_are_refused(machine):
    paths = machine(INI + "#INCLUDE size.inc\n", size="#INCLUDE machine.ini\n")
    with pytest.raises(DatasetError, match=r"size\.inc:1: #INCLUDE is 'machine\.ini'"):
        radius(paths)


def test_a_hal_file_that_another_one_runs_is_read_at_its_place(machine):
    paths = machine(INI, size="setp lineardeltakins.R 140\n")
    hal = paths[0]
    hal.write_text(HAL + "source size.inc  # of this machine\n")
    assert radius(paths) == pytest.approx(140)
    hal.write_text("source size.inc\n" + HAL)
    assert radius(paths) == pytest.approx(150)
    hal.write_text(HAL + "source elsewhere.hal\n")
    remarks = configured(paths).remarks
    assert any("elsewhere.hal was not found and not read" in text for text in remarks)


# ------------------------------------------------------------------------------- RepRapFirmware

CONFIG = "M92 X100 Y100 Z200\nM665 L250 R150 H240 B80 X0 Y0 Z0\nM666 X0 Y0 Z0\n"


def delta(folder, text, **beside):
    """chain2.D_x, the radius (mm), and the remarks of a config.g."""
    for name, words in beside.items():
        (folder / f"{name}.g").write_text(words)
    (folder / "config.g").write_text(text)
    found = configured([folder / "config.g"])
    return 1e3 * found.model.value("chain2.D_x"), found


def test_a_number_is_written_into_its_own_command(tmp_path):
    text = CONFIG.replace("\nM666", " M666").replace("R150", "R150 R140")
    path = tmp_path / "config.g"
    path.write_text(text)
    wider = delta(tmp_path, CONFIG.replace("R150", "R151").replace("M666 X0", "M666 X1.5"))[1].model
    path.write_text(text)
    export_into(wider, "rrf", [path])
    line = path.read_text().splitlines()[1]
    read = configured([path]).model
    assert re.search(r"R151[.0]* R140 ", line)
    assert "M666" in line
    assert 1e3 * read.value("chain2.D_x") == pytest.approx(151, abs=1e-3)
    np.testing.assert_allclose(
        read.mechanism.joint_limits, wider.mechanism.joint_limits, rtol=0, atol=2e-6
    )


@pytest.mark.parametrize("gap", [" ", "", "  "])
def test_a_second_command_begins_at_the_next_g_or_m(tmp_path, gap):
    """`M665 .. M666 X1` states an end-stop, not the angle of a tower."""
    one = CONFIG.replace(" X0 Y0 Z0\nM666 X0", f"{gap}M666 X1.5")
    two = CONFIG.replace("M666 X0", "M666 X1.5")
    read = [delta(tmp_path, text)[1].model for text in (one, two)]
    np.testing.assert_array_equal(read[0].values, read[1].values)
    assert read[0].mechanism.joint_limits == read[1].mechanism.joint_limits
    assert split_commands('M98 P"MG1.g" X{global.mm} ; M665 R1') == ['M98 P"MG1.g" X{global.mm} ']
    assert split_commands("M117 then M665 R1") == []


def test_a_macro_is_read_where_m98_runs_it(tmp_path):
    size = "M665 R140\n"
    macro = CONFIG + 'M98 P"size.g"\n'
    assert delta(tmp_path, macro, size=size)[0] == pytest.approx(140)
    assert delta(tmp_path, 'M98 P"0:/sys/size.g"\n' + CONFIG, size=size)[0] == pytest.approx(150)
    given = configured([tmp_path / "size.g", tmp_path / "config.g"])
    assert 1e3 * given.model.value("chain2.D_x") == pytest.approx(150)
    again = delta(tmp_path, macro, size=size + 'M98 P"config.g"\nM98 P"size.g"\n')[0]
    assert again == pytest.approx(140)  # files that run each other end


def test_a_macro_that_is_missing_is_named(tmp_path):
    found = delta(tmp_path, CONFIG + 'M98 P"size.g"\nM501\n')[1]
    (remark,) = [text for text in found.remarks if "not found" in text]
    assert "the included files size.g, config-override.g were not found" in remark


# --------------------------------------------------------------------------------- Smoothieware


def smoothie(folder, text, **beside):
    """The radius (mm) of a config of a linear Delta, and the remarks."""
    for name, words in beside.items():
        (folder / name).write_text(words)
    path = folder / "config"
    path.write_text(f"arm_solution linear_delta\narm_length 250\n{text}{SMOOTHIE_ENDS}")
    found = configured([path])
    return 1e3 * found.model.value("chain2.D_x"), found.remarks


SMOOTHIE_ENDS = "delta_homing true\nalpha_max 0\nbeta_max 0\ngamma_max 300\n" + "".join(
    f"{axis}_homing_direction home_to_max\n" for axis in ("alpha", "beta", "gamma")
)


@pytest.mark.parametrize(
    "text",
    [
        "arm_radius 140\narm_radius 150\n",
        "  arm_radius\t150#wide\n",
        "arm_radius 150 # wide\nARM_RADIUS 140\n",
        "include size\narm_radius 150\n",
        "include /sd/radius\n",
        "arm_radius 140\ninclude outer\n",
    ],
)
def test_the_last_of_equal_keys_counts_in_smoothieware_also_of_included_files(tmp_path, text):
    inner = {"size": "arm_radius 140\n", "radius": "arm_radius 150\n"}
    assert smoothie(tmp_path, text, outer="include radius\n", **inner)[0] == pytest.approx(150)


def test_an_included_file_of_smoothieware_that_is_missing_is_named(tmp_path):
    remarks = smoothie(tmp_path, "arm_radius 150\ninclude elsewhere\n")[1]
    assert any("elsewhere" in text and "not" in text for text in remarks)


def test_a_file_given_beside_the_config_that_includes_it_is_read_at_its_place(tmp_path):
    smoothie(tmp_path, "include size\narm_radius 150\n", size="arm_radius 140\n")
    found = configured([tmp_path / "config", tmp_path / "size"])
    assert 1e3 * found.model.value("chain2.D_x") == pytest.approx(150)


def test_files_of_smoothieware_that_include_each_other_are_refused(tmp_path):
    with pytest.raises(DatasetError, match=r"size:1: include is 'config', expected a file that"):
        smoothie(tmp_path, "include size\n", size="include config\n")


# ------------------------------------------------------------------------------- URDF and MJCF


def test_a_slider_moves_by_its_reading_however_long_its_axis_is(tmp_path):
    """As in pinocchio, MuJoCo, roboticstoolbox and scikit-robot: 0.1 m + 0.5 m."""
    path = tmp_path / "r.urdf"
    limit = '<limit lower="0.1" upper="0.9" velocity="1" effort="1"/>'
    path.write_text(robot(joint("s", "prismatic", "a", "b", "0 0 0.1", axis="0 0 2", limit=limit)))
    found = arm(path, "a", "b")
    at = Kinematics(found.model).direct(np.array([0.5])).position
    np.testing.assert_allclose(at, [0, 0, 0.6], atol=1e-12)
    assert any("the axis of s has the length 2" in text for text in found.remarks)


def test_a_hinge_turns_however_long_its_axis_is(tmp_path):
    """ikpy 4.2.1 has the tip at (0.878, -0.959), outside of its circle."""
    path = tmp_path / "r.urdf"
    path.write_text(
        robot(
            joint("h", "revolute", "a", "b", "0 0 0.1", axis="0 0 -2", limit=TURN),
            joint("f", "fixed", "b", "tip", "1 0 0"),
        )
    )
    found = arm(path, "a", "tip")
    at = Kinematics(found.model).direct(np.array([0.5])).position
    np.testing.assert_allclose(at, [np.cos(0.5), -np.sin(0.5), 0.1], atol=1e-12)
    assert any("the axes of h are not of length 1" in text for text in found.remarks)


def test_a_joint_without_an_axis_turns_about_x(tmp_path):
    path = tmp_path / "r.urdf"
    text = robot(
        joint("h", "revolute", "a", "b", "0 0 0.1", limit=TURN),
        joint("f", "fixed", "b", "tip", "0 1 0"),
    )
    path.write_text(text.replace('<axis xyz="0 0 1"/>', ""))
    at = Kinematics(arm(path, "a", "tip").model).direct(np.array([0.5])).position
    np.testing.assert_allclose(at, [0, np.cos(0.5), 0.1 + np.sin(0.5)], atol=1e-12)


MJCF = """<mujoco><worldbody>
<body name="a" pos="0 0 1" euler="30 40 50">
 <joint name="j" axis="0 0 2" range="-90 90" ref="30"/><geom size=".1" mass="1"/>
 <body name="b" pos="1 0 0" quat="2 0 0 2">
  <joint name="k" type="slide" axis="0 3 4" range="-1 1" ref="0.2"/><geom size=".1" mass="1"/>
 </body></body></worldbody></mujoco>"""


@pytest.mark.parametrize(
    ("q", "position"),
    [
        ((0.0, 0.0), (0.7033818500902627, 0.7312782172934952, 0.499514094228771)),
        ((0.5, 0.3), (0.5271699968757512, 0.7800458687699804, 1.0601684054043892)),
    ],
)
def test_bodies_of_an_mjcf_are_where_mujoco_has_them(tmp_path, q, position):
    """Degrees, angles about turned axes, numbers that are not of length 1, and `ref`."""
    path = tmp_path / "m.xml"
    path.write_text(MJCF)
    hinge, slide = read_mjcf(path).joints
    at = hinge.origin.copy()
    at[:3, :3] = at[:3, :3] @ rotation_matrix(hinge.axes[0] * (q[0] + hinge.zero))
    at = at @ slide.origin @ np.append(slide.axes[0] * (q[1] + slide.zero), 1)
    np.testing.assert_allclose(at[:3], position, atol=1e-12)
    assert hinge.limits == pytest.approx((-np.pi / 2, np.pi / 2))


# ------------------------------------------------------------------------------ YAML and tables


@pytest.mark.parametrize(
    ("text", "value"), [("1e-1", 0.1), (".1", 0.1), ("1_0e-2", None), ("1:30", None), ("0o1", None)]
)
def test_a_number_of_a_model_file_is_what_every_yaml_reader_takes_for_one(text, value):
    whole = dump_model(new_model("linear_delta"))
    assert "chain1.D_x: {value: 0.1, " in whole
    changed = whole.replace("chain1.D_x: {value: 0.1, ", f"chain1.D_x: {{value: {text}, ")
    if value is None:
        with pytest.raises(ModelFileError, match=rf"expected a number, found '{text}'"):
            parse_model(changed)
    else:
        assert parse_model(changed).value("chain1.D_x") == value


def test_columns_named_no_and_on_are_columns(tmp_path):
    text = "joints: {on: {column: on, unit: m}}\nposition: {columns: [x, y, z]}\ngroup: no\n"
    assert yaml.safe_load(text)["group"] is False  # YAML 1.1
    (tmp_path / "columns.yaml").write_text(text)
    (tmp_path / "data.csv").write_text(
        "no,on,x [mm],y [mm],z [mm]\n1,1,1,2,3\n1,1,2,3,4\n2,3,4,5,6\n"
    )
    data = import_csv(tmp_path / "data.csv", tmp_path / "columns.yaml")
    assert data.joint_names == ("on",)
    assert data.pose_id.tolist() == [0, 0, 1]


def test_names_that_pandas_takes_for_missing_are_names(tmp_path):
    (tmp_path / "columns.yaml").write_text(
        "joints: {a: {column: a}}\nposition: {columns: [x, y, z]}\nname: shot\n"
    )
    names = ["NA", "None", "null", "001"]
    rows = [f"{name},{k},{k},2,3" for k, name in enumerate(names)]
    (tmp_path / "data.csv").write_text("\n".join(["shot,a [m],x [mm],y [mm],z [mm]", *rows]))
    data = import_csv(tmp_path / "data.csv", tmp_path / "columns.yaml")
    assert [*data.names.values()] == names
