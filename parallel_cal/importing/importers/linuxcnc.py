"""LinuxCNC: a probe log of a linear Delta, and the HAL file that configures lineardeltakins.

A log that (PROBEOPEN) opened contains X Y Z A B C U V W of each touch, one touch per line, in the
program's coordinates and units. So no offsets may be active while probing. Sources: LinuxCNC
documentation, "G-codes" (G38.x, Probe Logging), "Kinematics" and the manual page
lineardeltakins(9).
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from parallel_cal.base.errors import DatasetError
from parallel_cal.base.units import DEGREE, UNITS
from parallel_cal.importing import deltas, sections
from parallel_cal.importing.controller_files import ConfiguredRobot
from parallel_cal.importing.deltas import Towers
from parallel_cal.importing.settings import Settings, SourceLine, read_lines
from parallel_cal.importing.touch_samples import make_printed_ends, make_touch_samples
from parallel_cal.recordings.dataset import Dataset

CONFIGURATION = (".hal",)
AXES = "XYZABCUVW"
KINS = "lineardeltakins."
HOMED = "[JOINT_{}] HOME_OFFSET"  # in the .ini file: the joint at its switch
NO_PROBE = np.zeros(3)


def samples(
    paths: Sequence[Path],
    unit: str,
    step: float = 1e-6,
    printed_x: Sequence[float] = (),
    printed_y: Sequence[float] = (),
) -> Dataset:
    """Read the touches of logs, with a .hal file, both in `unit`; `step` (m) is a motor's step."""
    logs = [path for path in paths if path.suffix not in (*CONFIGURATION, ".ini")]
    if unit not in ("m", "mm", "in"):
        raise DatasetError(f"unit={unit}: expected mm, in or m, the unit of the program")
    delta = towers(settings([path for path in paths if path not in logs]), unit)
    nozzle, places = [], []
    for path in logs:
        for place, line in read_lines(path):
            if words := line.split():
                if len(words) != len(AXES):
                    raise place.error("the line", line.strip(), f"nine numbers: {' '.join(AXES)}")
                axes = [
                    place.number(axis, word, "a number", -1e6, 1e6)
                    for axis, word in zip(AXES, words, strict=True)
                ]
                nozzle.append(np.array(axes[:3]) * UNITS[unit])
                places.append(place)
    printed = make_printed_ends(delta, printed_x, printed_y)
    return make_touch_samples(delta, nozzle, places, paths, step, printed=printed)


def configured(paths: Sequence[Path]) -> ConfiguredRobot:
    """Return the machine that `setp lineardeltakins.R` and `.L` describe, in mm."""
    remark = "lengths in the HAL file are assumed to be in mm"
    return deltas.make_configured_robot(towers(settings(paths), "mm"), NO_PROBE, remarks=[remark])


def towers(stated: Settings, unit: str) -> Towers:
    """Return the Delta of lineardeltakins: R, L, J0off, J1off, J2off, and HOME_OFFSET in the .ini.

    Joint 0 stands along y.
    """
    size = UNITS[unit]
    radius = stated.number(f"{KINS}R", f"setp, the radius in {unit}", low=1e-3) * size
    expected = f"setp, the rods' length in {unit}, more than R"
    rods = np.full(3, stated.number(f"{KINS}L", expected, low=radius / size) * size)
    zero = [stated.number(f"{KINS}J{i}off", unit, 0.0) * size for i in range(3)]
    tops = [stated.number(HOMED.format(i), unit, 3 * rods[i] / size) for i in range(3)]
    return Towers(
        np.full(3, radius),
        rods,
        np.zeros(3),
        np.array(tops) * size,
        first=90 * DEGREE,
        zero=(zero[0], zero[1], zero[2]),
    )


def settings(paths: Sequence[Path]) -> Settings:
    """Read the values of pins in .hal files by name, and of .ini files by `[section] key`.

    A pin's value comes from `setp`, or from `sets` of the signal that `net` connects to it.
    """
    setups = [path for path in paths if path.suffix == ".ini"]
    texts = dict(sections.settings(setups).texts)
    signals: dict[str, tuple[str, SourceLine]] = {}
    nets: dict[str, str] = {}
    for path in paths:
        for place, line in () if path in setups else read_lines(path):
            if found := re.match(r"\s*(setp|sets)\s+([\w.-]+)\s*=?\s*([^\s#]*)", line):
                (texts if found[1] == "setp" else signals)[found[2]] = (found[3], place)
            elif found := re.match(r"\s*net\s+([\w.-]+)([^#]*)", line):
                nets |= dict.fromkeys(found[2].split(), found[1])
    connected = {pin: signals[name] for pin, name in nets.items() if name in signals}
    return Settings(connected | texts, paths)
