"""A Delta that was homed stands at the edge of its range: where its firmware believes the nozzle,
and what the model says of it."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
import test_export_heights
import test_import_fluidnc
import test_import_smoothieware
import virtual_firmware as vf
import virtual_printer as vp

from parallel_cal.importing.controller_files import configured
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.kinematics.solutions import Status

MM = 1e-3


@dataclass(frozen=True)
class Homed:
    """A configuration whose end-stops differ, if it may state that, and its firmware."""

    file: str
    text: str
    firmware: Any


KLIPPER = "[printer]\nkinematics: delta\ndelta_radius: 150\n" + "".join(
    f"[stepper_{name}]\nrotation_distance: 40\nmicrosteps: 16\narm_length: 250\n"
    f"position_endstop: {height}\nangle: {angle}\n"
    for name, height, angle in (("a", 300, 210), ("b", 299.5, 331), ("c", 300.2, 90))
)
ROTARY = "[printer]\nkinematics: rotary_delta\nshoulder_radius: 50\nshoulder_height: 200\n"
ROTARY += "".join(
    f"[stepper_{name}]\ngear_ratio: 107:16, 60:16\nmicrosteps: 16\nposition_endstop: 50\n"
    f"upper_arm_length: 100\nlower_arm_length: 250\nangle: {angle}\n"
    for name, angle in (("a", 30), ("b", 150), ("c", 270))
)
ARMS = "$641=250\n$642=100\n$643=200\n$644=20\n$646=-30\n"
RRF = vp.CONFIG.replace("M666 X0 Y0 Z0", "M666 X-0.4 Y0.7 Z0")
MARLIN = test_export_heights.MARLIN.replace("M666 X0 Y0", "M666 X-0.4 Y-0.9")
PRINTERS = {
    "klipper": Homed("printer.cfg", KLIPPER, vf.Klipper),
    "klipper, rotary": Homed("printer.cfg", ROTARY, vf.Klipper),
    "rrf": Homed("config.g", RRF, vf.Duet),
    "marlin": Homed("printer.gcode", MARLIN, vf.Marlin),
    "smoothieware": Homed("config", test_import_smoothieware.LINEAR, vf.Smoothie),
    "grblhal": Homed("settings.txt", ARMS, vf.GrblHal),
    "fluidnc": Homed("config.yaml", test_import_fluidnc.DELTA, None),
}


def made(printer, folder):
    (folder / printer.file).write_text(printer.text)
    found = configured([folder / printer.file])
    return found.model, np.asarray(found.formula.homed)[None]


@pytest.mark.parametrize("name", PRINTERS)
def test_the_place_where_a_delta_is_homed_is_inside_its_limits(name, tmp_path):
    """Rounding put it outside, and a micrometre or a microradian further it is."""
    model, homed = made(PRINTERS[name], tmp_path)
    kinematics = Kinematics(model)
    there = kinematics.direct(homed)
    assert there.status == [Status.CONVERGED]
    back = kinematics.inverse(there.position, there.rotation)
    assert back.status == [Status.CONVERGED]
    np.testing.assert_allclose(back.joints, homed, atol=1e-9)
    above = kinematics.direct(homed + 1e-6)
    assert kinematics.inverse(above.position, above.rotation).status == [Status.OUTSIDE_LIMITS]


BESIDE = ("klipper", "rrf", "smoothieware")  # end-stops that differ move the nozzle to the side


@pytest.mark.parametrize("name", ["klipper", "klipper, rotary", "rrf", "smoothieware", "grblhal"])
def test_the_model_is_homed_where_the_firmware_believes_its_nozzle(name, tmp_path):
    model, homed = made(PRINTERS[name], tmp_path)
    believed = PRINTERS[name].firmware(PRINTERS[name].text).home_position() * MM
    np.testing.assert_allclose(Kinematics(model).direct(homed).position, [believed], atol=1e-8)
    aside = np.hypot(*believed[:2])
    assert (aside > 0.2 * MM) if name in BESIDE else (aside < 1e-8)


def test_marlin_takes_its_carriages_down_until_the_nozzle_is_in_the_middle(tmp_path):
    """By M666; the nozzle is then at X0 Y0, at the height of M665."""
    model, homed = made(PRINTERS["marlin"], tmp_path)
    down = np.array([[0.4, 0.9, 0.0]]) * MM
    found = Kinematics(model).direct(homed - down)
    np.testing.assert_allclose(found.position, [[0, 0, 0.3]], atol=1e-9)
    at_stops = Kinematics(model).direct(homed).position
    assert np.hypot(*at_stops[0, :2]) > 0.2 * MM
