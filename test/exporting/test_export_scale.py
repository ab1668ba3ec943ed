"""The gain of a belt in a firmware's steps per mm, by firmwares with nothing of the package.

A firmware counts steps from its end-stops. Without another error, the nozzle is where its new
numbers believe it if the carriages are at q + gain q (CONVENTIONS.md), where q is what the same
steps read in the recording.
"""

import re

import numpy as np
import pytest
import virtual_firmware as vf

from parallel_cal.base.errors import ModelError
from parallel_cal.exporting.export import export, export_into
from parallel_cal.importing.controller_files import configured

GAINS = np.array([-0.001, 0.002, 0.0005])
STOPS = 300 + np.sqrt(250**2 - 100**2)  # mm, of the carriages in all files here
RODS, RADIUS, ANGLES = np.full(3, 250.0), 100.0, np.radians([210, 330, 90])
KLIPPER = "[printer]\nkinematics: delta\ndelta_radius: 100\n" + "".join(
    f"[stepper_{tower}]\nposition_endstop: 300\narm_length: 250\nangle: {angle}\n"
    f"rotation_distance: 40  # belt\nmicrosteps: 16\n{gear}"
    for tower, angle, gear in zip(
        "abc", (210, 330, 90), ("", "gear_ratio: 3:1, 2:1\n", ""), strict=True
    )
)
RRF = (
    "M350 X16 Y16 Z16\nM92 X80 Y80 Z80 E420 ; steps\n"
    "M665 R100 L250 H300 B85 X0 Y0 Z0\nM666 X0 Y0 Z0 A0 B0\n"
)
GCODE = "M92 X80.00 Y80.00 Z80.00 E93.00\nM665 L250 R100 H300\nM666 X0 Y0 Z0\n"
HEADER = (
    "#define DELTA_RADIUS 100.0\n#define DELTA_DIAGONAL_ROD 250.0\n#define DELTA_HEIGHT 300.0\n"
    "#define DELTA_ENDSTOP_ADJ { 0.0, 0.0, 0.0 }\n"
    "#define DELTA_TOWER_ANGLE_TRIM { 0.0, 0.0, 0.0 }\n"
    "#define DEFAULT_AXIS_STEPS_PER_UNIT   { 80, 80, 80, 500 } // steps\n"
)
FILES = {
    "klipper": ("printer.cfg", KLIPPER),
    "rrf": ("config.g", RRF),
    "marlin": ("printer.gcode", GCODE),
    "marlin_equal_rods": ("Configuration.h", HEADER),
}


def stated(folder, name):
    """The firmware's file with this name, and the printer as it is configured there."""
    file, text = FILES[name]
    path = folder / file
    path.write_text(text)
    return path, configured([path]).model


def with_gains(model):
    model = model.with_effect("encoder_gain", {})
    names = [f"encoder_gain.{joint}.gain" for joint in model.joints]
    values = model.values.copy()
    values[[model.table.index_of(name) for name in names]] = GAINS
    return model.with_values(values)


def read(name, text):
    """The firmware, and its mm per step or turn, as its file states them."""
    if name == "klipper":
        firmware = vf.Klipper(text)
        return firmware, firmware.each("rotation_distance")
    if name == "rrf":
        firmware = vf.Duet(text)
        return firmware, 1 / firmware.xyz("M92")
    steps = re.search(r"M92 X(\S+) Y(\S+) Z(\S+)|PER_UNIT\s+{ (.*?), (.*?), (.*?), 500 }", text)
    if text.startswith("#"):
        numbers = dict(re.findall(r"#define (DELTA\w+) (.*)", text))
        trim, adjust = (
            numbers[f"DELTA_{key}"].strip("{} ").split(", ")
            for key in ("TOWER_ANGLE_TRIM", "ENDSTOP_ADJ")
        )
        text = "M665 L{DELTA_DIAGONAL_ROD} R{DELTA_RADIUS} H{DELTA_HEIGHT} ".format(**numbers)
        text += "X{} Y{} Z{}\n".format(*trim) + "M666 X{} Y{} Z{}\n".format(*adjust)
    return vf.Marlin(text), 1 / np.array([float(s) for s in steps.groups() if s])


def true_positions(turns, per_turn):
    """Where (N, 3) mm the nozzle is after turns (N, 3) down from the end-stops."""
    q = STOPS - turns * per_turn
    xy = RADIUS * np.column_stack([np.cos(ANGLES), np.sin(ANGLES)])
    carriages = np.stack(np.broadcast_arrays(*xy.T[:, None], q + GAINS * q), axis=2)
    return vf.nozzle_between(carriages, RODS)


def points():
    rng = np.random.default_rng(5)
    return np.column_stack([rng.uniform(-50, 50, (60, 2)), rng.uniform(0, 100, 60)])


@pytest.mark.parametrize("name", FILES)
def test_belts_with_another_pitch_go_where_they_are_sent(name, tmp_path):
    path, model = stated(tmp_path, name)
    before, old = read(name, path.read_text())
    P = points()
    turns = (before.homed() - before.motors(P)) / old
    assert np.abs(true_positions(turns, old) - P).max() > 0.1
    done = export_into(with_gains(model), name, [path])
    after, new = read(name, path.read_text())
    np.testing.assert_allclose(new, old * (1 + GAINS), rtol=1e-6)
    turns = (after.homed() - after.motors(P)) / new
    np.testing.assert_allclose(true_positions(turns, old), P, rtol=0, atol=2e-3)
    assert done.loss["position_max"] < 2e-6
    assert not any("encoder_gain" in remark for remark in done.remarks)
    text = path.read_text()
    export_into(with_gains(model), name, [path])
    assert path.read_text() == text


@pytest.mark.parametrize("name", FILES)
def test_a_model_without_gains_writes_the_steps_of_its_recording(name, tmp_path):
    path, model = stated(tmp_path, name)
    text = path.read_text()
    export_into(model, name, [path])
    assert path.read_text().count("80") == text.count("80")
    np.testing.assert_array_equal(read(name, path.read_text())[1], read(name, text)[1])
    export_into(with_gains(model), name, [path])
    export_into(model, name, [path])  # the recording was made with the first steps
    np.testing.assert_allclose(read(name, path.read_text())[1], read(name, text)[1], rtol=1e-9)


def remark_on(field, done):
    [remark] = [remark for remark in done.remarks if remark.startswith(f"{field} is not exported")]
    assert "the loss includes what its numbers cannot represent of encoder_gain" in done.remarks
    return remark


UNSTATED = {
    "klipper": ("printer.cfg", KLIPPER.replace("rotation_distance: 40  # belt\n", "", 1)),
    "rrf": ("config.g", RRF.replace("M92 X80 Y80 Z80 E420 ; steps\n", "")),
    "marlin": ("printer.gcode", GCODE.replace("M92 X80.00 Y80.00 Z80.00 E93.00\n", "")),
}
FORMULA = HEADER.replace("{ 80, 80, 80, 500 }", "{ STEPS, STEPS, STEPS, 500 }")
UNSTATED["marlin_equal_rods"] = ("Configuration.h", FORMULA)
FIELDS = dict.fromkeys(FILES, "M92") | {"klipper": "rotation_distance"}


@pytest.mark.wide
@pytest.mark.parametrize("name", FILES)
def test_steps_that_no_file_or_no_model_states_are_not_written(name, tmp_path):
    path, model = stated(tmp_path, name)
    gains = with_gains(model)
    said = remark_on(FIELDS[name], export(gains, name, tmp_path / "out"))
    assert "no file states its present values" in said
    file, text = UNSTATED[name]
    (tmp_path / file).write_text(text)
    unknown = with_gains(configured([tmp_path / file]).model)
    said = remark_on(FIELDS[name], export_into(gains, name, [tmp_path / file]))
    assert "no file states its present values" in said
    path.write_text(FILES[name][1])
    said = remark_on(FIELDS[name], export_into(unknown, name, [path]))
    assert "the model file does not state it" in said
    np.testing.assert_array_equal(read(name, path.read_text())[1], read(name, FILES[name][1])[1])


def test_one_variable_for_all_motors_is_left_alone(tmp_path):
    variable = "global steps = 80\nM92 X{global.steps} Y{global.steps} Z{global.steps}\n"
    path, model = stated(tmp_path, "rrf")
    path.write_text(variable + RRF.partition("steps\n")[2])
    remark_on("M92", export_into(with_gains(model), "rrf", [path]))
    assert path.read_text().startswith(variable)


def test_another_microstepping_is_refused(tmp_path):
    path, model = stated(tmp_path, "rrf")
    path.write_text(RRF.replace("X80 Y80 Z80", "X160 Y160 Z160"))
    message = r"motor 1 has 160 steps or turns per mm in the file, but 80 in the model file"
    with pytest.raises(ModelError, match=message):
        export_into(model, "rrf", [path])


@pytest.mark.parametrize("scale", [[80e3, 80e3], [80e3, 0.0, 80e3], "fast"])
def test_a_scale_that_is_no_scale_is_refused(scale):
    from parallel_cal.model.shelf import load_mechanism

    with pytest.raises(ModelError, match="scale"):
        load_mechanism("linear_delta", scale=scale)
