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
    values = model.values.copy()
    for i in (1, 2, 3):  # with the same end-stops, rods 1 mm longer put the nozzle lower
        values[model.table.index_of(f"chain{i}.Lb")] += MM
    export_into(model.with_values(values), "richcattell", [path])
    now = read(path.read_text())
    assert now["M206 Z"] == 0
    # 250^2 = 150^2 + 200^2, in mm: the mean tower is at 150 + 0.4 / 3
    lower = np.sqrt(251**2 - 150.133**2) - np.sqrt(250**2 - 150.133**2)
    assert now["M666 H"] == pytest.approx(300.5 - lower, abs=5e-3)


@pytest.mark.parametrize("kind", LOGS)
def test_an_unchanged_model_changes_nothing(kind, tmp_path):
    path = written(tmp_path, LOGS[kind])
    export_into(configured([path]).model, kind, [path])
    assert path.read_text() == LOGS[kind]


def test_a_command_gets_all_its_words(tmp_path):
    """A printer keeps what it has stored where a command lacks the word."""
    path = written(tmp_path, "M666 R150 D250 H300 U0\n", "printer.gcode")
    model = configured([path]).model
    values = model.values.copy()
    values[model.table.index_of("chain1.Lb")] += 0.5 * MM
    export_into(model.with_values(values), "mk4duo", [path])
    assert set("ABCIJKUVWXYZRDH") <= {word[0] for word in path.read_text().split()}


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
        ("Z0.50", "Z-300", ":2: M206 Z is '-300', expected the homed height in mm, more than 0"),
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
