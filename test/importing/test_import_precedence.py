"""Of two values in the files of a firmware, the one counts with which the firmware moves.

The rules are those of klippy/configfile.py (Klipper 84104bbbd), which was run on these files, of
GCodes2.cpp (RepRapFirmware 3.5.3: M501 runs config-override.g at its place) and of settings.cpp
(Marlin: a stored value replaces that of Configuration.h, M502 returns to it).
"""

import pytest
import virtual_firmware as vf

from parallel_cal.base.errors import DatasetError, ModelError
from parallel_cal.exporting.export import export_into
from parallel_cal.importing.controller_files import configured
from parallel_cal.importing.importers import klipper

MAIN = """\
[printer]
kinematics: delta
delta_radius: 174.75

[stepper_a]
position_endstop: 297.05
arm_length: 333.0
[stepper_b]
microsteps: 16
[stepper_c]
microsteps: 16
"""
HEADER = """\

#*# <---------------------- SAVE_CONFIG ---------------------->
#*# DO NOT EDIT THIS BLOCK OR BELOW. The contents are auto-generated.
#*#
"""
SAVED = """\
#*# [printer]
#*# delta_radius = 170.123
#*#
#*# [stepper_a]
#*# angle = 209.5
#*# arm_length = 332.5
"""
NEW = MAIN.replace("174.75", "171.5").replace("333.0", "331.25")


@pytest.fixture
def write(tmp_path):
    """write(text, name): the path of a file with the text."""

    def written(text, name="printer.cfg"):
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        path.write_text(text)
        return path

    return written


def fields(*paths):
    return {name: text for name, (text, _) in klipper.settings(paths).texts.items()}


def test_the_main_part_counts_where_save_config_states_the_same_option(write):
    path = write(MAIN + HEADER + SAVED)
    read = fields(path)
    assert read["[printer] delta_radius"] == "174.75"
    assert read["[stepper_a] arm_length"] == "333.0"
    assert read["[stepper_a] angle"] == "209.5"
    (remark,) = [text for text in configured([path]).remarks if "SAVE_CONFIG" in text]
    assert "SAVE_CONFIG's values of [printer] delta_radius, [stepper_a] arm_length are " in remark
    model = configured([path]).model
    assert model.value("chain2.D_x") == pytest.approx(0.17475, abs=1e-12)


@pytest.mark.parametrize(
    ("below", "line"),
    [
        ("\n[gcode_macro X]\ngcode:\n  G28\n", 23),
        ("# a note\n", 22),
        ("#*#no space\n", 22),
        ("\n#*# [stepper_b]\n", 22),  # the empty line ends it
        (HEADER + SAVED, 23),
    ],
)
def test_text_below_it_makes_klipper_ignore_what_save_config_wrote(write, below, line):
    path = write(MAIN + HEADER + SAVED + below)
    assert fields(path)["[stepper_a] arm_length"] == "333.0"
    assert "[stepper_a] angle" not in fields(path)
    (remark,) = klipper.settings([path]).remarks
    assert f"the SAVE_CONFIG block is not read, because line {line} does not belong" in remark
    path = write(MAIN.replace("delta_radius: 174.75\n", "") + HEADER + SAVED + below)
    with pytest.raises(DatasetError, match=r"no \[printer\] delta_radius, .*SAVE_CONFIG block is"):
        configured([path])


@pytest.mark.parametrize("below", ["", "\n\n", "#*#\n"])
def test_empty_lines_below_it_leave_it_valid(write, below):
    assert fields(write(MAIN + HEADER + SAVED + below))["[stepper_a] angle"] == "209.5"


def test_an_included_file_counts_at_its_place(write, tmp_path):
    write("[printer]\ndelta_radius: 160.0\n[include deeper/*.cfg]\n", "sub/extra.cfg")
    write("[stepper_b]\nangle: 331\n", "sub/deeper.cfg")
    (tmp_path / "sub" / "deeper").mkdir()
    write("[stepper_b]\nangle: 332\n", "sub/deeper/b.cfg")
    write("[stepper_b]\nangle: 331\n", "sub/deeper/a.cfg")
    last = fields(write(MAIN + "[include sub/extra.cfg]\n" + HEADER + SAVED))
    assert (last["[printer] delta_radius"], last["[stepper_b] angle"]) == ("160.0", "332")
    first = fields(write("[include sub/extra.cfg]\n" + MAIN))
    assert (first["[printer] delta_radius"], first["[stepper_b] angle"]) == ("174.75", "332")


def test_a_file_that_includes_itself_is_refused(write):
    write("[include printer.cfg]\n", "extra.cfg")
    with pytest.raises(DatasetError, match=r"extra.cfg:1: \[include\] is 'printer.cfg', expected"):
        configured([write(MAIN + "[include extra.cfg]\n")])


def test_a_second_file_that_is_not_included_is_refused(write):
    extra = write("[printer]\ndelta_radius: 160\n", "extra.cfg")
    with pytest.raises(DatasetError, match=r"extra\.cfg: .*does not include it, so Klip"):
        configured([write(MAIN), extra])
    path = write(MAIN + "[include extra.cfg]\n")
    assert fields(extra, path)["[printer] delta_radius"] == "160"  # in any order


@pytest.mark.parametrize(
    ("line", "value"),
    [
        ("Delta_Radius: 165", "165"),
        ("delta_radius: 165# radius", "165"),
        ("delta_radius: 165 ; note", "165"),
        ("delta_radius:\n  165", "165"),
        ("delta_radius: 1\ndelta_radius = 165", "165"),
        ("delta_radius: 1\n[Printer]\ndelta_radius: 2\n[printer]\ndelta_radius: 165", "165"),
        ("delta_radius: 165;note", None),
    ],
)
def test_values_are_read_as_klipper_reads_them(write, line, value):
    path = write(MAIN.replace("delta_radius: 174.75", line))
    if value is None:
        with pytest.raises(DatasetError, match="delta_radius is '165;note', expected mm"):
            configured([path])
        return
    assert fields(path)["[printer] delta_radius"] == value
    model = configured([path]).model
    assert model.value("chain3.D_x") == pytest.approx(0.165, abs=1e-12)
    new = configured([write(NEW, "new.cfg")]).model
    export_into(new, "klipper", [path])
    assert float(fields(path)["[printer] delta_radius"]) == 171.5
    assert float(fields(path)["[stepper_a] arm_length"]) == 331.25


def test_defaults_of_b_and_c_are_those_of_a_and_angles_are_usual(write):
    read = klipper.delta(klipper.settings([write(MAIN)]))
    assert read.rods.tolist() == [0.333] * 3
    assert read.first + read.trim == pytest.approx([3.6651914] * 3)  # 210 degrees, then by 120


def test_gear_ratios_multiply(write):
    """107/16 * 60/16 = 25.078125."""
    text = MAIN.replace(
        "[stepper_b]", "gear_ratio: 107:16, 60:16,\n[stepper_b]\ngear_ratio:\n  2:1"
    )
    assert klipper.gears(klipper.settings([write(text)])).tolist() == [25.078125, 2.0, 1.0]


@pytest.mark.parametrize(
    "text",
    [
        MAIN + HEADER + SAVED,
        MAIN.replace("delta_radius: 174.75\n", "") + HEADER + SAVED,
        MAIN + HEADER + SAVED + "\n[gcode_macro X]\ngcode:\n  G28\n",
        MAIN.replace("\nmicrosteps", "\n  microsteps").replace("[stepper_c]\n  ", "[stepper_c]\n#")
        + HEADER
        + SAVED,
    ],
)
def test_new_numbers_are_written_where_klipper_reads_them(write, text):
    path = write(text)
    done = export_into(configured([write(NEW, "new.cfg")]).model, "klipper", [path])
    assert done.loss["position_max"] < 1e-9
    read, wanted = klipper.settings([path]), klipper.settings([write(NEW, "new.cfg")])
    for field in ("[printer] delta_radius", "[stepper_a] arm_length", "[stepper_a] angle"):
        expected = wanted.number(field, "a number", 210.0)
        assert read.number(field, "a number", 210.0) == expected
    assert klipper.delta(read).rods == pytest.approx([0.33125] * 3)
    assert ("gcode_macro" in text) == any("is not read" in remark for remark in done.remarks)


def test_new_numbers_that_an_included_file_overrides_are_refused_with_the_cure(write):
    extra = write("[printer]\ndelta_radius: 160.0\n[stepper_b]\nangle: 332\n", "extra.cfg")
    path = write(MAIN + "[include extra.cfg]\n")
    model = configured([write(NEW, "new.cfg")]).model
    before = path.read_text(), extra.read_text()
    with pytest.raises(ModelError) as error:
        export_into(model, "klipper", [path])
    assert f"{extra}:2: [printer] delta_radius is '160.0'" in str(error.value)
    assert f"--into {path} --into {extra} changes it there" in str(error.value)
    assert (path.read_text(), extra.read_text()) == before
    done = export_into(model, "klipper", [path, extra])
    assert done.loss["position_max"] < 1e-9
    read = fields(path)
    assert float(read["[printer] delta_radius"]) == 171.5
    assert float(read["[stepper_b] angle"]) == 330
    assert extra.read_text().count("171.5") == 1


CONFIG_G = "M92 X160 Y160 Z160\nM665 R102 L250 H300 B80\nM666 X0 Y0 Z0\n"


@pytest.mark.parametrize(
    ("config", "radius"),
    [
        (CONFIG_G, 102),  # no M501: nothing loads the other file
        (CONFIG_G + "; M501\n", 102),
        (CONFIG_G + "M501\n", 100),
        ("M501 ; load it\n" + CONFIG_G, 102),  # the lines behind M501 count
        ("M501\n" + CONFIG_G + "M501\n", 100),  # it is run each time
    ],
)
def test_config_override_counts_where_m501_loads_it(write, config, radius):
    override = write("M665 R100\nM501\n", "config-override.g")
    path = write(config, "config.g")
    for paths in ([path], [path, override], [override, path]):
        found = configured(paths)
        assert found.model.value("chain2.D_x") == pytest.approx(radius * 1e-3)
        unused = [text for text in found.remarks if "no M501 loads it" in text]
        assert bool(unused) == ("\nM501\n" not in f"\n{config}" and "M501 ;" not in config) * (
            override in paths
        )


def test_an_override_that_is_missing_is_named(write):
    (remark,) = [
        text
        for text in configured([write(CONFIG_G + "M501\n", "config.g")]).remarks
        if "config-override.g" in text
    ]
    assert "the included file config-override.g was not found and not read" in remark


def test_a_dead_override_is_not_written_to(write):
    override, path = write("M665 R100\n", "config-override.g"), write(CONFIG_G, "config.g")
    model = configured([write(CONFIG_G.replace("R102", "R101"), "new.g")]).model
    done = export_into(model, "rrf", [path, override])
    assert vf.words(path.read_text())["M665 R"] == 101
    assert override.read_text() == "M665 R100\n"
    assert done.loss["position_max"] < 0.2e-6


HEADER_H = """\
#define DELTA_DIAGONAL_ROD 250.0 // mm
#define DELTA_RADIUS 124.0
#define DELTA_HEIGHT 295.0
#define DELTA_ENDSTOP_ADJ { 0.0, -0.5, -0.25 }
"""
DUMP = "echo:  M665 L250.00 R{0} H295.00 S200.00 X0.00 Y0.00 Z0.00 A0.00 B0.00 C0.00\n"


@pytest.mark.parametrize(
    ("log", "radius"),
    [
        (DUMP.format(124) + DUMP.format(123), 123),  # the later of two reports
        (DUMP.format(123) + "Send: M500\nSend: M665 R120\nSend: M501\n", 123),
        (DUMP.format(123) + "Send: M500\nSend: M665 R120\n", 120),
        (DUMP.format(123) + "Send: M500\nSend: M502\nSend: M501\n", 123),  # M502 stores nothing
        (DUMP.format(123) + "Send: M502\n" + DUMP.format(122), 122),
    ],
)
def test_the_last_settings_in_marlins_memory_count(write, log, radius):
    model = configured([write(log, "m503.log")]).model
    assert model.value("chain2.D_x") == pytest.approx(radius * 1e-3)


def test_settings_before_m502_do_not_count(write):
    log = write(DUMP.format(123) + "Send: M502\n", "m503.log")
    with pytest.raises(DatasetError, match=r"no M665 R, .*m503\.log:2: M502 returns to"):
        configured([log])
    model = configured([log, write(HEADER_H, "Configuration.h")]).model
    assert model.value("chain2.D_x") == pytest.approx(0.124)


def test_values_that_m501_returns_to_must_be_in_the_log(write):
    """Marlin prints them after M501 unless EEPROM_CHITCHAT is off; a printer may have other ones
    in its memory than those that it stored."""
    silent = write(DUMP.format(120) + "Send: M501\n", "silent.log")
    (remark,) = [text for text in configured([silent]).remarks if "M501" in text]
    assert "silent.log:2: M501 returns to values that M500 stored before this log" in remark
    shown = configured([write(DUMP.format(120) + "Send: M501\n" + DUMP.format(123), "m501.log")])
    assert shown.model.value("chain2.D_x") == pytest.approx(0.123)
    assert not any("M501" in text for text in shown.remarks)


def test_a_value_set_after_m500_is_gone_after_m501(write):
    """The stored radius is not in this log: the one that was set since must not pass for it."""
    stored = "Send: M665 L250 H295 X0 Y0 Z0 A0 B0 C0\nSend: M500\n"
    log = write(stored + "Send: M665 R120\nSend: M501\n", "part.log")
    with pytest.raises(DatasetError, match="no M665 R"):
        configured([log])


def test_stored_settings_count_before_those_of_configuration_h(write):
    log, header = write(DUMP.format(123), "m503.log"), write(HEADER_H, "Configuration.h")
    for paths in ([log, header], [header, log]):
        assert configured(paths).model.value("chain2.D_x") == pytest.approx(0.123)
    model = configured([write(HEADER_H.replace("124", "122"), "new.h")]).model
    done = export_into(model, "marlin", [log, header])
    assert done.loss["position_max"] < 0.2e-6
    assert configured([log]).model.value("chain2.D_x") == pytest.approx(0.122, abs=1e-7)
    assert configured([header]).model.value("chain2.D_x") == pytest.approx(0.122, abs=1e-7)
