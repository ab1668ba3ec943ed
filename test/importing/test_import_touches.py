"""Tables of single touches, with the configuration of any Delta: joints by its own formula."""

import numpy as np
import pytest
import virtual_firmware as vf
from test_import_grblhal import DELIVERED
from test_import_klipper import LINEAR as DELTA
from test_import_klipper import ROTARY
from test_import_repetier import CARRIAGES, REPORT, STEP
from test_import_ur import UR3

from parallel_cal.base.errors import ParallelCalError
from parallel_cal.exporting import export as exporting
from parallel_cal.exporting.export import export_into
from parallel_cal.identification.fit import fit
from parallel_cal.importing.controller_files import configured, samples
from parallel_cal.importing.touch_samples import touches_in
from parallel_cal.model.shelf import load_sensor

MM = 1e-3
BED = -280.0  # mm, below the motors
STEPS_DELTA = np.array([40, 40, 20]) * MM / 200 / 16
STEPS_ROTARY = 2 * np.pi / (107 / 16 * 60 / 16) / np.array([400, 200, 200]) / 16


def written(folder, rows, config=DELIVERED, name="settings.txt", head="X,Y,Z"):
    (folder / name).write_text(config)
    lines = [head, *(",".join(f"{v:.6f}" for v in row) for row in rows)]
    (folder / "touches.csv").write_text("\n".join(lines) + "\n")
    return [folder / "touches.csv", folder / name]


def test_joints_are_those_of_the_firmware_that_moved_there(tmp_path):
    """Carriages as Repetier's own code, compiled and run, places them; it cuts off whole steps."""
    nozzles = np.array([each[0] for each in CARRIAGES[1:]]) * STEP / MM
    found = samples("touches", written(tmp_path, nozzles, REPORT, "printer.log"))
    away = found.q / STEP - np.array([each[1] for each in CARRIAGES[1:]])
    assert ((away >= 0) & (away < 1)).all()
    np.testing.assert_allclose(found.joint_sigma, STEP / 12**0.5)
    np.testing.assert_array_equal(found.conditions["reading.probe"], 0.0)


@pytest.mark.parametrize(("printer", "step"), [(DELTA, STEPS_DELTA), (ROTARY, STEPS_ROTARY)])
def test_joints_are_as_fine_as_a_microstep_of_klipper(tmp_path, printer, step):
    """Its scale counts turns, not steps: a turn of 40 mm was taken for a step."""
    table, config = written(tmp_path, [(0, 0, 0.1), (10, 5, 0.2)], printer, "printer.cfg")
    found = samples("touches", [table, config])
    np.testing.assert_allclose(found.joint_sigma, step / 12**0.5)
    np.testing.assert_allclose(samples("klipper", [config]).joint_sigma, found.joint_sigma)
    # Not whole, but enough where no distances in steps are stored.
    config.write_text(printer.replace("microsteps", "#microsteps").replace(" distance0", " weight"))
    assert samples("touches", [table, config]).joint_sigma is None


def test_arms_are_level_where_a_right_triangle_puts_the_effector(tmp_path):
    """51 tan(30) / 2 + 100 = 114.72 mm out, sqrt(300^2 - 114.72^2) = 277.20 mm below the motors."""
    [path, settings] = written(tmp_path, [(0, 0, -277.197)])
    found = samples("touches", [path, settings])
    np.testing.assert_allclose(found.q, np.zeros((1, 3)), atol=2e-5)
    assert "'probe: {height: -0.2772, sigma: null}'" in found.warnings[1]


def test_touches_at_one_place_are_replicates_however_far_their_heights_are_apart(tmp_path):
    rows = [(10, 20, -275), (30, 20, -275), (10, 20, -276)]
    found = samples("touches", written(tmp_path, rows))
    assert found.pose_id[0] == found.pose_id[2] != found.pose_id[1]


@pytest.mark.parametrize(("factor", "unit"), [(1, ""), (1 / 25.4, "inches"), (1e-3, "m")])
def test_touches_in_another_unit_than_the_machine_are_named(tmp_path, factor, unit):
    rows = [(40 * factor, 20 * factor, -275), (-30 * factor, 0, -275)]
    found = samples("touches", written(tmp_path, rows)).warnings
    assert [w for w in found if w.endswith(f"they fit if they are in {unit}, not mm")] == (
        [w for w in found if "x and y of the touches are" in w]
    )
    assert any("touches are" in w for w in found) == bool(unit)


BROKEN = {
    "no table": ({}, slice(1, 2), "expected tables (.csv) with the columns X, Y and Z"),
    "no configuration": ({}, slice(0, 1), "and the configuration that was active then"),
    "no columns": ({"head": "A,B,C"}, slice(0, 2), "no columns X, Y and Z; expected tables"),
    "an arm": (
        {"config": UR3, "name": "urcontrol.conf"},
        slice(0, 2),
        "urcontrol.conf: a serial: its touches cannot be imported: expected the configuration of",
    ),
}


@pytest.mark.parametrize("name", BROKEN)
def test_other_files_are_named_with_what_is_expected(tmp_path, name):
    changed, which, message = BROKEN[name]
    with pytest.raises(ParallelCalError) as error:
        samples("touches", written(tmp_path, [(0, 0, -270)], **changed)[which])
    assert message in str(error.value)


def test_a_height_far_from_all_others_is_named_with_its_line(tmp_path):
    with pytest.raises(ParallelCalError) as error:
        samples("touches", written(tmp_path, [(0, 0, -270), (5, 0, 0), (9, 0, -270)]))
    assert "csv:3: Z is '0 mm', expected the height of the bed there, within 20 mm of -270 mm" in (
        str(error.value)
    )


def test_a_firmware_whose_files_hold_no_touches_names_the_table(tmp_path):
    with pytest.raises(ParallelCalError, match="`import touches TABLE"):
        samples("repetier", written(tmp_path, [(0, 0, 0)], REPORT, "printer.log"))


@pytest.mark.wide
def test_a_bed_far_below_the_motors_becomes_flat_by_the_firmwares_own_formula(
    tmp_path, monkeypatch
):
    """grblHAL counts z from its motors, so that only differences of heights count."""
    monkeypatch.setattr(exporting, "MIN_FOLDED_TOUCHES", 1000)  # no folds: they take seconds
    true = DELIVERED.replace("300.000", "303.000").replace("100.000", "102.000")
    believed, real = vf.GrblHal(DELIVERED), vf.GrblHal(true.replace("75.000", "65.000"))
    line = np.linspace(-60, 60, 7)
    xy = np.array([(x, y) for x in line for y in line if np.hypot(x, y) < 65])
    z = np.full(len(xy), BED)
    for _ in range(30):  # lowered until the effector is on the bed
        z = z - (real.forward(believed.motors(np.column_stack([xy, z])))[:, 2] - BED)
    steps = believed.motors(np.column_stack([xy, z]))
    noise = 5e-3 * np.random.default_rng(0).standard_normal(len(z))
    files = written(tmp_path, np.column_stack([xy, z + noise]))
    model = configured(files[1:]).model
    model = model.with_sensors((load_sensor("probe", height=BED * MM, sigma=5e-6),))
    data = samples("touches", files)
    fitted = fit(model, data, hold_out=0).model
    done = export_into(fitted, "grblhal", files[1:], touches_in(data, model.joints), force=True)
    changed = vf.GrblHal(files[1].read_text()).forward(steps)[:, 2]
    assert done.heights.before > 0.1e-3
    assert done.heights.after < 8e-6
    assert np.std(z) > 0.1
    assert np.std(changed) < 8e-3


def test_the_history_of_a_model_names_its_controller_and_files(tmp_path):
    path = written(tmp_path, [], REPORT, "printer.log")[1]
    [origin] = configured([path]).model.history
    assert origin == {"step": "new", "controller": "repetier", "files": [str(path)]}
