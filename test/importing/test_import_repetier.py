"""Repetier's EEPROM and Configuration.h: read as the firmware computes, and written as M206."""

import numpy as np
import pytest

from parallel_cal.base.errors import ParallelCalError
from parallel_cal.exporting.export import export, export_into
from parallel_cal.importing.controller_files import configured
from parallel_cal.importing.importers import repetier
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.drive import Drive
from parallel_cal.model.model import new_model
from parallel_cal.model.shelf import load_mechanism

STEP = 1e-5  # m: 100 steps per mm
# The numbers of a printer that its owner published.
REPORT = """\
16:06:09.018 : EPR:2 75 250000 Baudrate
EPR:3 11 100.0000 Steps per mm
EPR:3 153 297.060 Z max length [mm]
EPR:3 881 217.000 Diagonal rod length [mm]
EPR:3 885 94.080 Horizontal rod radius at 0,0 [mm]
EPR:1 893 107 Tower X endstop offset [steps]
EPR:1 895 -16 Tower Y endstop offset [steps]
EPR:1 897 99 Tower Z endstop offset [steps]
EPR:3 901 209.950 Alpha A(210):
EPR:3 905 329.550 Alpha B(330):
EPR:3 909 90.000 Alpha C(90):
EPR:3 913 0.030 Delta Radius A(0):
EPR:3 917 0.400 Delta Radius B(0):
EPR:3 921 -0.430 Delta Radius C(0):
EPR:3 933 0.000 Corr. diagonal A [mm]
EPR:3 1024 0.000 Coating thickness [mm]
"""
# For these numbers, its updateDerivedParameter and transformCartesianStepsToDeltaSteps (1.0.4),
# compiled and run, place the towers and, for three nozzles, the carriages, all in steps.
TOWERS = ((-8154, -4698), (8145, -4788), (0, 9365))
CARRIAGES = (
    ((0, 0, 29706), (49259, 49241, 49281)),
    ((3000, -4000, 1000), (19600, 22066, 17830)),
    ((-5000, 2000, 0), (20398, 15875, 19790)),
)
HEADER = """\
#define DRIVE_SYSTEM 3
#define STEPS_PER_ROTATION 200
#define MICRO_STEPS 16
#define BELT_PITCH 2
#define PULLEY_TEETH 20 // GT2
#define ZAXIS_STEPS_PER_MM (float(MICRO_STEPS * STEPS_PER_ROTATION) / PULLEY_CIRCUMFERENCE)
#define Z_MAX_LENGTH 300
#define DELTA_DIAGONAL_ROD 250
#define END_EFFECTOR_HORIZONTAL_OFFSET 33
#define CARRIAGE_HORIZONTAL_OFFSET 18
#define PRINTER_RADIUS 175.5
#define DELTA_X_ENDSTOP_OFFSET_STEPS 40
"""


def written(folder, text=REPORT, name="printer.log"):
    (folder / name).write_text(text)
    return folder / name


def test_the_robot_moves_as_the_firmware_computes(tmp_path):
    """It cuts a carriage's height off to whole steps."""
    path = written(tmp_path)
    delta = repetier.towers(repetier.settings([path]))
    np.testing.assert_allclose(delta.towers / STEP, TOWERS, atol=1e-9)
    r, steps = (np.array([row[k] for row in CARRIAGES]) for k in (0, 1))
    found = Kinematics(configured([path]).model).inverse(r * STEP).joints / STEP
    assert ((found - steps >= 0) & (found - steps < 1)).all()


def test_carriages_go_down_from_their_end_stops_by_their_offsets(tmp_path):
    """After homing, the nozzle is at Z max length less the coating."""
    path = written(tmp_path, REPORT.replace("1024 0.000", "1024 0.200"))
    model = configured([path]).model
    tops = np.array([high for _, high in model.mechanism.joint_limits])
    at = Kinematics(model).direct(tops - np.array([107, -16, 99]) * STEP).position
    np.testing.assert_allclose(at, [0, 0, 0.29686], atol=1e-9)
    assert model.mechanism.scale == (1e5, 1e5, 1e5)


def test_the_last_command_counts_and_before_it_the_report(tmp_path):
    more = "M206 T3 P881 X218.5\nM206 T1 P893 S7\nM206 X1\n"
    stated = repetier.settings([written(tmp_path, REPORT + more)])
    delta = repetier.towers(stated)
    assert delta.rods[0] == pytest.approx(0.2185)
    assert np.ptp(delta.heights[:2]) == pytest.approx(23 * STEP)


def test_configuration_h_counts_where_the_eeprom_states_nothing(tmp_path):
    """Its radius is 175.5 - 33 - 18, its steps 16 * 200 / (2 * 20)."""
    header = written(tmp_path, HEADER, "Configuration.h")
    alone = repetier.towers(repetier.settings([header]))
    np.testing.assert_allclose(np.hypot(*alone.towers.T), 0.1245, atol=1e-5)
    assert alone.scale == pytest.approx([80e3] * 3)
    np.testing.assert_allclose(alone.heights - 0.3, [40 / 80e3, 0, 0], atol=1e-12)
    assert configured([header]).model.mechanism.scale == pytest.approx((80e3,) * 3)
    both = repetier.towers(repetier.settings([header, written(tmp_path)]))
    assert both.rods[0] == pytest.approx(0.217)


def test_a_carriage_moves_by_the_steps_of_a_turn(tmp_path):
    """3200 steps a turn are 40 mm by 80 steps per mm, and 32 mm by the 100 of the EEPROM."""
    header = written(tmp_path, HEADER, "Configuration.h")
    assert configured([header]).model.mechanism.drives == (Drive("belt", per_rev=0.04),) * 3
    drives = configured([header, written(tmp_path)]).model.mechanism.drives
    assert drives == (Drive("belt", per_rev=0.032),) * 3
    assert configured([written(tmp_path)]).model.mechanism.drives == ()


def test_what_was_written_is_what_the_firmware_rounds_to(tmp_path):
    """An export of what was read, and a second one into its own file, change nothing."""
    model = configured([written(tmp_path)]).model
    done = export(model, "repetier", tmp_path / "out")
    assert done.loss["position_max"] < 1e-9
    text = done.paths[0].read_text()
    assert "M206 T3 P881 X217.0050\n" in text  # half a step, which is cut off
    assert "M206 T1 P893 S123\n" in text  # 107 + 16: the lowest end-stop has 0
    assert "M206 T1 P895 S0\n" in text
    assert export_into(model, "repetier", done.paths).before["position_max"] < 1e-9
    assert done.paths[0].read_text() == text


def test_changed_towers_go_into_the_commands_and_leave_less_than_a_step(tmp_path):
    model = configured([written(tmp_path)]).model
    paths = export(model, "repetier", tmp_path / "out").paths
    changes = {"chain1.Lb": 0.2e-3, "chain2.D_x": -0.3e-3, "chain3.D_y": 0.4e-3, "chain1.D_z": 1e-3}
    values = model.values.copy()
    for name, by in changes.items():
        values[model.table.index_of(name)] += by
    done = export_into(model.with_values(values), "repetier", paths)
    assert done.before["position_max"] > 0.1e-3
    assert done.loss["position_max"] < 2 * STEP
    assert "M206 T3 P11 X100.0000\n" in paths[0].read_text()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            REPORT.replace("881 217.000", "881 2l7"),
            r"log:4: M206 T3 P881 X is '2l7', expected the d",
        ),
        (REPORT.replace("881 217.000", "881 90.0"), r"is '90.0', expected the diagonal rod length"),
        (
            REPORT.replace("EPR:3 11 ", "EPR:3 12 "),
            r"no M206 T3 P11 X, expected steps per mm \(EPR:",
        ),
        (REPORT.replace("EPR:3 153 ", "EPR:3 15 "), r"no M206 T3 P153 X, expected Z max length in"),
        (
            REPORT.replace("329.550", "30.0"),
            r"P905 X is '30.0', expected degrees, within 30 of the",
        ),
        (
            REPORT.replace("Diagonal rod length", "Jerk"),
            r"EPR:3 881 is '217.000 Jerk \[mm\]', expe",
        ),
    ],
)
def test_a_broken_report_is_named_with_line_and_position(text, message, tmp_path):
    with pytest.raises(ParallelCalError, match=message):
        configured([written(tmp_path, text)])


def test_a_header_of_another_drive_system_is_named(tmp_path):
    header = written(tmp_path, HEADER.replace("SYSTEM 3", "SYSTEM 0"), "Configuration.h")
    with pytest.raises(ParallelCalError, match=r"h:1: DRIVE_SYSTEM is '0', expected 3 \(DELTA\)"):
        configured([header])


def test_an_export_that_cannot_be_made_says_why(tmp_path):
    model = configured([written(tmp_path)]).model
    with pytest.raises(ParallelCalError, match=r"expected M206 T... P...: the numbers of Repetier"):
        export_into(model, "repetier", [tmp_path / "printer.log"])
    with pytest.raises(ParallelCalError, match=r"neither a file nor the model states the steps"):
        export(new_model("linear_delta"), "repetier", tmp_path)
    uneven = new_model(load_mechanism("linear_delta", scale=[1e5, 1e5, 8e4]))
    with pytest.raises(ParallelCalError, match=r"100, 100, 80 steps per mm, but this firmware has"):
        export(uneven, "repetier", tmp_path)
