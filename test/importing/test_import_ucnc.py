"""Settings of uCNC's linear Delta become a model, which is written back; or one clear line."""

import numpy as np
import pytest

from parallel_cal.base.errors import ParallelCalError
from parallel_cal.exporting.export import export, export_into
from parallel_cal.importing.controller_files import configured
from parallel_cal.importing.importers import ucnc
from parallel_cal.kinematics.kinematics import Kinematics

SETTINGS = """\
$22=1
$23=4
$100=80.000
$101=80.000
$102=80.000
$106=250.000
$107=125.000
$132=300.000
"""
# Points in mm, and the steps of the motors by kinematics_apply_inverse (140831c7), compiled and
# run: they count from the nozzle at the origin.
BY_UCNC = (
    ((0, 0, 0), (0, 0, 0)),
    ((30, -40, 10), (613, -2014, 2134)),
    ((-50, 20, 200), (13784, 17829, 14473)),
)


def written(folder, text=SETTINGS, name="settings.txt"):
    (folder / name).write_text(text)
    return folder / name


def test_the_robot_moves_as_the_firmware_computes(tmp_path):
    model = configured([written(tmp_path)]).model
    r, steps = (np.array([row[k] for row in BY_UCNC]) for k in (0, 1))
    q = Kinematics(model).inverse(r * 1e-3).joints
    np.testing.assert_allclose((q - q[0]) * 80e3, steps, atol=0.5)
    assert model.mechanism.scale == (80e3,) * 3
    assert model.machine_class == "hobby"


def test_homed_the_nozzle_is_at_the_height_that_the_settings_state(tmp_path):
    """sqrt(250^2 - 125^2) = 216.506 mm below the carriages; at 0 if $23 does not invert Z."""
    for text, height in ((SETTINGS, 0.3), (SETTINGS.replace("$23=4", "$23=3"), 0.0)):
        delta = ucnc.towers(ucnc.settings([written(tmp_path, text)]))
        np.testing.assert_allclose(delta.end_stops, height + 0.216506351, atol=1e-9)


def test_changed_sizes_go_into_the_settings_and_nothing_else_changes(tmp_path):
    path = written(tmp_path)
    model = configured([path]).model
    export_into(model, "ucnc", [path])
    assert path.read_text() == SETTINGS
    values = model.values.copy()
    for i in (1, 2, 3):
        values[model.table.index_of(f"chain{i}.Lb")] += 1e-3
        values[model.table.index_of(f"chain{i}.D_x")] -= 0.5e-3
    done = export_into(model.with_values(values), "ucnc", [path])
    assert done.loss["position_max"] < 2e-6  # um: three digits of mm
    assert "$106=251.000\n$107=124.500\n" in path.read_text()
    kept = [line for line in SETTINGS.splitlines() if line[:4] not in ("$106", "$107", "$132")]
    assert kept == [line for line in path.read_text().splitlines() if line in kept]


def test_towers_that_ucnc_cannot_place_apart_are_reported_as_loss(tmp_path):
    """One tower 1 mm further out."""
    path = written(tmp_path)
    model = configured([path]).model
    values = model.values.copy()
    values[model.table.index_of("chain1.D_x")] += 1e-3
    done = export(model.with_values(values), "ucnc", tmp_path / "out")
    assert 0.05e-3 < done.loss["position_max"] < 1e-3
    assert any("$23 inverts the direction of Z" in remark for remark in done.remarks)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("$106=250.000", "$106=25O", r"settings.txt:6: \$106 is '25O', expected the rods' length"),
        ("$106=250.000", "$106=100", r"\$106 is '100', expected the rods' length in mm, more than"),
        ("$107=125.000\n", "", r"no \$107, expected the radius of the towers in mm"),
        ("$132=300.000\n", "", r"no \$132, expected the height of the nozzle"),
        (
            "$132=300.000\n",
            "$108=40\n",
            r"\$108 is '40', expected no such setting: .* rotary Delta",
        ),
    ],
)
def test_a_broken_list_is_named_with_line_and_setting(old, new, message, tmp_path):
    with pytest.raises(ParallelCalError, match=message):
        configured([written(tmp_path, SETTINGS.replace(old, new))])
