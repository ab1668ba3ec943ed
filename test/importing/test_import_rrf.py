"""RepRapFirmware's height maps and configuration become touches and a model; or one clear line."""

import json
import re

import numpy as np
import pytest

from parallel_cal.base.errors import ParallelCalError
from parallel_cal.cli import main as cli
from parallel_cal.exporting.export import export_into
from parallel_cal.importing.controller_files import configured, samples
from parallel_cal.importing.deltas import Shoulders, Towers
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.file.modelfile import parse_model

MM, DEGREE = 1e-3, np.pi / 180
LINEAR = """\
; a Kossel
G21
M92 X100 Y100 Z200 E420
M665 L250.000 R150 H240 B80.0 X0 Y0 Z0 ; rods
M666 X-0.5 Y0.25 Z0.25 A0.00 B0.00
G31 P500 X10 Y0 Z2.5
"""
ROTARY = "M669 K10 U100 L250:250:250 H200 A-40:60 R50 B60 X0 Y0 Z0\nM666 X1 Y0 Z0\n"
MAP = """\
RepRapFirmware height map file v2 generated at 2026-11-01 10:00, min error -0.1, max error 0.2
axis0,axis1,min0,max0,min1,max1,radius,spacing0,spacing1,num0,num1
X,Y,-40.00,40.00,-30.00,30.00,50.00,40.00,60.00,3,2
  0.100, -0.050,      0
 0.000,0.200,   nan
"""
OLD = MAP.replace(
    "axis0,axis1,min0,max0,min1,max1,radius,spacing0,spacing1,num0,num1",
    "xmin,xmax,ymin,ymax,radius,xspacing,yspacing,xnum,ynum",
)
OLD = OLD.replace("X,Y,-40", "-40")
TOP = np.full(3, 0.5)
POINTS = np.array([[20, -35, 8], [-50, 10, 3], [5, 60, 40]]) * MM


@pytest.fixture
def files(tmp_path):
    """files(config, map): their paths."""

    def write(config=LINEAR, heights=MAP):
        (tmp_path / "config.g").write_text(config)
        (tmp_path / "heightmap.csv").write_text(heights)
        return [tmp_path / "heightmap.csv", tmp_path / "config.g"]

    return write


def three(*values):
    return np.array(values, float)


def test_carriages_of_a_linear_delta_stand_where_pythagoras_puts_them():
    delta = Towers(
        three(150, 150, 150) * MM, three(250, 250, 250) * MM, three(-30, 0, 0) * DEGREE, TOP
    )
    np.testing.assert_allclose(delta.joints(np.array([[0, 0, 0.01]])), [[0.21] * 3], rtol=1e-12)
    # 70 mm from tower C at (0, 150), from tower A, trimmed to (-150, 0): 250^2 = 70^2 + 240^2
    assert delta.joints(np.array([[0, 0.08, 0.01]]))[0, 2] == pytest.approx(0.25, abs=1e-12)
    assert delta.joints(np.array([[-0.08, 0, 0.01]]))[0, 0] == pytest.approx(0.25, abs=1e-12)
    tilted = Towers(delta.radius, delta.rods, delta.trim, TOP, tilt=(0.01, 0.02))
    rise = tilted.joints(POINTS) - delta.joints(POINTS)
    np.testing.assert_allclose(rise[0], 0.01 * 0.020 - 0.02 * 0.035, atol=1e-15)


def test_arms_of_a_rotary_delta_stand_where_pythagoras_puts_them():
    same = three(1, 1, 1)
    delta = Shoulders(0.05, 0.2 * same, 0.1 * same, 0.25 * same, three(210, 330, 90) * DEGREE)
    # level arms end 150 mm out and 200 mm up: 250^2 = 150^2 + 200^2
    np.testing.assert_allclose(delta.joints(np.zeros((1, 3))), [[0, 0, 0]], atol=1e-12)
    # an arm 80 out, 60 down ends at (0, 130, 140); from there to (0, -20, -60): (150, 200)
    found = delta.joints(np.array([[0, -0.02, -0.06]]))[0, 2]
    assert found == pytest.approx(-np.arctan2(3, 4), abs=1e-12)


@pytest.mark.parametrize(
    "config",
    [
        LINEAR,
        LINEAR.lower(),
        ROTARY,
        "M665 L250.5:251:249.2 R148.2 H240.1 X-0.3 Y0.2 Z0.1\nM666 X0.1 Y-0.2 Z0.1 A1.5 B-0.7\n",
        "M669 K10 U100:101:99.5 L250:251:249 H200:201:199 R50 X0.4 Y-0.2 Z0.1\n",
    ],
)
def test_the_model_as_configured_is_the_firmwares_formula(files, config):
    from parallel_cal.importing.gcode import settings
    from parallel_cal.importing.importers import rrf

    _, path = files(config)
    delta = rrf.read_delta(settings([path], rrf.CODES))
    model = configured([path]).model
    pose = Kinematics(model).direct(delta.joints(POINTS))
    plate = np.array(getattr(delta, "tilt", (0, 0)))
    believed = pose.position - [0, 0, 1] * (pose.position[:, :2] @ plate)[:, None]
    np.testing.assert_allclose(believed, POINTS, atol=1e-9)
    assert (model.values == model.table.nominal).all() == (not plate.any())


def test_a_tilted_bed_is_where_m666_says(files):
    _, path = files(LINEAR.replace("A0.00 B0.00", "A1 B-0.5").replace("X10 Y0 Z2.5", ""))
    found = configured([path]).model
    level = Kinematics(found).direct(samples("rrf", files(path.read_text(), OLD)).q)
    normal = np.array([-0.01, 0.005, 1])
    heights = level.position @ normal
    np.testing.assert_allclose(heights, three(0.1, -0.05, 0, 0.2) * MM, atol=2e-6)
    assert found.value("probe.plate.rx") == pytest.approx(-0.005)
    assert found.value("probe.plate.ry") == pytest.approx(-0.01)


@pytest.mark.parametrize("heights", [MAP, OLD])
def test_cells_are_touches_with_the_nozzle_beside_and_above_the_tip(files, heights):
    paths = files(LINEAR, heights)
    data = samples("rrf", paths)
    nozzle = np.array([(-50, -30, 2.6), (-10, -30, 2.45), (-50, 30, 2.5), (-10, 30, 2.7)]) * MM
    np.testing.assert_allclose(
        Kinematics(configured(paths[1:]).model).direct(data.q).position, nozzle, atol=1e-9
    )
    assert configured(paths[1:]).model.sensors[0].tip == (0.01, 0.0, -0.0025)
    assert not data.measured.any()
    np.testing.assert_array_equal(data.conditions["reading.probe"], np.zeros(4))
    np.testing.assert_allclose(data.joint_sigma, three(10, 10, 5) * 1e-6 / np.sqrt(12))
    assert [d.reason for d in data.dropped] == ["not probed"] * 2
    assert data.dropped[0].detail.endswith("heightmap.csv:4: column 3, x 40 y -30 mm")


def test_later_settings_count_and_maps_of_one_grid_are_visits_of_the_same_places(files, tmp_path):
    paths = files()
    (tmp_path / "override.g").write_text("M665 R149 H241\n")
    (tmp_path / "second.csv").write_text(MAP.replace("0.200", "0.210"))
    data = samples("rrf", [*paths, tmp_path / "override.g", tmp_path / "second.csv"])
    assert data.pose_id[:4].tolist() == data.pose_id[4:].tolist()
    model = configured([paths[1], tmp_path / "override.g"]).model
    assert model.value("chain2.D_x") == pytest.approx(0.149)
    assert model.value("chain2.Lb") == 0.25
    high = 0.241 + np.sqrt(0.25**2 - 0.149**2)
    assert model.mechanism.joint_limits[0][1] == pytest.approx(high - 0.5e-3)


GLOBALS = """\
global towers = 150         ; (R) 155 with rails
global rods = 250
if exists(global.other)
  set global.towers = 1
M665 L{global.rods} R{ global.towers } H240 B80 ; Delta
"""


def test_a_word_may_lead_to_a_global_variable(tmp_path):
    """As a maker of printers has it; its calibration calls M665 with the variables again."""
    file = tmp_path / "config.g"
    file.write_text(GLOBALS.replace("{ global.towers }", "{global.towers}"))
    model = configured([file]).model
    assert model.value("chain2.D_x") == pytest.approx(0.150)
    assert model.value("chain2.Lb") == pytest.approx(0.250)
    before = file.read_text()
    assert export_into(model, "rrf", [file]).loss["position_max"] < 5e-9
    assert file.read_text() == before
    values = model.values.copy()
    for i in (1, 2, 3):
        values[model.table.index_of(f"chain{i}.D_x")] += 1e-3
    wider = model.with_values(values)
    export_into(wider, "rrf", [file])
    new = {*file.read_text().splitlines()} - {*before.splitlines()}
    assert "global towers = 151.0000         ; (R) 155 with rails" in new
    assert "M666 X0.0000 Y0.0000 Z0.0000 A0.00000 B0.00000" in new
    (delta,) = [line for line in new if line.startswith("M665")]
    assert delta.startswith("M665 L{global.rods} R{global.towers} H")
    assert delta.endswith(" B80 X0.00000 Y0.00000 Z0.00000 ; Delta")
    values[model.table.index_of("chain3.Lb")] += 1e-3
    with pytest.raises(ParallelCalError, match=r"'global rods = 250.*M665 L needs several numbers"):
        export_into(wider.with_values(values), "rrf", [file])


FIVE = "M669 K9 X-50:50 Y0 L2 P100 D150 B180:0 C60:180:0:120\n"


def test_a_five_bar_stands_where_pythagoras_puts_it(tmp_path):
    """Cranks at 120 and 60 degrees end 100 beside the middle, 86.603 up; rods go 111.803 more."""
    (tmp_path / "config.g").write_text(FIVE)
    model = configured([tmp_path / "config.g"]).model
    found = Kinematics(model).inverse([0.0, 0.0866025404 + 0.1118033989, 0.0])
    np.testing.assert_allclose(np.degrees(found.joints), [120, 60], atol=1e-6)
    np.testing.assert_allclose(np.degrees(model.mechanism.joint_limits), [[60, 180], [0, 120]])
    for old, new, message in (
        ("L2", "L3", "config.g:1: M669 L is '3', expected one of the work modes 1, 2, 4"),
        ("P100", "", "no M669 P, expected lengths in mm of left:right"),
        ("D150", "D150:150:0:30", "M669 D is '150:150:0:30', expected lengths in mm of left:right"),
        ("X-50:50", "X50", "config.g:1: M669 X is '50', expected two axes"),
        ("P100", "P10", "config.g:1: M669 P is '10', expected cranks whose rods meet in front"),
        ("C60", "C190", "config.g:1: M669 C is '190:180:0:120', expected least:most degrees"),
        ("C60:180:0:120", "C60:180", "M669 C is '60:180', expected least:most degrees of left:ri"),
    ):
        (tmp_path / "config.g").write_text(FIVE.replace(old, new))
        with pytest.raises(ParallelCalError) as error:
            configured([tmp_path / "config.g"])
        assert message in str(error.value)


@pytest.mark.parametrize(
    ("words", "switches"), [("", (20, 10)), (" L2", (110, 20)), (" L4", (110, 100))]
)
def test_a_five_bar_has_what_its_firmware_assumes_and_says_so(tmp_path, words, switches):
    """FiveBarScaraKinematics::Configure of RepRapFirmware 3.5.3, without B and C."""
    (tmp_path / "config.g").write_text(f"M669 K9 X0:100 Y0:0 P300:300 D300:300:0:0{words}\n")
    found = configured([tmp_path / "config.g"])
    mechanism = found.model.mechanism
    np.testing.assert_allclose(np.degrees(mechanism.joint_limits), [[10, 170]] * 2)
    np.testing.assert_allclose(np.degrees(mechanism.switches), switches)
    [remark] = found.remarks
    assert "M669 C 10:170:10:170, M669 B {}:{}".format(*switches) in remark


def test_a_height_that_m665_does_not_state_is_that_of_the_firmware(files):
    data, model = (
        samples("rrf", files(LINEAR.replace(" H240", ""))),
        configured(files(LINEAR.replace(" H240", ""))[1:]).model,
    )
    top = 0.24 + np.sqrt(0.25**2 - 0.15**2)
    stated = configured(files(LINEAR)[1:]).model
    assert model.mechanism.joint_limits == stated.mechanism.joint_limits
    assert model.mechanism.joint_limits[0][1] == pytest.approx(top, abs=2e-3)
    assert any("M665 H 240" in warning for warning in data.warnings)


def test_words_without_spaces_are_those_of_the_firmware(files):
    glued = LINEAR.replace("R150 H", "R150H").replace("M665 L", "M665L")
    assert glued != LINEAR
    found, expected = (configured(files(text)[1:]).model for text in (glued, LINEAR))
    assert found.values.tolist() == expected.values.tolist()
    assert found.mechanism.joint_limits == expected.mechanism.joint_limits


def test_a_hangprinter_may_state_the_height_of_its_upper_anchor_alone(files):
    anchors = "A0:-1600:-110 B1300:1250:-150 C-1440:740:-160"
    spools = "M666 Q0.007 R75 U2 O1 L20 H255\n"
    alone, triple, default = (
        configured(files(text)[1:])
        for text in (
            f"M669 K6 N4 {anchors} D2345\n{spools}",
            f"M669 K6 N4 {anchors} D0:0:2345\n{spools}",
            f"M669 K6 N4 {anchors} D0:0:2345\n",
        )
    )
    assert alone.model.values.tolist() == triple.model.values.tolist()
    assert any("before May 2021" in remark for remark in alone.remarks)
    assert not any("before May 2021" in remark for remark in triple.remarks)
    assert default.model.values.tolist() == triple.model.values.tolist()
    assert "M666 Q 0.007, M666 R 75, M666 L 20, M666 H 255, M666 U 2:2:2:2" in default.remarks[0]
    with pytest.raises(ParallelCalError, match="M669 A is '1600', expected x:y:z of the anchor"):
        configured(files(f"M669 K6 N4 {anchors.replace('0:-1600:-110', '1600')} D2345\n")[1:])


def test_a_hangprinters_lines_are_those_of_its_firmware(files):
    """Line l out turns the motor by 2 a g (R - sqrt(R^2 - l a n Q)) / (a n Q)."""
    anchors = np.array([[0, -1600, -110], [1300, 1250, -150], [-1440, 740, -160], [0, 0, 2345]])
    triples = " ".join(
        f"{a}{':'.join(map(str, x))}" for a, x in zip("ABCD", anchors.tolist(), strict=True)
    )
    _, path = files(f"M669 K6 N4 {triples} P1500\nM666 Q0.0078 R75 U2:2:2:4 O1 L20 H255 J25\n")
    model = configured([path]).model
    r = np.array([[0.2, -0.1, 0.3], [-0.3, 0.4, 0.6]])
    out = np.linalg.norm(r[:, None] - anchors * MM, axis=2) - np.linalg.norm(anchors * MM, axis=1)
    a, g, R, Q = three(2, 2, 2, 4)[[0, 1, 2, 2]] * 0 + [2, 2, 2, 4], 255 / 20, 0.075, 0.0078 * MM
    q = 2 * a * g * (R - np.sqrt(R**2 - out * a * Q)) / (a * Q)
    np.testing.assert_allclose(Kinematics(model).direct(q).position, r, atol=1e-9)
    path.write_text(path.read_text().replace("B1300:1250:-150", "B1300"))
    with pytest.raises(ParallelCalError, match=r"M669 B is '1300', expected x:y:z of the anchor"):
        configured([path])
    path.write_text(
        path.read_text().replace("B1300", "B1300:1250:-150").replace("D0:0:2345", "D0:0:0")
    )
    with pytest.raises(ParallelCalError, match=r"config.g:1: M669 A is .* anchor is at the origin"):
        configured([path])


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("H200", "H900", "config.g:1: M669 H is '900', expected lengths that reach 50 mm ab"),
        (
            "A-40:60",
            "A60:-40",
            "config.g:1: M669 A is '60:-40', expected least:most degrees of an arm",
        ),
    ],
)
def test_arms_that_reach_nothing_are_named(files, old, new, message):
    with pytest.raises(ParallelCalError, match=re.escape(message)):
        configured(files(ROTARY.replace(old, new))[1:])


@pytest.mark.parametrize("head", ["X,Y,Z", "# a probe\nx [mm];y [mm];z [mm]"])
def test_a_table_of_touches_is_read_as_a_height_map_of_the_same_touches(files, head):
    of_map = samples("rrf", files())
    rows = ["-40,-30,0.1", "0,-30,-0.05", "-40,30,0", "0,30,0.2"]
    rows = [row.replace(",", ";") if ";" in head else row for row in rows]
    of_table = samples("rrf", files(heights="\n".join([head, *rows]) + "\n"))
    np.testing.assert_allclose(of_table.q, of_map.q, atol=1e-12)
    heights = [data.conditions["reading.probe"] for data in (of_table, of_map)]
    np.testing.assert_allclose(*heights, atol=1e-12)


BROKEN = {
    "head": (LINEAR, MAP.replace("file v2", "file v1"), "heightmap.csv:1: the first line"),
    "no map": (LINEAR, "x,y,u\n1,2,3\n", "heightmap.csv:1: the first line is 'x,y,u'"),
    "no height": (LINEAR, "x,y,z\n1,2,300\n", "heightmap.csv:2: z is '300 mm', expected the heig"),
    "no length": (LINEAR, "x,y,z [deg]\n1,2,3\n", "column z [deg] is no length; expected m, cm"),
    "empty": (LINEAR, "", "heightmap.csv:1: the first line is ''"),
    "cut off": (LINEAR, MAP[:150], "heightmap.csv:3: the file's end"),
    "names": (LINEAR, MAP.replace("spacing0", "step"), "heightmap.csv:2: the names line"),
    "axes": (LINEAR, MAP.replace("X,Y,", "X,U,"), "heightmap.csv:3: axis1 is 'U', expected Y"),
    "grid": (LINEAR, MAP.replace(",3,2", ",9,2"), "heightmap.csv:3: num0 is '9', expected 2 to 3"),
    "spacing": (LINEAR, MAP.replace("60.00,3", "0,3"), "heightmap.csv:3: spacing1 is '0'"),
    "cells": (LINEAR, MAP.replace("0.000,0.200,", ""), "heightmap.csv:5: the row's length is '1'"),
    "rows": (LINEAR, MAP + "0,0,0\n", "heightmap.csv:6: the last row is '3', expected row 2"),
    "word": (LINEAR, MAP.replace("0.200", "0,2x0"), "heightmap.csv:5: the row's length is '4'"),
    "number": (LINEAR, MAP.replace("0.200", "0.2x"), "heightmap.csv:5: column 2 is '0.2x'"),
    "unit": (LINEAR, MAP.replace("0.200", "200.0"), "column 2 is '200.0', expected a height in mm"),
    "far": (
        LINEAR,
        MAP.replace("-40.00,40.00", "-400,400").replace("40.00,60", "400,60"),
        "heightmap.csv:4: position is 'x -410.000 y -30.000",
    ),
    "no rods": (LINEAR.replace("L250.000", ""), MAP, "config.g: no M665 L, expected rod lengths"),
    "rods": (LINEAR.replace("L250.000", "L25O"), MAP, "config.g:4: M665 L is '25O'"),
    "short rods": (LINEAR.replace("L250", "L100"), MAP, "config.g:4: M665 L is '100.000'"),
    "two rods": (LINEAR.replace("L250", "L250:251"), MAP, "config.g:4: M665 L is '250:251.000'"),
    "radius": (LINEAR.replace("R150", "R{var.r}"), MAP, "config.g:4: M665 R is '{var.r}'"),
    "comma": (LINEAR.replace("H240", "H240,5"), MAP, "config.g:4: M665 H is '240,5'"),
    "inches": (LINEAR.replace("G21", "G20"), MAP, "config.g:2: unit is 'G20', expected mill"),
    "CoreXY": (LINEAR + "M669 K1\n", MAP, "config.g:7: M669 K is '1', expected 3 (linear"),
    "lines": (LINEAR + "M669 K6 N4\n", MAP, "config.g:7: M669 K is '6'"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_a_broken_file_is_named_with_line_and_field(files, name):
    config, heights, message = BROKEN[name]
    with pytest.raises(ParallelCalError) as error:
        samples("rrf", files(config, heights))
    assert message in str(error.value)
    assert "expected" in str(error.value)
    assert "\n" not in str(error.value)


def test_the_commands_write_samples_and_a_model_that_can_be_read(files, tmp_path, capsys):
    heights, config = map(str, files())

    def run(*words):
        with pytest.raises(SystemExit) as ended:
            cli.main(words)
        assert ended.value.code in (0, None)
        return json.loads(capsys.readouterr().out)

    data, file = str(tmp_path / "data.json"), tmp_path / "printer.yaml"
    assert run("import", "rrf", heights, config, "-o", data, "--json")["samples"] == 4
    written = run("new", "--from", config, "-o", str(file), "--json")
    assert written["mechanism"] == "linear_delta"
    assert "inclinations" in written["remarks"][0]
    model = parse_model(file.read_text())
    assert model.mechanism.direction == pytest.approx(210 * DEGREE)
    compared = run("compare", str(file), data, "--json")
    assert compared["reading_mean"] == pytest.approx(0.0875e-3, abs=1e-7)


@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        (("new", "-o", "a.yaml"), 2, "--from FILE"),
        (("new", "delta24", "--from", "c.g", "-o", "a.yaml"), 2, "--from FILE"),
        (("new", "--from", "c.stl", "-o", "a.yaml"), 1, "(grblhal); .cfg (klipper);"),
        (("new", "--from", "c.urdf", "-o", "a.yaml"), 1, "c.urdf"),
        (
            ("new", "--from", "c.g", "--to-link", "b", "-o", "a.yaml"),
            2,
            "only a URDF, an MJCF or an SDF has links",
        ),
        (("import", "rrrf", "c.g", "-o", "a.json"), 1, "no importer 'rrrf': expected one of"),
        (("import", "rrf", "c.g", "-o", "a.json"), 1, "expected height maps (.csv)"),
        (("import", "rrf", "c.g", "h.csv", "-o", "a.json"), 1, "c.g: cannot be read: No such file"),
        (("import", "rrf", "c.g", "-o", "a.json", "--option", "x=1"), 1, "rrf: got an unexpected"),
    ],
)
def test_wrong_usage_is_reported_in_one_line(words, code, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as ended:
        cli.main(words)
    assert ended.value.code == code
    assert message in " ".join(capsys.readouterr().err.replace("│", "").split())
