"""Express Deltas in the numbers of firmwares: towers or shoulders, equal or different."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from parallel_cal.base.errors import ModelError
from parallel_cal.base.rotation import rotation_matrix
from parallel_cal.base.units import DEGREE, MM
from parallel_cal.exporting.projection import (
    Array,
    Bed,
    Firmware,
    Frame,
    Machine,
    Projection,
    Refinement,
    fit_numbers,
)
from parallel_cal.importing.deltas import Shoulders, Towers, are_counter_clockwise
from parallel_cal.model.model import Model

TOWERS = np.radians([210.0, 330.0, 90.0])  # about z, as in firmwares
LINEAR, ROTARY = ("linear_delta",), ("delta24", "delta54", "delta_nominal")
MAX_TOWER_TRIM = np.radians(15)  # a tower further from its place turns the whole frame
GAIN = "encoder_gain"  # the effect that a firmware's scale expresses
MAX_SCALE_CHANGE = 0.1  # relative; a larger one is another microstepping, gear or unit
MIN_SHOWN_SHIFT = 0.005  # mm or degrees, of an end-stop; less is 0.00
UPSIDE_DOWN = np.diag([1.0, -1.0, -1.0])


@dataclass(frozen=True)
class Chains:
    """A Delta's chains in a firmware's order and frame (m, rad); angles of arms count upwards."""

    frame: Frame
    stops: Array  # readings at the end-stops, in the model's order
    radius: Array
    angles: Array
    heights: Array
    rods: Array
    homed: Array
    arms: Array
    tilt: tuple[float, float]
    bed: Bed | None  # known if a probe touched it

    def machine(self, delta: Towers | Shoulders, origin: Array | None = None) -> Machine:
        """Return the firmware with these numbers; `origin` shifts its origin from the frame's."""
        moved = self.frame.origin + (0 if origin is None else origin)
        return Machine(delta, replace(self.frame, origin=moved), self.stops)


def chains_of(model: Model, places: Array | None) -> Chains:
    """Return the chains of a Delta for a firmware whose towers are near `places` (3,) in rad.

    Without `places`, the towers may be anywhere. The frame is then not turned about z, and the
    chains are in the model's order, or in the order 1, 3, 2 if only this is counter-clockwise seen
    from above in the firmware's frame.

    Height 0 is the plate of a sensor `probe`. Without a probe, it is the origin of {B}, or, if z of
    {B} points down, the far end of the workspace.
    """
    model = model.widen() if model.mechanism.name == "delta_nominal" else model
    m, linear = model.mechanism, model.mechanism.name in LINEAR
    if lean := float(m.options.get("inclination", 0.0)):
        said = (
            f"its rails are inclined by {np.degrees(lean):.3g} degrees, but a "
            "firmware's towers are vertical"
        )
        raise ModelError(f"{m.name}: {said}; the targets c and table can represent it")
    out, across, along, rods = (_read_three(model, n) for n in ("D_x", "D_y", "D_z", "Lb"))
    radius, up, offset, arms = out, across, along, np.zeros(3)
    if linear:
        radius, up = np.hypot(out, across), np.zeros(3)
    else:
        arm = _read_three(model, "La_x"), _read_three(model, "La_y")
        arms, offset = np.hypot(*arm), np.arctan2(arm[1], arm[0])
    angles, planned = _angles(model), _angles(model.with_values(model.table.nominal))
    down = not linear and m.home.position[2] > up.mean()
    height, tilt = _plate(model)
    bed = None if height is None else Bed(height, tilt)
    if height is None:
        height = m.workspace.high[2] if down else 0.0
    angles, planned = (-each if down else each for each in (angles, planned))
    if places is None:
        turn, order = 0.0, (0, 1, 2) if are_counter_clockwise(planned) else (0, 2, 1)
    else:
        turn, order = _match_places(planned, places)
    angles = angles - turn
    axes = (UPSIDE_DOWN if down else np.eye(3)) @ rotation_matrix(np.array([0.0, 0.0, turn]))
    slope = np.eye(3)
    slope[2, :2] = tilt
    frame = Frame(
        order, np.full(3, -1.0 if down else 1.0), np.array([0, 0, height]), slope @ axes, axes
    )
    limits, home = np.array(m.joint_limits, float), np.array(m.home.joints)
    stops = limits[:, 0] if down else limits[:, 1]
    stops = np.where(np.isfinite(stops), stops, home)
    if switches := getattr(m, "switches", None):
        stops = np.array(switches)
    rows = np.array(order)
    homed = frame.motors(stops + offset) - (height if linear else 0.0)
    heights = (up - height)[rows] * (-1 if down else 1)
    return Chains(
        frame, stops, radius[rows], angles[rows], heights, rods[rows], homed, arms[rows], tilt, bed
    )


def towers(
    model: Model,
    places: Array | None,
    tilted: bool,
    present: Refinement | None = None,
    equal_rods: bool = False,
    has_scale: bool = False,
    equal_radii: bool = True,
) -> tuple[Towers, Chains]:
    """Fit radii, rods, angles and end-stops, and, if `tilted`, the plate's slopes.

    All towers have one radius if `equal_radii`, and all rods one length if `equal_rods`.

    If the firmware `has_scale`, its scale is that of the model's recording, corrected by the
    model's encoder_gain. It is not fitted: it would imitate towers that lean, which touches and
    the firmware hardly know.
    """
    c = chains_of(model, places)
    rods = [c.rods.mean()] if equal_rods else [*c.rods]
    recorded = recorded_scale(model, c) if has_scale else None
    scale = None if recorded is None else recorded / (1 + read_gains(model)[list(c.frame.order)])
    radii, same = [c.radius.mean()] if equal_radii else [*c.radius], np.ones(3)
    slopes = c.tilt if tilted else ()
    parts = [np.array(part) for part in (c.angles, c.homed, radii, rods, slopes)]
    ends = np.cumsum([len(part) for part in parts])[:-1]

    def made(v: Array) -> Towers:
        angles, homed, out, long, tilt = np.split(v, ends)
        trim = _wrap_angles(angles - TOWERS)
        tilts = (tilt[0], tilt[1]) if tilted else (0.0, 0.0)
        delta = Towers(out * same, long * same, trim, homed, tilt=tilts)
        return replace(delta, scale=scale, recorded=recorded)

    start = np.concatenate(parts)
    return made(fit_numbers(model, start, lambda v: c.machine(made(v)), c.bed, present)), c


def recorded_scale(model: Model, chains: Chains) -> Array | None:
    """Return the scale (3,) of the recording in the firmware's order, if the model states it."""
    scale = getattr(model.mechanism, "scale", None)
    return None if scale is None else np.array(scale)[list(chains.frame.order)]


def has_gain(model: Model) -> bool:
    return model.has_effect(GAIN)


def read_gains(model: Model) -> Array:
    """Return the encoder_gain (3,) of each joint: its true travel is 1 + gain times its reading."""
    if not has_gain(model):
        return np.zeros(3)
    return np.array([model.value(f"{GAIN}.{joint}.gain") for joint in model.joints])


def complete_towers(read: Firmware, model: Model, places: Array | None) -> Firmware:
    """Return towers that were read from files, with joints as readings of the model's recording."""
    if not isinstance(read, Towers) or read.scale is None or model.mechanism.name not in LINEAR:
        return read
    recorded = recorded_scale(model, chains_of(model, places))
    if recorded is None:
        return read
    change = read.scale / recorded - 1
    worst = int(np.abs(change).argmax())
    if not abs(change[worst]) <= MAX_SCALE_CHANGE:
        raise ModelError(
            f"motor {worst + 1} has {read.scale[worst] * MM:.6g} steps or turns per mm in the "
            f"file, but {recorded[worst] * MM:.6g} in the model file (option scale of "
            f"{model.mechanism.name}): expected a change of at most {MAX_SCALE_CHANGE:.0%}. State "
            "in the file what the recording was made with"
        )
    return replace(read, recorded=recorded)


def with_scale_of(new: Firmware, present: Firmware, steps: Array) -> Firmware:
    """Return the present firmware with the scale of a new one.

    Its end-stops move so that the carriages stay where they are at these motors (3,) from the
    end-stops: in the middle of the touches.
    """
    if not (isinstance(new, Towers) and isinstance(present, Towers)) or new.scale is None:
        return present
    moved = replace(present, scale=new.scale)
    away = steps / present.readings_per_height - steps / moved.readings_per_height
    return replace(moved, end_stops=present.end_stops + away)


def express_gain(model: Model, made: Projection, scale: Array | None, field: str) -> Projection:
    """Say whether a firmware's `scale`, which is in `field`, expresses the model's encoder_gain."""
    if not has_gain(model):
        return made
    if scale is not None:
        return replace(made, expressed=(GAIN,))
    why = (
        "no file states its present values as plain numbers, one for each motor: export --into a "
        f"file that does, to express {GAIN}"
    )
    if getattr(model.mechanism, "scale", None) is None:
        why = (
            "the model file does not state it: write the model file with new --from from the "
            f"printer's files, which state it, and fit again, to express {GAIN}"
        )
    return replace(made, remarks=(*made.remarks, f"{field} is not exported, because {why}"))


def shoulders(
    model: Model,
    places: Array | None,
    equal_heights: bool = False,
    equal_arms: bool = False,
    present: Refinement | None = None,
) -> tuple[Shoulders, Chains]:
    """Fit one radius, rods, angles and end-stops, and a height and an arm for each chain or all."""
    c = chains_of(model, places)
    heights = [c.heights.mean()] if equal_heights else [*c.heights]
    arms = [c.arms.mean()] if equal_arms else [*c.arms]
    n = len(heights)

    def made(v: Array) -> Shoulders:
        same = np.ones(3)
        limits = tuple((-np.pi / 2, float(top)) for top in v[7:10])
        each = v[10 : 10 + n] * same, v[10 + n :] * same
        return Shoulders(v[0], *each, v[1:4], v[4:7], limits)

    start = np.array([c.radius.mean(), *c.rods, *c.angles, *c.homed, *heights, *arms])
    return made(fit_numbers(model, start, lambda v: c.machine(made(v)), c.bed, present)), c


def describe_unequal_stops(model: Model, places: Array) -> tuple[str, ...]:
    """Say by how much end-stops must be moved for a firmware that has one position for all."""
    c = chains_of(model, places)
    unit, factor = ("mm", MM) if model.mechanism.name in LINEAR else ("degrees", DEGREE)
    higher = (c.homed.mean() - c.homed) / factor
    if np.abs(higher).max() < MIN_SHOWN_SHIFT:
        return ()
    moves = ", ".join(
        f"{model.joints[k]} {by:+.2f}" for k, by in zip(c.frame.order, higher, strict=True)
    )
    return (
        f"the firmware has one position for all end-stops: move them by {moves} {unit} (up is +), "
        "measure and fit again. What they differ by now is part of the error",
    )


def fit_equal_towers(
    model: Model, places: Array, present: Refinement | None = None, one_stop: bool = False
) -> tuple[Towers, Machine]:
    """Fit equal towers at `places`, an end-stop for each, and the origin.

    With `one_stop`, all end-stops are at one height.
    """
    c = chains_of(model, places)

    def machine(v: Array) -> Machine:
        same = np.ones(3)
        delta = Towers(v[0] * same, v[1] * same, 0 * same, v[4:] * same, first=float(places[0]))
        return c.machine(delta, np.array([v[2], v[3], 0.0]))

    tops = [c.homed.mean()] if one_stop else c.homed
    start = np.array([c.radius.mean(), c.rods.mean(), 0.0, 0.0, *tops])
    found = machine(fit_numbers(model, start, machine, c.bed, present))
    return found.firmware, found  # type: ignore[return-value]


def fit_equal_shoulders(
    model: Model,
    places: Array,
    one_stop: bool,
    present: Refinement | None = None,
    above_bed: bool = False,
) -> tuple[Shoulders, Machine]:
    """Fit equal chains at `places` about an origin in the plane of their motors.

    With `one_stop`, all end-stops are at one angle. With `above_bed`, the origin is at height 0 of
    the frame instead, and the motors' height above it is a number of the firmware.
    """
    c = chains_of(model, places)

    def machine(v: Array) -> Machine:
        tops = v[6:] * np.ones(3)
        limits = tuple((-np.pi / 2, float(top)) for top in tops)
        same, shift = np.ones(3), np.array(v[3:6])
        up = shift[2] if above_bed else 0.0
        shift[2] -= up
        delta = Shoulders(v[0], up * same, v[1] * same, v[2] * same, places, limits)
        found = c.machine(delta, c.frame.axes @ shift)
        return replace(found, frame=replace(found.frame, bed_anywhere=not above_bed))

    tops = [c.homed.mean()] if one_stop else c.homed
    lengths = [c.radius.mean(), c.arms.mean(), c.rods.mean()]
    start = np.array([*lengths, 0, 0, c.heights.mean(), *tops])
    found = machine(fit_numbers(model, start, machine, c.bed, present))
    return found.firmware, found  # type: ignore[return-value]


def _read_three(model: Model, name: str) -> Array:
    return np.array([model.value(f"chain{i}.{name}") for i in (1, 2, 3)])


def _angles(model: Model) -> Array:
    """Return the directions (3,) of the chains, in rad about z of {B}."""
    if model.mechanism.name not in LINEAR:
        return _read_three(model, "theta")
    around = model.mechanism.options.get("direction", 0.0) + np.arange(3) * 2 * np.pi / 3
    return np.asarray(around + np.arctan2(_read_three(model, "D_y"), _read_three(model, "D_x")))


def _plate(model: Model) -> tuple[float | None, tuple[float, float]]:
    """Return height and slopes in x and y of the plate that a probe touches."""
    for sensor in model.sensors:
        if sensor.name == "probe":
            z, rx, ry = (model.value(f"probe.plate.{name}") for name in ("z", "rx", "ry"))
            return z, (-ry, rx)
    return None, (0.0, 0.0)


def _wrap_angles(angles: Array) -> Array:
    """Wrap angles to -pi ... pi."""
    return np.asarray((angles + np.pi) % (2 * np.pi) - np.pi)


def _match_places(angles: Array, places: Array) -> tuple[float, tuple[int, int, int]]:
    """Return the turn (rad about z) of the firmware's frame, and the chain at each place."""
    near = (np.abs(_wrap_angles(angles - places[:, None])).min(axis=0) < MAX_TOWER_TRIM).all()
    turn = 0.0 if near else float(angles[0] - places[0])
    away = np.abs(_wrap_angles(angles - turn - places[:, None]))
    a, b, c = (int(i) for i in away.argmin(axis=1))
    if {a, b, c} != {0, 1, 2}:
        at = ", ".join(f"{angle:.1f}" for angle in np.degrees(angles))
        expected = ", ".join(f"{place:g}" for place in np.degrees(places))
        raise ModelError(
            f"the towers are at {at} degrees about z: expected each near another one of "
            f"{expected} degrees, apart from a turn of the whole frame. The firmware cannot "
            "represent other places: use the targets c or table"
        )
    return turn, (a, b, c)
