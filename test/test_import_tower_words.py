"""M666 of MK4duo and of RichCattell's Marlin: read as each firmware computes, and written back."""

import numpy as np
import pytest
import virtual_firmware as vf
from test_export_firmware import moved
from test_import_smoothieware import assert_moves_as_computed

from parallel_cal.base.errors import ParallelCalError
from parallel_cal.exporting.export import export, export_into
from parallel_cal.importing.controller_files import configured
from parallel_cal.model.model import new_model

MM = 1e-3
MK4DUO = """\
Recv: Config:Steps per unit:
Recv: Config:  M92 X80.000 Y80.000 Z80.000
Recv: Config:Endstop adjustment:
Recv: Config:  M666 X0.00 Y-0.50 Z-1.00
Recv: Config:Delta Geometry adjustment: ABC<TOWER_*_DIAGROD_ADJ> IJK<TOWER_*_ANGLE_ADJ>
Recv: Config:  M666 A0.100 B0.000 C0.000 I0.200 J0.000 K-0.300 U0.000 V0.400 W0.000
Recv: Config:  M666 R150.00 D250.00
Recv: Config:  M666 S200 F50 L20
Recv: Config:  M666 O75.00 P70.00 H300.000
"""
RICHCATTELL = """\
echo:Home offset (mm):
echo:  M206 X0.00 Y0.00 Z0.50
echo:Endstop adjustment (mm):
echo:  M666 X0.00 Y-0.50 Z-1.00
echo:Delta Geometry adjustment:
echo:  M666 A0.30 B0.00 C-0.20 E0.00 F0.40 G0.00 R150.00 D250.00 H300.00 P0.00 ; mine
"""
LOGS = {"mk4duo": MK4DUO, "richcattell": RICHCATTELL}


def commands(log):
    """The commands of a log without what stands before them."""
    lines = [line[line.index("  M") :] for line in log.splitlines() if ":  M" in line]
    return "\n".join(lines) or log


def read(log):
    return vf.words(commands(log))


def written(folder, text, name="printer.log"):
    (folder / name).write_text(text)
    return folder / name


@pytest.mark.parametrize("kind", LOGS)
def test_a_printer_moves_as_its_firmware_computes(kind, tmp_path):
    model = configured([written(tmp_path, LOGS[kind])]).model
    assert_moves_as_computed(model, getattr(vf, kind)(commands(LOGS[kind])), MM, 1)


def test_the_same_letters_mean_what_each_firmware_takes_them_for(tmp_path):
    """A1 is a rod 1 mm longer for MK4duo, and a tower turned by 1 degree for RichCattell's."""
    words = "M666 R150 D250 H300 A1 J2\n"
    rod = configured([written(tmp_path, words + "M666 U0\n", "a.gcode")]).model
    turned = configured([written(tmp_path, words, "b.gcode")])
    assert rod.value("chain1.Lb") == pytest.approx(0.251)
    assert turned.model.value("chain1.Lb") == pytest.approx(0.25)
    angle = np.degrees(np.arctan2(*(turned.model.value(f"chain1.D_{a}") for a in "yx")))
    assert angle == pytest.approx(1.0)
    assert turned.model.value("chain2.D_x") == pytest.approx(0.152)
    assert any("add U0 V0 W0" in remark for remark in turned.remarks)


@pytest.mark.parametrize("kind", LOGS)
def test_a_users_file_gets_the_numbers_and_keeps_the_rest(kind, tmp_path):
    text = LOGS[kind].replace("Z0.50", "Z0.00")
    path = written(tmp_path, text)
    model = configured([path]).model
    same = export_into(model, kind, [path])
    assert same.before["position_max"] < 0.2e-6
    numbers = read(text)
    now = read(path.read_text())
    for field in numbers:
        np.testing.assert_allclose(now[field], numbers[field], atol=1e-4)
    done = export_into(moved(model), kind, [path])
    assert done.loss["position_mean"] < 0.5 * done.before["position_mean"]
    assert len(path.read_text().splitlines()) == len(text.splitlines())
    assert ("; mine" in text) == ("; mine" in path.read_text())
    again = configured([path]).model
    assert export_into(again, kind, [path]).before["position_max"] < 0.2e-6
    if kind == "richcattell":  # a report calls the radii E F G, the command I J K: both have them
        now = read(path.read_text())
        assert [now[f"M666 {w}"] for w in "EFG"] == [now[f"M666 {w}"] for w in "IJK"]


def test_the_offset_of_the_homed_height_is_cleared(tmp_path):
    path = written(tmp_path, RICHCATTELL)
    model = configured([path]).model
    export_into(model, "richcattell", [path])
    now = read(path.read_text())
    assert now["M206 Z"] == 0
    assert now["M666 H"] == pytest.approx(300.5, abs=1e-4)


@pytest.mark.parametrize("kind", LOGS)
def test_what_was_exported_is_read_again(kind, tmp_path):
    done = export(new_model("linear_delta"), kind, tmp_path)
    assert done.loss["position_max"] < 0.2e-6
    text = done.paths[0].read_text()
    assert_moves_as_computed(configured(done.paths).model, getattr(vf, kind)(text), MM, 1)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("D250.00", "D100.00", r":6: M666 D is '100.00', expected the rods' length in mm"),
        ("H300.00", "", "no M666 H, expected the homed height"),
        ("Y-0.50", "Y0.50", r":4: M666 Y is '0.50', expected mm, 0 or less"),
        ("X0.00 Y0.00 Z0.50", "X0.00 Y2.00", r":2: M206 Y is '2.00', expected 0: a Delta"),
    ],
)
def test_settings_that_cannot_be_are_named(old, new, message, tmp_path):
    with pytest.raises(ParallelCalError, match=message):
        configured([written(tmp_path, RICHCATTELL.replace(old, new))])


@pytest.mark.parametrize("kind", LOGS)
@pytest.mark.parametrize(("word", "expected"), [("R150.00 ", "M666 R"), ("D250.00", "M666 D")])
def test_the_word_that_is_missing_is_named(kind, word, expected, tmp_path):
    with pytest.raises(ParallelCalError, match=f"no {expected}, expected the "):
        configured([written(tmp_path, LOGS[kind].replace(word, ""))])
