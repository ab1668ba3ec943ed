"""The class of a machine says how large its usual errors are: knowledge about machines, which
informs a fit and a diagnosis and never refuses what the data show."""

import json
from dataclasses import replace

import pytest
import test_export_heights
import test_import_fluidnc
import test_import_maslow
import test_import_repetier
import test_import_smoothieware
import test_import_tower_words
import test_import_ucnc
import virtual_printer as vp
from datasets import measured

from parallel_cal.base.errors import ModelError, ModelFileError
from parallel_cal.cli import main as cli
from parallel_cal.identification.fit import fit
from parallel_cal.importing.controller_files import configured
from parallel_cal.model.file.modelfile import dump_model, parse_model, read_model, write_model
from parallel_cal.model.model import new_model
from parallel_cal.virtual import robot as vr

WIDTH = "backlash.joint1.width"


def of_class(machine_class, *effects):
    return new_model("delta54", effects=effects, machine_class=machine_class)


def test_a_class_scales_the_usual_sizes_of_the_robots_effects_only():
    names = ("backlash", "hysteresis", "thermal_expansion", "device_axes")
    precise, usual, hobby = (
        of_class(one, *names).table for one in ("precision", "industrial", "hobby")
    )
    assert [*usual] == [*new_model("delta54", effects=names).structure.table]
    assert precise[WIDTH].tolerance == pytest.approx(0.2 * usual[WIDTH].tolerance)
    assert hobby[WIDTH].plausible_range() == pytest.approx((0, 5 * usual[WIDTH].high))
    unchanged = (
        "hysteresis.joint1.width",  # a known constant
        "thermal_expansion.arms.alpha",  # a property of the material
        "device_axes.scale_x",  # an error of the measuring device
        "chain1.Lb",  # geometry, whose tolerance the model file states
    )
    for name in unchanged:
        assert precise[name] == usual[name] == hobby[name]


def test_a_class_applies_to_effects_that_are_added_later_and_own_tolerances_replace_it():
    later = of_class("hobby").with_effect("backlash")
    assert [*later.table] == [*of_class("hobby", "backlash").table]
    own = replace(later, tolerances={WIDTH: 1e-4})
    assert own.table[WIDTH].tolerance == 1e-4
    assert own.table["backlash.joint2.width"] == later.table["backlash.joint2.width"]


def test_a_model_file_keeps_the_class_and_an_older_file_is_industrial(tmp_path):
    write_model(of_class("hobby", "backlash"), tmp_path / "hobby.yaml")
    read = read_model(tmp_path / "hobby.yaml")
    assert read.machine_class == "hobby"
    assert [*read.table] == [*of_class("hobby", "backlash").table]
    older = dump_model(new_model("delta54", effects=["backlash"]))
    assert "class:" not in older
    assert parse_model(older).machine_class == "industrial"


def test_an_unknown_class_is_refused_with_the_known_ones():
    text = dump_model(of_class("hobby")).replace("class: hobby", "class: hoby")
    with pytest.raises(ModelFileError, match=r"model:\d+: class: .*'precision', .*'hobby'.*'hoby'"):
        parse_model(text)
    with pytest.raises(ModelError, match=r"class 'toy': expected one of precision, industrial"):
        new_model("delta54", machine_class="toy")


def test_a_size_that_only_a_precision_machine_would_not_have_can_be_read():
    model = of_class("precision", "backlash")
    wide = model.with_values(model.values + 2e-3 * (model.structure.table.tolerance == 0.3e-3))
    assert wide.value(WIDTH) == 2e-3 > wide.table[WIDTH].high
    assert parse_model(dump_model(wide)).value(WIDTH) == 2e-3


def test_the_name_of_an_effect_stands_for_all_its_parameters_of_one_unit():
    def with_tolerances(words):
        text = dump_model(new_model("delta54"))
        return parse_model(text.replace("history:", f"tolerances: {{{words}}}\nhistory:"))

    model = with_tolerances("backlash: 34.0e-3, hysteresis: 1.0e-3")
    table = model.with_effect("backlash").with_effect("hysteresis").table
    assert {table[f"backlash.joint{i}.width"].tolerance for i in (1, 2, 3)} == {34e-3}
    assert table["hysteresis.joint2.lag"].tolerance == 1e-3
    usual = new_model("delta54", effects=["hysteresis"]).table["hysteresis.joint2.width"]
    assert table["hysteresis.joint2.width"] == usual  # a known constant
    again = parse_model(dump_model(model))
    assert again.tolerances == model.tolerances
    with pytest.raises(ModelFileError, match=r"payload_sag has parameters with different units"):
        with_tolerances("payload_sag: 1.0e-3")


@pytest.mark.parametrize(
    ("machine_class", "width", "is_unusual"),
    [
        ("precision", 1.2e-3, True),
        ("industrial", 1.2e-3, False),
        ("industrial", 8e-3, True),
        ("hobby", 8e-3, False),
    ],
)
def test_the_class_decides_what_is_larger_than_usual_and_the_data_decide_the_size(
    machine_class, width, is_unusual
):
    data = measured(7, effects=[vr.Backlash((width,) * 3)])
    found = fit(of_class(machine_class, "backlash"), data, hold_out=0)
    assert found.model.value(WIDTH) == pytest.approx(width, abs=0.1e-3)
    assert bool(found.unusual) == is_unusual
    assert parse_model(dump_model(found.model)).value(WIDTH) == found.model.value(WIDTH)


def run(*arguments):
    with pytest.raises(SystemExit) as ended:
        cli.main([str(a) for a in arguments])
    return ended.value.code


def test_new_writes_the_class_and_info_shows_it(tmp_path, capsys):
    file = tmp_path / "printer.yaml"
    assert run("new", "linear_delta", "--class", "hobby", "-o", file) == 0
    assert capsys.readouterr().out.strip().endswith("class hobby")
    assert read_model(file).machine_class == "hobby"
    assert run("info", file) == 0
    shown = capsys.readouterr().out
    assert "class: hobby" in shown
    assert "effects: none" in shown
    usual = "those of the mechanism and, for class hobby, of the catalogue"
    assert f"tolerances: {usual}" in shown
    assert run("info", file, "--json") == 0
    document = json.loads(capsys.readouterr().out)
    assert (document["class"], document["mechanism"]) == ("hobby", "linear_delta")
    assert run("new", "delta54", "--class", "toy", "-o", tmp_path / "toy.yaml") != 0
    assert "expected one of precision, industrial, hobby" in capsys.readouterr().err
    assert not (tmp_path / "toy.yaml").exists()


@pytest.mark.parametrize(
    ("more", "found"),
    [
        ([], "hobby"),
        (["--class", "industrial"], "industrial"),
        (["--class", "precision"], "precision"),
    ],
)
def test_a_printers_configuration_makes_a_hobby_machine_unless_a_class_is_stated(
    more, found, tmp_path, capsys
):
    (tmp_path / "config.g").write_text(vp.CONFIG)
    with pytest.raises(SystemExit) as ended:
        cli.main(
            ["new", "--from", str(tmp_path / "config.g"), "-o", str(tmp_path / "m.yaml"), *more]
        )
    assert ended.value.code in (0, None)
    assert read_model(tmp_path / "m.yaml").machine_class == found
    said = capsys.readouterr().out
    assert (f"class {found}" in said) is (found != "industrial")
    assert ("--class states another one" in said) is (not more)


@pytest.mark.parametrize(
    "kind",
    [
        "klipper",
        "rrf",
        "marlin",
        "grblhal",
        "linuxcnc",
        "smoothieware",
        "mk4duo",
        "richcattell",
        "repetier",
        "ucnc",
        "fluidnc",
        "maslow",
    ],
)
def test_the_firmware_of_printers_has_the_class_of_printers(kind, tmp_path):
    texts = {
        "klipper": ("printer.cfg", test_export_heights.KLIPPER),
        "rrf": ("config.g", vp.CONFIG),
        "marlin": ("printer.gcode", test_export_heights.MARLIN),
        "grblhal": ("settings.txt", "$641=250\n$642=100\n$643=200\n$644=20\n$646=0\n"),
        "fluidnc": ("config.yaml", test_import_fluidnc.DELTA),
        "mk4duo": ("printer.log", test_import_tower_words.MK4DUO),
        "richcattell": ("printer.log", test_import_tower_words.RICHCATTELL),
        "repetier": ("printer.log", test_import_repetier.REPORT),
        "ucnc": ("settings.txt", test_import_ucnc.SETTINGS),
        "smoothieware": ("config", test_import_smoothieware.LINEAR),
        "maslow": ("groundcontrol.ini", test_import_maslow.INI),
        "linuxcnc": ("machine.hal", "setp lineardeltakins.R 100\nsetp lineardeltakins.L 250\n"),
    }
    name, text = texts[kind]
    (tmp_path / name).write_text(text)
    expected = "industrial" if kind == "linuxcnc" else "hobby"
    assert configured([tmp_path / name]).model.machine_class == expected
