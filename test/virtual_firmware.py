"""Firmwares as their documents describe them: own readers, own root finding, nothing shared.

Each answers, in mm and degrees, with the motors' positions for points and at the end-stops.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from configparser import ConfigParser

import numpy as np

from parallel_cal.virtual.robot import Array

HALVINGS, WINDINGS = 80, 4000
ANCHORS = "ABCDI"  # of a Hangprinter in M669, whose other letters are taken


def bisected(rises: Callable[[Array], Array], low: Array, high: Array) -> Array:
    """Where a growing function is zero."""
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        below = rises(middle) < 0
        low, high = np.where(below, middle, low), np.where(below, high, middle)
    return (low + high) / 2


def carriages(r: Array, towers: Array, rods: Array, slope: Array) -> Array:
    """Heights (N, 3) above the nozzle's zero at which rods from the towers reach the nozzle."""
    z = (r[:, 2] + r[:, :2] @ slope)[:, None]
    away = np.linalg.norm(r[:, None, :2] - towers, axis=2)
    heights = bisected(lambda h: np.hypot(away, h - z) - rods, z + 0 * away, z + 2 * rods)
    return np.where(away <= rods, heights, np.nan)


def arms(r: Array, out: Array, up: Array, upper: Array, lower: Array, around: Array) -> Array:
    """Angles (N, 3) degrees up from the horizontal at which elbows are a rod from the nozzle.

    Of the two elbows it is the one that is further out. NaN: no elbow is a rod away.
    """
    far = r[:, :1] * np.cos(around) + r[:, 1:2] * np.sin(around) - out
    side = r[:, 1:2] * np.cos(around) - r[:, :1] * np.sin(around)
    tall = r[:, 2:] - up

    def long(t: Array) -> Array:
        flat = np.hypot(upper * np.cos(t) - far, upper * np.sin(t) - tall)
        return np.hypot(flat, side) - lower

    folded = np.arctan2(tall, far)  # towards the nozzle, from there outwards to away from it
    away = folded + np.where(tall > 0, -np.pi, np.pi)
    found = np.degrees(bisected(long, folded, away))
    return np.where((long(folded) <= 0) & (long(away) >= 0), found, np.nan)


def nozzle_between(joints: Array, rods: Array) -> Array:
    """Where (N, 3) rods from three joints (N, 3, 3) meet, below the joints' plane as seen from the
    side on which joints 1, 2, 3 stand counter-clockwise; NaN where they do not meet.

    The point is a solution of three equations of spheres. Their differences are two planes, which
    cut each other in a line along the normal of the joints' plane.
    """
    first = joints[:, 0]
    sides = joints[:, 1:] - first[:, None]
    normal = np.cross(sides[:, 0], sides[:, 1])
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    planes = np.concatenate([sides, normal[:, None]], axis=1)
    longer = (rods[0] ** 2 - rods[1:] ** 2 + (sides**2).sum(axis=2)) / 2
    foot = np.linalg.solve(planes, np.column_stack([longer, np.zeros(len(first))])[..., None])
    foot = foot[..., 0]
    with np.errstate(invalid="ignore"):
        depth = np.sqrt(rods[0] ** 2 - (foot**2).sum(axis=1))
    return np.asarray(first + foot - depth[:, None] * normal)


def wound(line: Array, radius: Array, buildup: Array) -> Array:
    """Turns of a spool (rad) that let out line, in small steps: what leaves it makes it smaller."""
    steps = (np.arange(WINDINGS) + 0.5) / WINDINGS
    now = np.sqrt(radius[:, None] ** 2 - buildup[:, None] * line[..., None] * steps)
    return np.mean(line[..., None] / now, axis=-1)


class Klipper:
    """Its `delta` and `rotary_delta`, with the forward problem that it solves after homing.

    Sources: Klipper documentation, "Configuration reference"; klippy/kinematics/delta.py and
    rotary_delta.py, whose trilateration needs joints that stand counter-clockwise.
    """

    def __init__(self, text: str) -> None:
        file = ConfigParser(inline_comment_prefixes=("#", ";"), strict=False)
        file.read_string(re.sub(r"(?m)^#\*# (?=\[|\w+ = )", "", text))  # what is saved counts
        self.printer, self.steppers = file["printer"], [file[f"stepper_{a}"] for a in "abc"]
        self.around = np.radians(self.each("angle"))
        self.rotary = self.printer["kinematics"] == "rotary_delta"

    def each(self, key: str) -> Array:
        return np.array([float(stepper[key]) for stepper in self.steppers])

    def motors(self, r: Array) -> Array:
        if self.rotary:
            out, up = (float(self.printer[f"shoulder_{key}"]) for key in ("radius", "height"))
            lengths = [self.each(f"{part}_arm_length") for part in ("upper", "lower")]
            return arms(r, out, up, *lengths, self.around)
        radius = float(self.printer["delta_radius"])
        towers = radius * np.column_stack([np.cos(self.around), np.sin(self.around)])
        return carriages(r, towers, self.each("arm_length"), np.zeros(2))

    def homed(self) -> Array:
        """Motor i with the nozzle in the middle at its end-stop's height."""
        at = [self.motors(np.array([[0, 0, z]]))[0] for z in self.each("position_endstop")]
        return np.diag(at)

    def forward(self, motors: Array) -> Array:
        """Points (N, 3) at which it believes the nozzle with motors (N, 3)."""
        cos, sin = np.cos(self.around), np.sin(self.around)
        if self.rotary:
            upper, angles = self.each("upper_arm_length"), np.radians(motors)
            out = float(self.printer["shoulder_radius"]) + upper * np.cos(angles)
            up = float(self.printer["shoulder_height"]) + upper * np.sin(angles)
            rods = self.each("lower_arm_length")
        else:
            out = float(self.printer["delta_radius"]) + 0 * motors
            up, rods = motors, self.each("arm_length")
        return nozzle_between(np.stack([out * cos, out * sin, up], axis=2), rods)

    def home_position(self) -> Array:
        """Where (3,) it believes the nozzle after homing."""
        return self.forward(self.homed()[None])[0]


def words(text: str) -> dict[str, Array]:
    """`M665 L` and what follows of each command, without comments."""
    found = {}
    for line in re.sub(r";.*|\(.*?\)", "", text).splitlines():
        code, *rest = line.split() or [""]
        for word in rest:
            found[f"{code} {word[0]}"] = np.array(word[1:].split(":"), float)
    return found


class Duet:
    def __init__(self, text: str) -> None:
        self.w = words(text)
        self.kind = int(self.w.get("M669 K", [3])[0])
        n = int(self.w.get("M669 N", [4])[0])
        lines = {f"M666 {letter}": n for letter in "RUOLH"}
        takes = {
            6: lines | {f"M669 {letter}": 3 for letter in ANCHORS[:n]},
            9: {f"M669 {letter}": 4 if letter in "DC" else 2 for letter in "XYPDBC"},
            10: {"M669 A": 2},
        }
        for field, count in takes.get(self.kind, {}).items():
            assert len(self.w[field]) == count, f"{field}: wrong number of values, needs {count}"

    def xyz(self, code: str) -> Array:
        return np.concatenate([self.w.get(f"{code} {axis}", np.zeros(1)) for axis in "XYZ"])

    def motors(self, r: Array) -> Array:
        w, ones = self.w, np.ones(3)
        if self.kind == 3:
            x, y, z = np.radians(self.xyz("M665"))
            angles = np.radians(30)
            towers = w["M665 R"] * np.array(
                [
                    [-np.cos(angles + x), -np.sin(angles + x)],
                    [np.cos(angles - y), -np.sin(angles - y)],
                    [-np.sin(z), np.cos(z)],
                ]
            )
            slope = np.concatenate([w.get(f"M666 {axis}", np.zeros(1)) for axis in "AB"]) / 100
            return carriages(r, towers, w["M665 L"] * ones, slope)
        if self.kind == 10:
            around = np.radians([-150, -30, 90] + self.xyz("M669"))
            return arms(r, w["M669 R"], w["M669 H"] * ones, w["M669 U"], w["M669 L"], around)
        if self.kind == 9:
            return self.cranks(r)
        anchors = np.array([w[f"M669 {letter}"] for letter in ANCHORS[: int(w["M669 N"][0])]])
        away = np.linalg.norm(r[:, None] - anchors, axis=2) - np.linalg.norm(anchors, axis=1)
        line = away * w["M666 U"]
        gears = w["M666 H"] / w["M666 L"]
        grows = w["M666 Q"] * w["M666 O"] * np.ones(len(anchors))
        return np.degrees(gears * wound(line, w["M666 R"] * np.ones(len(anchors)), grows))

    def homed(self) -> Array:
        w = self.w
        if self.kind == 3:
            return w["M665 H"] + np.sqrt(w["M665 L"] ** 2 - w["M665 R"] ** 2) + self.xyz("M666")
        if self.kind == 9:
            return w["M669 B"]
        return w["M669 A"][1] + self.xyz("M666") if self.kind == 10 else np.zeros(4)

    def cranks(self, r: Array) -> Array:
        """Work mode 2: the left crank is turned left of the point, the right one right of it."""
        w, found = self.w, []
        assert w["M669 L"] == 2
        for k, sense in enumerate((1, -1)):
            axis = np.array([w["M669 X"][k], w["M669 Y"][k]])
            aim = np.arctan2(*(r[:, :2] - axis).T[::-1])

            def long(opened: Array, k=k, sense=sense, axis=axis, aim=aim) -> Array:  # type: ignore[no-untyped-def]
                turned = aim + sense * opened
                elbow = axis + w["M669 P"][k] * np.column_stack([np.cos(turned), np.sin(turned)])
                return np.linalg.norm(r[:, :2] - elbow, axis=1) - w["M669 D"][k]

            found.append(aim + sense * bisected(long, 0 * aim, 0 * aim + np.pi))
        return np.degrees(np.column_stack(found)) % 360


class LinuxCnc:
    """kins(9) with `setp` lines of a .hal file and the offsets of an .ini file."""

    def __init__(self, hal: str, ini: str) -> None:
        self.pins = {p[1]: float(p[2]) for line in hal.splitlines() if (p := line.split())}
        self.ini = ConfigParser()
        self.ini.read_string(ini)

    def pin(self, name: str) -> float:
        return self.pins[name]

    def ends(self, which: str) -> Array:
        return np.array(
            [[self.pin(f"genhexkins.{which}.{k}.{a}") for a in "xyz"] for k in range(6)]
        )

    def motors(self, r: Array, R: Array | None = None) -> Array:
        if "lineardeltakins.R" in self.pins:
            radius, ones = self.pin("lineardeltakins.R"), np.ones(3)
            towers = radius * np.array([[0, 1], [-(0.75**0.5), -0.5], [0.75**0.5, -0.5]])
            return carriages(r, towers, self.pin("lineardeltakins.L") * ones, np.zeros(2))
        if "rotarydeltakins.thighlength" in self.pins:
            out, inner, thigh, shin = (
                self.pin(f"rotarydeltakins.{name}")
                for name in ("platformradius", "footradius", "thighlength", "shinlength")
            )
            around, ones = np.radians([-90, 30, 150]), np.ones(3)
            return -arms(r, out - inner, 0 * ones, thigh * ones, shin * ones, around)
        tops = r[:, None] + np.einsum("nij,kj->nki", R, self.ends("platform"))
        return np.linalg.norm(tops - self.ends("base"), axis=2)

    def homed(self) -> Array:
        joints = range(sum(name.startswith("JOINT") for name in self.ini.sections()))
        return np.array([float(self.ini[f"JOINT_{i}"]["HOME_OFFSET"]) for i in joints])


class GrblHal:
    """Its Delta: triangles' sides in place of radii, knees down is positive."""

    def __init__(self, text: str) -> None:
        self.s = {int(n): float(v) for n, v in re.findall(r"\$(\d+)=(\S+)", text)}

    def motors(self, r: Array) -> Array:
        out, ones = (self.s[643] - self.s[644]) / (2 * 3**0.5), np.ones(3)
        around = np.radians([-90, 30, 150])
        return -arms(r, out, 0 * ones, self.s[642] * ones, self.s[641] * ones, around)

    def homed(self) -> Array:
        return np.full(3, self.s[646])
