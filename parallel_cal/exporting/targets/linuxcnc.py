"""LinuxCNC: a kinematics component of any model, and numbers for its own kinematics.

Its own kinematics are genhexkins for hexapods, pentakins for pentapods, tripodkins for tripods of
three struts, and lineardeltakins and rotarydeltakins for Deltas with equal chains. The numbers are
pins in a .hal file and HOME_OFFSET in the .ini file, in mm and degrees. Source: LinuxCNC
documentation, kins(9), lineardeltakins(9), "INI configuration" ([JOINT_n] HOME_OFFSET is the
position of the joint at its switch, SCALE its counts or steps per machine unit), and
src/emc/kinematics.

The component and the built-in kinematics go to separate folders: the component contains the zero
corrections of the joints, and the HOME_OFFSET for the built-in kinematics contains them, too.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from importlib.resources import files as resources
from pathlib import Path

import numpy as np

from parallel_cal.base.errors import ModelError
from parallel_cal.base.units import DEGREE, MM
from parallel_cal.exporting.deltas import LINEAR, ROTARY, fit_equal_shoulders, fit_equal_towers
from parallel_cal.exporting.projection import (
    Firmware,
    Frame,
    Machine,
    Projection,
    Refinement,
    fit_numbers,
)
from parallel_cal.exporting.targets import c
from parallel_cal.importing.deltas import HANGING_ANGLES, Towers
from parallel_cal.importing.importers import linuxcnc
from parallel_cal.importing.importers.linuxcnc import (
    HEXAPOD,
    HOMED,
    PENTAPOD,
    ROTARY_PINS,
    TRIPOD_PINS,
)
from parallel_cal.importing.settings import Settings
from parallel_cal.importing.struts import Hexapod, Pentapod, Struts, Tripod
from parallel_cal.model.model import Model
from parallel_cal.model.region import IdentifiedRegion

STRUTS = {  # the numbers of a leg, by mechanism
    "stewart42": ("C_x", "C_y", "C_z", "B_x", "B_y", "B_z"),
    "pentapod": ("C_x", "C_y", "C_z", "B_r", "B_z"),
    "tripod_struts": ("C_x", "C_y", "C_z"),
}
HOLDS = (*STRUTS, *LINEAR, *ROTARY)
CLEARED = tuple(f"lineardeltakins.J{i}off" for i in range(3))  # the offsets of older versions
COMPONENT = "component"  # folder of the component
HAL, INI = "machine.hal", "machine.ini"
INCH_DECIMALS = 7  # as fine as the digits of mm
SCALE_DIGITS = 10  # 0.1 um in 100 m
MARGIN = MM  # by which samples may be outside the workspace without a remark
LEAD = f"{HEXAPOD}.screw-lead"
HEXAPOD_LEGS = 6  # of genhexkins
PLATE = "probe.plate.z"
SWITCHES = (
    "HOME_OFFSET assumes switches at the joints' upper limits in the model "
    "file: if yours are elsewhere, change these limits"
)
STATED_SWITCHES = (
    "HOME_OFFSET is for switches at the readings {} {} (option switches of the model file)"
)
NO_SCALE = (
    "SCALE is not exported, because the model file does not state it: state the SCALE of the "
    "recording (option scale of stewart42, in counts per m), and errors that grow with the length "
    "of a strut become smaller. new --from HAL --from INI states it"
)
WIDTHS = (
    "set BACKLASH in your .ini file, in mm: {}. The stated error of the kinematics does not "
    "include backlash"
)
NO_WIDTHS = (
    "leave BACKLASH at 0 in your .ini file: the model's widths of backlash are not significant. "
    "The stated error of the kinematics does not include backlash"
)
INSIGNIFICANT_WIDTH = " (0: less than {:g} sigma, or negative)"
MIN_WIDTH_SIGMAS = 2.0  # a smaller width of backlash is proposed as 0
HEAD = """\
# For {} only. Do not use these values together with the exported component.
# The component contains the zero corrections of the joints, HOME_OFFSET here does, too.
# Lengths are in mm{}.
"""
TOWER_ANGLES = np.radians([90.0, 210.0, 330.0])


def files(model: Model, name: str = "") -> dict[str, str]:
    """Return the exported C, and a component `name`_kins around it."""
    made = c.files(model, name)
    robot = next(file for file in made if file.endswith(".h")).removesuffix(".h")
    if len(model.joints) > 9:
        raise ModelError(
            f"{model.mechanism.name} has {len(model.joints)} joints, but LinuxCNC supports 9"
        )
    m, tool = model.mechanism, resources(__package__).joinpath("_c", "kins.c")
    factors = [MM if unit == "m" else DEGREE for unit in m.joint_units]
    recorded = ""  # lines of a comment, if the recording states them
    for words, key, unit in (
        ("HOME_OFFSET, in mm", "switches", 1 / MM),
        ("SCALE, per mm", "scale", MM),
    ):
        if values := getattr(m, key, None):
            recorded += f" * {words}: {', '.join(f'{v * unit:.10g}' for v in values)}.\n"
    text = c.fill_template(
        tool.read_text(encoding="utf-8"),
        {
            "robot": robot,
            "ROBOT": robot.upper(),
            "factors": ", ".join(map(repr, factors)),
            "recorded": recorded,
            "turns": str(int(any(i >= 3 for i in m.controlled))),
        },
    )
    return {
        f"{COMPONENT}/{robot}.h": made[f"{robot}.h"],
        f"{COMPONENT}/{robot}.c": made[f"{robot}.c"],
        f"{COMPONENT}/{robot}_kins.c": text,
    }


def settings(paths: Sequence[Path]) -> Settings:
    return linuxcnc.settings(paths)


def firmware(stated: Settings) -> Firmware:
    """Return the kinematics whose pins are set."""
    if stated.number(LEAD, "a length", 0.0):
        raise stated.error(
            LEAD,
            "0: the export does not compute with this correction, so its parameters would be wrong "
            "with it. Set it to 0, or use the component, which contains the effect strut_rotation",
        )
    return linuxcnc.kinematics(stated)


def complete(read: Firmware, model: Model) -> Firmware:
    """Return kinematics that were read from files, with positions in the counts of a model.

    A model that does not state SCALE compares lengths. Carriages count from the bed.
    """
    if isinstance(read, Towers):
        return replace(read, end_stops=read.end_stops - _bed_height(model))
    if not isinstance(read, Struts):
        return read
    scale = getattr(model.mechanism, "scale", None)
    if scale is None:
        return replace(read, scale=None)
    if read.scale is None:
        raise ModelError(
            f"the model file states the scale of its legs, but the .ini file has no "
            f"{linuxcnc.SCALE.format(0)} to {len(read.base) - 1}: state it as it was in the "
            "recording"
        )
    if (np.sign(scale) != np.sign(read.scale)).any():
        raise ModelError(
            "SCALE in the .ini file and the scale in the model file have different signs: state "
            "in the model file (option scale) the SCALE of the recording"
        )
    return read


def adapt(stated: Settings, numbers: Mapping[str, str]) -> dict[str, str]:
    """Return settings in mm in the unit of the machine's own files."""
    factor = MM / linuxcnc.length_unit(stated)
    if factor == 1.0:
        return dict(numbers)
    angular = any(field.startswith(linuxcnc.ROTARY) for field in stated.texts)

    def convert(field: str, text: str) -> str:
        if field.endswith(" SCALE"):
            return _format_scale(float(text) / factor)
        if angular and field.endswith("HOME_OFFSET"):
            return text
        return f"{float(text) * factor:.{INCH_DECIMALS}f}"

    return {field: convert(field, text) for field, text in numbers.items()}


def _bed_height(model: Model) -> float:
    """Return the height (m) of the bed of a linear Delta in LinuxCNC's frame.

    A bed near z = 0 is made z = 0. Another bed stays where the model has it.
    """
    if PLATE not in model.table.names or not model.table.nominal[model.table.index_of(PLATE)]:
        return 0.0
    return float(model.value(PLATE))


def _format_scale(scale: float) -> str:
    return f"{scale:.{SCALE_DIGITS}g}"


def project(model: Model, present: Refinement | None = None) -> Projection:
    name, scale, remarks = model.mechanism.name, None, [_describe_switches(model)]
    expressed: tuple[str, ...] = ()
    if name in LINEAR:
        tall, found = fit_equal_towers(model, TOWER_ANGLES, present)
        pins = {"lineardeltakins.R": tall.radius[0], "lineardeltakins.L": tall.rods[0]}
        homed = (tall.homed + _bed_height(model)) / MM
    elif name in ROTARY:
        turned, found = fit_equal_shoulders(model, HANGING_ANGLES, one_stop=False, present=present)
        sizes = (turned.radius, turned.arms[0], turned.rods[0], 0.0)
        pins = {f"rotarydeltakins.{p}": size for p, size in zip(ROTARY_PINS, sizes, strict=True)}
        homed = -turned.homed / DEGREE
    else:
        struts, found = _struts(model)
        pins = _strut_pins(struts)
        homed, scale, remarks = struts.switches / MM, struts.scale, _remarks(model)
        expressed = ("backlash",)  # by BACKLASH, which a remark proposes
    written = {field: f"{float(size) / MM + 0.0:.5f}" for field, size in pins.items()}
    offsets = {HOMED.format(i): f"{value:.6f}" for i, value in enumerate(homed)}
    if scale is not None:  # per mm
        offsets |= {linuxcnc.SCALE.format(i): _format_scale(s * MM) for i, s in enumerate(scale)}
    kinematics = next(iter(written)).split(".")[0]
    settings = {f"{kinematics}/{HAL}": written, f"{kinematics}/{INI}": offsets}
    units = " and SCALE is per mm" if scale is not None else ""
    head = HEAD.format(kinematics, units)
    return Projection(settings, found.frame, found.stops, tuple(remarks), head, expressed)


def _remarks(model: Model) -> list[str]:
    """Say what the numbers of a hexapod assume, and what the user must set."""
    m, remarks = model.mechanism, [_describe_switches(model)]
    if getattr(m, "scale", None) is None and model.effects:
        remarks.append(NO_SCALE)
    remarks.extend(filter(None, [_describe_unfitted_region(model)]))
    remarks.extend(filter(None, [_describe_backlash(model)]))
    return remarks


def _describe_switches(model: Model) -> str:
    """Say for which places of the switches HOME_OFFSET is."""
    m = model.mechanism
    switches = getattr(m, "switches", None)
    if not switches:
        return SWITCHES
    unit, factor = ("mm", MM) if m.joint_units[0] == "m" else ("degrees", DEGREE)
    return STATED_SWITCHES.format(" ".join(f"{q / factor:.3f}" for q in switches), unit)


def _describe_backlash(model: Model) -> str:
    """Propose BACKLASH for the legs; 0 for a width that is negative or not significant."""
    names = [f"backlash.{leg}.width" for leg in model.joints]
    if not {*names} <= {*model.table.names}:
        return ""
    which = [model.table.index_of(name) for name in names]
    widths, sigmas = model.values[which], np.zeros(len(which))
    if model.covariance is not None:  # the sigma of a fixed width is 0
        sigmas = np.sqrt(np.diag(model.covariance)[which])
    significant = (widths > 0) & (widths >= MIN_WIDTH_SIGMAS * sigmas)
    if not significant.any():
        return NO_WIDTHS
    proposed = np.where(significant, widths, 0.0) / MM
    text = ", ".join(f"JOINT_{i} {width:.4f}" for i, width in enumerate(proposed))
    return WIDTHS.format(
        text + ("" if significant.all() else INSIGNIFICANT_WIDTH.format(MIN_WIDTH_SIGMAS))
    )


def _describe_unfitted_region(model: Model) -> str:
    """Say where the samples of the model's fit are outside its workspace; empty if nowhere."""
    region, box = IdentifiedRegion.of_model(model), model.mechanism.workspace
    beyond = [
        f"{axis} {low / MM:.0f}..{high / MM:.0f} (workspace {box.low[i] / MM:.0f}.."
        f"{box.high[i] / MM:.0f})"
        for i, axis in enumerate("xyz")
        if region and axis in region.position
        for low, high in [region.position[axis]]
        if low < box.low[i] - MARGIN or high > box.high[i] + MARGIN
    ]
    if not beyond:
        return ""
    return (
        "the numbers are fitted, and their error is stated, over the workspace of the model file, "
        f"but the model was measured at {', '.join(beyond)} mm: the error may be larger there. If "
        "the robot works there, enlarge workspace in the model file and export again"
    )


def _struts(model: Model) -> tuple[Struts, Machine]:
    """Fit the ends of the struts, the lengths at the switches, and SCALE if the model states it.

    SCALE expresses errors that grow with the length of a strut, such as a wrong pitch. A model
    without effects has none, and keeps its SCALE.
    """
    m, n = model.mechanism, len(model.joints)
    if m.name == "stewart42" and n != HEXAPOD_LEGS:
        raise ModelError(
            f"{HEXAPOD} has {HEXAPOD_LEGS} struts, this robot {n}: leave out the "
            "settings, and export writes a component of its own"
        )
    ends = np.array([[model.value(f"{leg}.{name}") for name in STRUTS[m.name]] for leg in m.joints])
    stops = np.array(getattr(m, "switches", None) or [high for _, high in m.joint_limits], float)
    scale = getattr(m, "scale", None)
    counts = np.ones(n) if scale is None else np.array(scale)
    lengths = stops + [model.value(f"{leg}.L0") for leg in m.joints]

    def machine(v: np.ndarray) -> Machine:
        points, at_switches, parts = np.split(v, [ends.size, ends.size + n])
        written = None if scale is None else counts * (parts if len(parts) else 1.0)
        robot, frame = _strut_robot(model, points.reshape(ends.shape), at_switches, written)
        return Machine(robot, replace(frame, signs=1 / counts), stops)

    fitted = np.ones(n if scale is not None and model.effects else 0)
    found = machine(fit_numbers(model, np.array([*ends.ravel(), *lengths, *fitted]), machine))
    return found.firmware, found  # type: ignore[return-value]


def _strut_robot(
    model: Model, ends: np.ndarray, lengths: np.ndarray, scale: np.ndarray | None
) -> tuple[Struts, Frame]:
    """Return LinuxCNC's robot with the ends (n, k) of the struts in {B}, and its frame."""
    n, C = len(ends), ends[:, :3]
    here = Frame(tuple(range(n)), np.ones(n))
    if model.mechanism.name == "stewart42":
        return Hexapod(C, lengths, scale, ends[:, 3:]), here
    if model.mechanism.name == "pentapod":
        return Pentapod(C, lengths, scale, ends[:, 3], ends[:, 4]), here
    # The first base point is the origin, the second one on x, and the tool above all three.
    x = (C[1] - C[0]) / np.linalg.norm(C[1] - C[0])
    up = np.cross(x, C[2] - C[0])
    up *= np.sign(up @ (model.mechanism.home.position - C[0])) / np.linalg.norm(up)
    axes = np.column_stack([x, np.cross(up, x), up])
    return Tripod((C - C[0]) @ axes, lengths, scale), replace(
        here, origin=C[0], axes=axes, turn=axes
    )


def _strut_pins(struts: Struts) -> dict[str, float]:
    """Return the lengths (m) that the pins of a robot with struts state."""
    if isinstance(struts, Tripod):
        return {pin: float(struts.base[at]) for at, pin in TRIPOD_PINS.items()}
    groups = [("base", "xyz", struts.base)]
    if isinstance(struts, Hexapod):
        name = HEXAPOD
        groups.append(("platform", "xyz", struts.platform))
    else:
        assert isinstance(struts, Pentapod)
        name = PENTAPOD
        groups.append(("effector", "rz", np.column_stack([struts.radii, struts.heights])))
    return {
        f"{name}.{kind}.{k}.{axis}": float(points[k, i])
        for kind, axes, points in groups
        for k in range(len(points))
        for i, axis in enumerate(axes)
    }
