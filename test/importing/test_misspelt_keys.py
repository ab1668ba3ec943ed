"""Slips in the keys of an owner's configuration: each is named with its line and what it resembles,
and no key that an importer does not know is called a slip."""

import pytest
import test_import_fluidnc as fluidnc
import test_import_klipper as klipper
import test_import_linuxcnc as linuxcnc
import test_import_maslow as maslow
import test_import_smoothieware as smoothieware

from parallel_cal.base.errors import DatasetError
from parallel_cal.importing.controller_files import configured, samples
from parallel_cal.importing.settings import Settings, SourceLine

HEXAPOD = linuxcnc.hexapod_pins()[0] + "setp genhexkins.tool-offset 0\n"
MARLIN = """\
#define DELTA_DIAGONAL_ROD 250
#define DELTA_RADIUS 124
#define DELTA_HEIGHT 300
#define DELTA_TOWER_ANGLE_TRIM { 0.0, 0.3, 0.0 }
#define DELTA_PRINTABLE_RADIUS 90
#define DELTA_SEGMENTS_PER_SECOND 100
"""
REPETIER = """\
#define DRIVE_SYSTEM 3
#define ZAXIS_STEPS_PER_MM 80
#define ROD_RADIUS 124
#define DELTA_DIAGONAL_ROD 250
#define Z_MAX_LENGTH 300
#define DELTA_ALPHA_B 331
"""
# File, text, key and its slip, what is meant.
SLIPS = [
    ("a.ini", maslow.INI, "motorspacingx", "motorSpaceingX", "[Maslow Settings] motorspacingx"),
    (
        "a.ini",
        maslow.INI,
        "rotationradius",
        "rotation_radius",
        "[Advanced Settings] rotationradius",
    ),
    ("a.ini", maslow.INI, "[Advanced S", "[Advancd S", "[Advanced Settings] kinematicstype"),
    ("a.cfg", klipper.LINEAR, "print_radius", "printer_radius_", "[printer] print_radius"),
    ("config", smoothieware.LINEAR, "tower2_offset", "tower2_ofset", "delta_tower2_offset"),
    ("a.yaml", fluidnc.DELTA, "up_degrees", "up_degree", "kinematics/parallel_delta/up_degrees"),
    ("a.hal", linuxcnc.HAL, "J1off", "J1of", "lineardeltakins.J1off"),
    ("Configuration.h", MARLIN, "ANGLE_TRIM", "ANGEL_TRIM", "DELTA_TOWER_ANGLE_TRIM"),
    ("Configuration.h", REPETIER, "ALPHA_B", "ALHPA_B", "DELTA_ALPHA_B"),
]
# Without these keys, a machine is not known.
FATAL = [
    (
        "a.cfg",
        klipper.LINEAR,
        "[stepper_b]\nrot",
        "[steper_b]\nrot",
        "[stepper_b] rotation_distance",
    ),
    ("a.cfg", klipper.LINEAR, "delta_radius = 150", "delta_raduis = 150", "[printer] delta_radius"),
    ("a.hal", HEXAPOD, "platform.3.x", "platfrom.3.x", "genhexkins.platform.3.x"),
    ("a.yaml", fluidnc.PLOTTER, "right_anchor_y", "right_ancor_y", "right_anchor_y"),
    ("Configuration.h", MARLIN, "DELTA_RADIUS", "DELTA_RADUIS", "DELTA_RADIUS"),
]


def write(folder, name, text):
    path = folder / name
    path.write_text(text)
    return path


@pytest.mark.parametrize(("name", "text", "key", "slip", "meant"), SLIPS)
def test_a_slip_in_a_key_is_named_with_its_line_and_what_is_meant(
    name, text, key, slip, meant, tmp_path
):
    right = configured([write(tmp_path, name, text)]).remarks
    assert not any("did you mean" in remark for remark in right)
    wrong = text.replace(key, slip, 1)
    line = next(k for k, row in enumerate(wrong.splitlines(), 1) if row not in text.splitlines())
    found = configured([write(tmp_path, name, wrong)]).remarks
    named = [remark for remark in found if f"did you mean {meant}?" in remark]
    assert len(named) == 1
    assert slip.startswith("[") or f"{name}:{line}:" in named[0]


@pytest.mark.parametrize(("name", "text", "key", "slip", "meant"), FATAL)
def test_a_slip_in_a_key_that_must_be_stated_is_part_of_the_error(
    name, text, key, slip, meant, tmp_path
):
    path = write(tmp_path, name, text.replace(key, slip))
    with pytest.raises(DatasetError, match=r"not used: did you mean .*") as error:
        configured([path])
    assert f"{meant}?" in str(error.value)


def test_an_import_of_marks_names_the_slip(tmp_path):
    slip = maslow.INI.replace("motoroffsety", "motoroffset_y")
    files = [write(tmp_path, "groundcontrol.ini", slip)]
    files.append(write(tmp_path, "marks.csv", "x,y,measured_x,measured_y\n0,0,1,1\n9,0,9,0\n"))
    (warning,) = samples("maslow", files).warnings
    assert "groundcontrol.ini:6: [Maslow Settings] motoroffset_y is not used" in warning


@pytest.mark.parametrize(
    ("asked", "stated"),
    [
        ("[probe] y_offset", "[probe] z_offset"),  # another axis
        ("[stepper_a] height1", "[stepper_a] height2"),  # another number
        ("[stepper_a] position_min", "[stepper_a] position_max"),  # the other end
        ("[stepper_a] angle", "[stepper_b] angles"),  # in a section that is not alike
        ("[stepper_a] angle", "[stepper_x] angle"),  # another motor
    ],
)
def test_names_that_are_alike_and_differ_in_meaning_are_no_slips(asked, stated, tmp_path):
    settings = Settings({stated: ("1", SourceLine(tmp_path / "a.cfg", 1))}, [tmp_path / "a.cfg"])
    assert asked not in settings
    assert settings.describe_unused() == []
