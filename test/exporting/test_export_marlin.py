"""M665 and M666 of Marlin: written for both kinds of M665, and into the user's own files."""

import numpy as np
import pytest
import virtual_firmware as vf
from test_export_firmware import moved, off

from parallel_cal.base.errors import ParallelCalError
from parallel_cal.exporting.export import export, export_into
from parallel_cal.importing.controller_files import configured
from parallel_cal.model.model import new_model

LOG = """\
Recv: echo:  M92 X80.00 Y80.00 Z80.00 E95.00
Recv: echo:  M665 L250.00 R150.00 H300.00 S200.00 X0.00 Y0.00 Z0.00 A0.00 B0.00 C0.00 ; mine
Recv: echo:  M666 X0.00 Y-0.50 Z-1.00
Recv: echo:  M851 X10.00 Y-5.00 Z-2.00 ; (mm)
"""
HEADER = """\
#define DELTA
#if ENABLED(DELTA)
  #define DELTA_DIAGONAL_ROD 250.0        // (mm) 250.0 by the drawing
  #define DELTA_HEIGHT 300.00             // (mm)
  #define DELTA_ENDSTOP_ADJ { 0.0, -0.5, -1.0 } // (mm)
  #define DELTA_RADIUS 150.0 // 124.0
  #define DELTA_TOWER_ANGLE_TRIM { 0.0, 0.0, 0.0 } // from { 0, 0, 0 }
  //#define DELTA_RADIUS_TRIM_TOWER       { 9.0, 9.0, 9.0 } // (mm)
#endif
#define NOZZLE_TO_PROBE_OFFSET { 10, -5, -2 }
"""


def defined(text):
    """Numbers of a header's definitions by their name, read by simple means."""
    found = {}
    for line in text.splitlines():
        parts = line.split("//")[0].split(None, 2)
        if parts[:1] == ["#define"] and len(parts) == 3:
            found[parts[1]] = [float(word) for word in parts[2].strip("{} ").split(",")]
    return found


def test_a_robot_as_drawn_has_the_commands_of_its_drawing(tmp_path):
    done = export(new_model("linear_delta"), "marlin", tmp_path)
    assert (tmp_path / "marlin.gcode").read_text() == (
        "M665 L250.0000 R100.0000 H370.8712 X0.0000 Y0.0000 Z0.0000 A0.0000 B0.0000 C0.0000\n"
        "M666 X0.0000 Y0.0000 Z0.0000\n"
    )
    assert done.remarks[0].startswith("send M500 after these commands")


def test_rods_are_trimmed_only_where_m665_has_trims(tmp_path):
    model = off("linear_delta", 0.1)
    loss = {}
    for target in ("marlin", "marlin_equal_rods"):
        done = export(model, target, tmp_path / target)
        firmware = vf.Marlin((tmp_path / target / "marlin.gcode").read_text())
        loss[target] = done.loss["position_mean"]
        assert ("M665 B" in firmware.w) == (target == "marlin")
        assert any("use the target marlin_equal_rods" in r for r in done.remarks) == (
            target == "marlin"
        )
    assert loss["marlin"] < loss["marlin_equal_rods"]


@pytest.mark.parametrize("seed", range(3))
def test_a_carriage_goes_down_by_nothing_or_by_more_than_marlin_ignores(seed, tmp_path):
    """Of end-stops that differ by a few hundredths of a mm, each is 0.1 mm lower."""
    model = new_model("linear_delta")
    rng = np.random.default_rng(seed)
    ends = 0.6 + rng.uniform(0, 60e-6, 3)
    model.mechanism.joint_limits = tuple((0.1, float(top)) for top in ends)
    export(model, "marlin", tmp_path)
    firmware = vf.Marlin((tmp_path / "marlin.gcode").read_text())
    asked = -firmware.three("M666", "XYZ")
    np.testing.assert_allclose(firmware.retracts(), asked)
    assert asked.min() == pytest.approx(0.1)


@pytest.mark.wide
@pytest.mark.parametrize(("name", "text"), [("printer.log", LOG), ("Configuration.h", HEADER)])
def test_a_users_file_gets_the_numbers_and_keeps_the_rest(name, text, tmp_path):
    file = tmp_path / name
    file.write_text(text)
    model = configured([file]).model
    assert model.sensors[0].tip == (0.01, -0.005, -0.002)
    tops = [high for _, high in model.mechanism.joint_limits]
    np.testing.assert_allclose(tops, [0.5, 0.5005, 0.501], atol=1e-12)
    same = export_into(model, "marlin", [file])
    assert same.before["position_max"] < 0.2e-6
    assert same.loss["position_max"] < 0.2e-6
    assert file.read_text() == text
    done = export_into(moved(model), "marlin", [file])
    assert done.loss["position_mean"] < 0.5 * done.before["position_mean"]
    again = export_into(configured([file]).model, "marlin", [file])
    assert again.loss["position_max"] < 0.2e-6
    if name.endswith(".h"):
        numbers = defined(file.read_text())
        assert numbers["DELTA_RADIUS"][0] == pytest.approx(150, abs=1)
        assert numbers["DELTA_RADIUS"] != [150]
        assert len(numbers["DELTA_DIAGONAL_ROD_TRIM_TOWER"]) == 3
        assert "{ 9.0, 9.0, 9.0 } // (mm)" in file.read_text()
    for comment in ("; mine", "// (mm) 250.0 by the drawing", "// 124.0", "// from { 0, 0, 0 }"):
        assert (comment in text) == (comment in file.read_text())


def test_the_radius_of_each_tower_in_the_header_is_read_and_its_trims_are_cleared(tmp_path):
    file = tmp_path / "Configuration.h"
    file.write_text(HEADER.replace("//#define DELTA_RADIUS_TRIM", "#define DELTA_RADIUS_TRIM"))
    model = configured([file]).model
    assert model.value("chain2.D_x") == pytest.approx(0.159)
    before = file.read_text()
    export_into(model, "marlin", [file])
    assert file.read_text() == before
    export_into(moved(model), "marlin", [file])
    assert defined(file.read_text())["DELTA_RADIUS_TRIM_TOWER"] == [0, 0, 0]
    assert defined(file.read_text())["DELTA_RADIUS"] == [pytest.approx(159, abs=1)]


BROKEN = {
    "sum": ("150.0 // 124.0", "(A - B - C)", "DELTA_RADIUS is '(A - B - C)', expected a numbe"),
    "braces": ("{ 0.0, -0.5, -1.0 }", "{ 0.0, -0.5 }", "DELTA_ENDSTOP_ADJ is '{ 0.0, -0.5 }', exp"),
    "up": ("-0.5", "0.5", "M666 Y is '0.5', expected mm, 0 or less"),
    "twice": ("#endif", "#define DELTA_RADIUS 97.0\n#endif", "expected one definition of it"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_a_header_that_cannot_be_read_is_refused_with_its_line(name, tmp_path):
    old, new, message = BROKEN[name]
    (tmp_path / "Configuration.h").write_text(HEADER.replace(old, new, 1))
    with pytest.raises(ParallelCalError) as error:
        configured([tmp_path / "Configuration.h"])
    assert message in str(error.value)
    assert "Configuration.h:" in str(error.value)
