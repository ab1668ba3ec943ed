"""Firmwares as their documents describe them: own readers, own root finding, nothing shared.

Each answers, in mm and degrees, with the motors' positions for points (`motors`) and at the
end-stops (`homed`), with the point that it computes from its motors (`forward`), and with the point
at which it believes the nozzle after homing (`home_position`). `number` is the type with which the
firmware computes: `forward` and `computed_motors` take it.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from configparser import ConfigParser

import numpy as np

from parallel_cal.virtual.robot import Array

HALVINGS, WINDINGS, NEWTON_STEPS = 80, 4000, 8
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
    foot = np.linalg.solve(planes, np.column_stack([longer, 0 * longer[:, 0]])[..., None])
    foot = foot[..., 0]
    with np.errstate(invalid="ignore"):
        depth = np.sqrt(rods[0] ** 2 - (foot**2).sum(axis=1))
    return np.asarray(first + foot - depth[:, None] * normal)


def lowest_point(joints: Array, rods: Array, number: type = np.float64) -> Array:
    """Where (N, 3) rods from three joints (N, 3, 3) meet: of the two points, the lower one.

    Two differences of the three equations of spheres give x and y as straight lines over z. The
    first sphere then is a quadratic equation in z, of which the smaller root counts.
    """
    joints, rods = joints.astype(number), rods.astype(number)
    first, two = joints[:, 0], number(2)
    sides = joints[:, 1:] - first[:, None]
    squares = (joints**2).sum(axis=2) - rods**2
    half = (squares[:, 1:] - squares[:, :1]) / two
    (ax, ay, az), (bx, by, bz) = sides[:, 0].T, sides[:, 1].T
    width = ax * by - ay * bx
    x0 = (half[:, 0] * by - half[:, 1] * ay) / width
    x1 = (ay * bz - az * by) / width
    y0 = (half[:, 1] * ax - half[:, 0] * bx) / width
    y1 = (az * bx - ax * bz) / width
    dx, dy, up = x0 - first[:, 0], y0 - first[:, 1], first[:, 2]
    a = number(1) + x1**2 + y1**2
    b = x1 * dx + y1 * dy - up
    c = dx**2 + dy**2 + up**2 - rods[0] ** 2
    with np.errstate(invalid="ignore"):
        z = (-b - np.sqrt(b**2 - a * c)) / a
    return np.column_stack([x0 + x1 * z, y0 + y1 * z, z])


def elbows(motors: Array, out: Array, up: Array, upper: Array, around: Array) -> Array:
    """Elbows (N, 3, 3) of arms turned up by motors (N, 3) degrees."""
    turned = np.radians(motors)
    far, high = out + upper * np.cos(turned), up + upper * np.sin(turned)
    return np.stack([far * np.cos(around), far * np.sin(around), high], axis=2)


def carriages_by_root(r: Array, towers: Array, rods: Array, slope: Array) -> Array:
    """The closed form of `carriages`, in the type of numbers of r."""
    away = ((r[:, None, :2] - towers) ** 2).sum(axis=2)
    with np.errstate(invalid="ignore"):
        return np.asarray(np.sqrt(rods**2 - away) + (r[:, 2] + r[:, :2] @ slope)[:, None])


def arms_by_root(
    r: Array, out: Array, up: Array, upper: Array, lower: Array, around: Array
) -> Array:
    """The closed form of `arms`, in the type of numbers of r: a cos t + b sin t = c."""
    far = out - (r[:, :1] * np.cos(around) + r[:, 1:2] * np.sin(around))
    side = r[:, 1:2] * np.cos(around) - r[:, :1] * np.sin(around)
    tall = up - r[:, 2:]
    two = r.dtype.type(2)
    a, b = two * upper * far, two * upper * tall
    c = lower**2 - upper**2 - tall**2 - far**2 - side**2
    with np.errstate(invalid="ignore"):
        sine = (b * c - a * np.sqrt(a**2 + b**2 - c**2)) / (a**2 + b**2)
        return np.degrees(np.arcsin(sine))


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

    number = np.float64

    def __init__(self, text: str) -> None:
        file = ConfigParser(inline_comment_prefixes=("#", ";"), strict=False)
        main, _, saved = text.partition("#*# <-")
        file.read_string(re.sub(r"(?m)^#\*# (?=\[|\w+ = )", "", f"#{saved}"))
        file.read_string(main)  # what it states counts
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

    def computed_motors(self, r: Array) -> Array:
        return self.motors(r)

    def forward(self, motors: Array, number: type = np.float64) -> Array:
        """Points (N, 3) at which it believes the nozzle with motors (N, 3)."""
        if self.rotary:
            out, up = (float(self.printer[f"shoulder_{key}"]) for key in ("radius", "height"))
            joints = elbows(motors, out, up, self.each("upper_arm_length"), self.around)
            return nozzle_between(joints, self.each("lower_arm_length"))
        radius = float(self.printer["delta_radius"])
        joints = elbows(0 * motors, radius, motors, np.zeros(3), self.around)
        return nozzle_between(joints, self.each("arm_length"))

    def home_position(self, number: type = np.float64) -> Array:
        """Where (3,) it believes the nozzle after homing."""
        return self.forward(self.homed()[None], number)[0]


def words(text: str) -> dict[str, Array]:
    """`M665 L` and what follows of each command, without comments."""
    found = {}
    for line in re.sub(r";.*|\(.*?\)", "", text).splitlines():
        code, *rest = line.split() or [""]
        for word in rest:
            found[f"{code} {word[0]}"] = np.array(word[1:].split(":"), float)
    return found


class Duet:
    """RepRapFirmware. Sources: Duet documentation, "M665", "M666", "M669"; the sources under
    src/Movement/Kinematics, version 3.5.
    """

    number = np.float32

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

    def towers(self) -> tuple[Array, Array, Array]:
        """Places (3, 2), rods (3,) and the bed's slope (2,) of a linear Delta."""
        w, angles = self.w, np.radians(30)
        x, y, z = np.radians(self.xyz("M665"))
        places = w["M665 R"] * np.array(
            [
                [-np.cos(angles + x), -np.sin(angles + x)],
                [np.cos(angles - y), -np.sin(angles - y)],
                [-np.sin(z), np.cos(z)],
            ]
        )
        slope = np.concatenate([w.get(f"M666 {axis}", np.zeros(1)) for axis in "AB"]) / 100
        return places, w["M665 L"] * np.ones(3), slope

    def shoulders(self) -> tuple[Array, ...]:
        """Radius, heights, arms, rods (3,) mm and directions (3,) rad of a rotary Delta."""
        lengths = [self.w[f"M669 {letter}"] * np.ones(3) for letter in "RHUL"]
        return *lengths, np.radians([-150, -30, 90] + self.xyz("M669"))

    def lines(self) -> tuple[Array, Array, Array, Array]:
        """Anchors (n, 3), spool radii (n,), mm, and what they grow a line's mm, of a Hangprinter;
        and the degrees that a motor turns for one of its spool.
        """
        w = self.w
        anchors = np.array([w[f"M669 {letter}"] for letter in ANCHORS[: int(w["M669 N"][0])]])
        ones = np.ones(len(anchors))
        return anchors, w["M666 R"] * ones, w["M666 Q"] * w["M666 O"], w["M666 H"] / w["M666 L"]

    def motors(self, r: Array) -> Array:
        if self.kind == 3:
            return carriages(r, *self.towers())
        if self.kind == 10:
            return arms(r, *self.shoulders())
        if self.kind == 9:
            return self.cranks(r)
        anchors, radii, grows, gears = self.lines()
        away = np.linalg.norm(r[:, None] - anchors, axis=2) - np.linalg.norm(anchors, axis=1)
        return np.degrees(
            gears * wound(away * self.w["M666 U"], radii, grows * np.ones(len(radii)))
        )

    def computed_motors(self, r: Array) -> Array:
        """The motors as its single-precision numbers make them (Deltas)."""
        if self.kind == 3:
            return carriages_by_root(*(part.astype(self.number) for part in (r, *self.towers())))
        return arms_by_root(*(part.astype(self.number) for part in (r, *self.shoulders())))

    def forward(self, motors: Array, number: type = np.float64) -> Array:
        if self.kind == 3:
            places, rods, slope = self.towers()
            up = np.stack([*np.broadcast_arrays(*places.T[:, None], motors)], axis=2)
            found = lowest_point(up, rods, number)
            return found - np.outer(found[:, :2] @ slope.astype(number), [0, 0, 1]).astype(number)
        if self.kind == 10:
            out, up, upper, rods, around = self.shoulders()
            joints = elbows(motors.astype(number), out, up, upper, around)
            first = np.full(3, upper[0])  # arm A's length makes the heights of all three elbows
            joints[:, :, 2] = elbows(motors.astype(number), out, up, first, around)[:, :, 2]
            return lowest_point(joints, rods, number)
        return self.tool(motors) if self.kind == 9 else self.end_point(motors)

    def home_position(self, number: type = np.float64) -> Array:
        """Where (3,) it believes the nozzle, with its motors at the end-stops."""
        return self.forward(self.homed()[None], number)[0]

    def tool(self, motors: Array) -> Array:
        """Where the rods of a five-bar meet: left of the line from the left to the right elbow."""
        w, turned = self.w, np.radians(motors)
        axes = np.column_stack([w["M669 X"], w["M669 Y"]])
        ends = axes + w["M669 P"][:, None] * np.stack([np.cos(turned), np.sin(turned)], axis=2)
        across = ends[:, 1] - ends[:, 0]
        span = np.linalg.norm(across, axis=1)
        long = w["M669 D"][:2] ** 2
        along = (span**2 + long[0] - long[1]) / (2 * span)
        unit = across / span[:, None]
        left = np.column_stack([-unit[:, 1], unit[:, 0]])
        height = np.sqrt(long[0] - along**2)
        at = ends[:, 0] + along[:, None] * unit + height[:, None] * left
        return np.column_stack([at, np.zeros(len(at))])

    def end_point(self, motors: Array) -> Array:
        """Where the lines of a Hangprinter meet: differences of the spheres are planes."""
        anchors, radii, grows, gears = self.lines()
        now = radii - grows * np.radians(motors) / gears / 2  # a spool's radius falls evenly
        line = (radii**2 - now**2) / grows / self.w["M666 U"]
        home = np.linalg.norm(anchors, axis=1)
        squares = (line + home) ** 2 - home**2
        sides = anchors[:-1] - anchors[-1]
        right = (squares[:, -1:] - squares[:, :-1]) / 2
        return np.linalg.lstsq(sides, right.T, rcond=None)[0].T

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


def turn_by(v: Array) -> Array:
    """The rotation (3, 3) by a vector (3,) rad."""
    angle = np.linalg.norm(v)
    x, y, z = v / angle if angle else v
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.asarray(np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K)


class LinuxCnc:
    """kins(9) with `setp` lines of a .hal file and the offsets of an .ini file."""

    number = np.float64

    def __init__(self, hal: str, ini: str) -> None:
        lines = (line.split() for line in hal.splitlines() if not line.startswith("#"))
        self.pins = {words[1]: float(words[2]) for words in lines if words}
        self.ini = ConfigParser()
        self.ini.read_string(ini)

    def pin(self, name: str) -> float:
        return self.pins[name]

    def ends(self, which: str) -> Array:
        return np.array(
            [[self.pin(f"genhexkins.{which}.{k}.{a}") for a in "xyz"] for k in range(6)]
        )

    @property
    def kind(self) -> str:
        return next(name.split(".")[0] for name in self.pins)

    def towers(self) -> Array:
        unit = np.array([[0, 1], [-(0.75**0.5), -0.5], [0.75**0.5, -0.5]])
        return np.asarray(self.pin("lineardeltakins.R") * unit)

    def shoulders(self) -> tuple[Array, ...]:
        out, inner, thigh, shin = (
            self.pin(f"rotarydeltakins.{name}") * np.ones(3)
            for name in ("platformradius", "footradius", "thighlength", "shinlength")
        )
        return out - inner, np.zeros(3), thigh, shin, np.radians([-90, 30, 150])

    def motors(self, r: Array, R: Array | None = None) -> Array:
        if self.kind == "lineardeltakins":
            rods = self.pin("lineardeltakins.L") * np.ones(3)
            return carriages(r, self.towers(), rods, np.zeros(2))
        if self.kind == "rotarydeltakins":
            return -arms(r, *self.shoulders())
        tops = r[:, None] + np.einsum("nij,kj->nki", R, self.ends("platform"))
        return np.linalg.norm(tops - self.ends("base"), axis=2)

    def computed_motors(self, r: Array) -> Array:
        return self.motors(r)

    def forward(self, motors: Array, number: type = np.float64) -> Array:
        """Points (N, 3) of a Delta."""
        if self.kind == "lineardeltakins":
            joints = np.stack(np.broadcast_arrays(*self.towers().T[:, None], motors), axis=2)
            return lowest_point(joints, self.pin("lineardeltakins.L") * np.ones(3))
        out, up, thigh, shin, around = self.shoulders()
        return lowest_point(elbows(-motors, out, up, thigh, around), shin)

    def forward_pose(self, motors: Array, r: Array, R: Array) -> tuple[Array, Array]:
        """Poses (N, 3), (N, 3, 3) of a hexapod, by Newton's method from nearby poses.

        As in genhexkins, a step turns by small angles about the axes of the base.
        """
        for _ in range(NEWTON_STEPS):
            arms_out = np.einsum("nij,kj->nki", R, self.ends("platform"))
            struts = r[:, None] + arms_out - self.ends("base")
            long = np.linalg.norm(struts, axis=2)
            unit = struts / long[..., None]
            slopes = np.concatenate([unit, np.cross(arms_out, unit)], axis=2)
            step = np.linalg.solve(slopes, (motors - long)[..., None])[..., 0]
            r = r + step[:, :3]
            R = np.stack([turn_by(v) @ now for v, now in zip(step[:, 3:], R, strict=True)])
        return r, R

    def home_position(self, number: type = np.float64) -> Array:
        return self.forward(self.homed()[None], number)[0]

    def homed(self) -> Array:
        joints = range(sum(name.startswith("JOINT") for name in self.ini.sections()))
        return np.array([float(self.ini[f"JOINT_{i}"]["HOME_OFFSET"]) for i in joints])


class GrblHal:
    """Its Delta: triangles' sides in place of radii, knees down is positive."""

    number = np.float32

    def __init__(self, text: str) -> None:
        self.s = {int(n): float(v) for n, v in re.findall(r"\$(\d+)=(\S+)", text)}

    def shoulders(self) -> tuple[Array, ...]:
        out, ones = (self.s[643] - self.s[644]) / (2 * 3**0.5), np.ones(3)
        arm, rod = self.s[642] * ones, self.s[641] * ones
        return out * ones, 0 * ones, arm, rod, np.radians([-90, 30, 150])

    def motors(self, r: Array) -> Array:
        return -arms(r, *self.shoulders())

    def homed(self) -> Array:
        return np.full(3, self.s[646])

    def computed_motors(self, r: Array) -> Array:
        return -arms_by_root(*(part.astype(self.number) for part in (r, *self.shoulders())))

    def forward(self, motors: Array, number: type = np.float64) -> Array:
        out, up, arm, rod, around = self.shoulders()
        return lowest_point(elbows(-motors.astype(number), out, up, arm, around), rod, number)

    def home_position(self, number: type = np.float64) -> Array:
        return self.forward(self.homed()[None], number)[0]


class Marlin:
    """Its linear Delta: M665 and M666. Sources: Marlin documentation; module/delta.cpp, motion.cpp.

    When homed, a carriage goes down from its end-stop by M666, if that is more than a few steps,
    and the nozzle is then believed at the homed height.
    """

    number = np.float32
    IGNORED = 6 / 80  # mm: steps that a move of a carriage has at least

    def __init__(self, text: str) -> None:
        self.w = {field: float(value[0]) for field, value in words(text).items()}

    def three(self, code: str, letters: str) -> Array:
        return np.array([self.w.get(f"{code} {letter}", 0.0) for letter in letters])

    def towers(self) -> tuple[Array, Array, Array]:
        around = np.radians([210, 330, 90] + self.three("M665", "XYZ"))
        places = self.w["M665 R"] * np.column_stack([np.cos(around), np.sin(around)])
        return places, self.w["M665 L"] + self.three("M665", "ABC"), np.zeros(2)

    def motors(self, r: Array) -> Array:
        return carriages(r, *self.towers())

    def computed_motors(self, r: Array) -> Array:
        return carriages_by_root(*(part.astype(self.number) for part in (r, *self.towers())))

    def forward(self, motors: Array, number: type = np.float64) -> Array:
        places, rods, _ = self.towers()
        joints = np.stack(np.broadcast_arrays(*places.T[:, None], motors), axis=2)
        return nozzle_between(joints.astype(number), rods.astype(number))

    def retracts(self) -> Array:
        """How far (3,) each carriage goes down from its end-stop."""
        asked = -self.three("M666", "XYZ")
        return np.where(asked > self.IGNORED, asked, 0.0)

    def homed(self) -> Array:
        """Where (3,) the carriages are at their end-stops, by what it believes after homing."""
        believed = self.motors(np.array([[0, 0, self.w["M665 H"]]]))[0]
        return believed + self.retracts()

    def home_position(self, number: type = np.float64) -> Array:
        """Where (3,) the nozzle is after homing, by its forward problem."""
        return self.forward((self.homed() - self.retracts())[None], number)[0]


class MarlinFork(Marlin):
    """Marlin's relatives, whose M666 has all words: letters of angles, radii and rods differ."""

    def __init__(self, text: str, angles: str, radii: str, rods: str) -> None:
        super().__init__(text)
        self.angles, self.radii, self.rods = angles, radii, rods
        self.w["M665 H"] = self.w["M666 H"] + self.w.get("M206 Z", 0.0)

    def towers(self) -> tuple[Array, Array, Array]:
        around = np.radians([210, 330, 90] + self.three("M666", self.angles))
        out = (self.w["M666 R"] + self.three("M666", self.radii))[:, None]
        rods = self.w["M666 D"] + (self.three("M666", self.rods) if self.rods else np.zeros(3))
        return out * np.column_stack([np.cos(around), np.sin(around)]), rods, np.zeros(2)


def mk4duo(text: str) -> MarlinFork:
    return MarlinFork(text, "IJK", "UVW", "ABC")


def richcattell(text: str) -> MarlinFork:
    return MarlinFork(text, "ABC", "IJK" if "M666 I" in words(text) else "EFG", "")


class Smoothie:
    """Smoothieware's Deltas: `key value` and, before them, commands of config-override.

    A carriage that touches its end-stop is where the homed height without its trim puts it. A
    rotary Delta states sides of triangles and counts its angles down; its motors stand above z = 0
    by what is left of delta_z_offset below the effector and the tool.
    """

    number = np.float32

    def __init__(self, text: str, override: str = "") -> None:
        lines = [line.split("#")[0].split() for line in text.splitlines()]
        self.k = {line[0]: line[1] for line in lines if len(line) > 1}
        self.w = {field: float(value[0]) for field, value in words(override).items()}

    def get(self, key: str, word: str = "") -> float:
        return self.w.get(word, float(self.k.get(key, 0.0)))

    @property
    def linear(self) -> bool:
        return self.k["arm_solution"] != "rotary_delta"

    def towers(self) -> tuple[Array, Array, Array]:
        more = [
            self.get(f"delta_tower{i}_offset", f"M665 {w}")
            for i, w in zip("123", "ABC", strict=True)
        ]
        turn = [
            self.get(f"delta_tower{i}_angle", f"M665 {w}")
            for i, w in zip("123", "DEH", strict=True)
        ]
        out = self.get("arm_radius", "M665 R") + np.array(more)
        around = np.radians(np.array([210, 330, 90]) + turn)
        places = out[:, None] * np.column_stack([np.cos(around), np.sin(around)])
        return places, np.full(3, self.get("arm_length", "M665 L")), np.zeros(2)

    def shoulders(self) -> tuple[Array, ...]:
        e, f, rod, arm = (
            self.get(f"delta_{part}", f"M665 {w}")
            for part, w in zip(("e", "f", "re", "rf"), "ABCD", strict=True)
        )
        up = self.get("delta_z_offset", "M665 E")
        up -= self.get("delta_ee_offs", "M665 I") + self.get("delta_tool_offset", "M665 H")
        turn = 180 if self.k.get("delta_mirror_xy") == "true" else 0
        around = np.radians(np.array([-90, 30, 150]) + turn)
        same = np.ones(3)
        return (f - e) / 12**0.5 * same, up * same, arm * same, rod * same, around

    def motors(self, r: Array) -> Array:
        return carriages(r, *self.towers()) if self.linear else -arms(r, *self.shoulders())

    def computed_motors(self, r: Array) -> Array:
        if self.linear:
            return carriages_by_root(*(part.astype(self.number) for part in (r, *self.towers())))
        return -arms_by_root(*(part.astype(self.number) for part in (r, *self.shoulders())))

    def forward(self, motors: Array, number: type = np.float64) -> Array:
        if self.linear:
            places, rods, _ = self.towers()
            joints = np.stack(np.broadcast_arrays(*places.T[:, None], motors), axis=2)
            return nozzle_between(joints.astype(number), rods.astype(number))
        out, up, arm, rod, around = self.shoulders()
        return lowest_point(elbows(-motors.astype(number), out, up, arm, around), rod, number)

    def homed(self) -> Array:
        stops = np.array([self.get(f"{axis}_max") for axis in ("alpha", "beta", "gamma")])
        stops[2] = self.w.get("M665 Z", stops[2])
        stops = stops + [self.w.get(f"M206 {axis}", 0.0) for axis in "XYZ"]
        if not self.linear:
            return stops
        trims = [
            self.get(f"{axis}_trim_mm", f"M666 {word}")
            for axis, word in zip(("alpha", "beta", "gamma"), "XYZ", strict=True)
        ]
        return self.motors(stops[None])[0] - trims

    def home_position(self, number: type = np.float64) -> Array:
        return self.forward(self.homed()[None], number)[0]


class FluidNcDelta(GrblHal):
    """FluidNC's ParallelDelta: the same formulas, and an origin that homing moves.

    When homed, all arms are at up_degrees, and the position is that of mpos_mm.
    """

    def __init__(self, text: str) -> None:
        pairs = re.findall(r"^\s*(\w+):\s*([-\d.]+)", text, re.MULTILINE)
        self.k = {key: float(value) for key, value in pairs}
        names = ("linkage_mm", "crank_mm", "base_triangle_mm", "end_effector_triangle_mm")
        self.s = dict(zip((641, 642, 643, 644), (self.k[name] for name in names), strict=True))
        self.s[646] = self.k.get("up_degrees", -30.0)
        top = super().forward(self.homed()[None])[0]
        self.shift = np.array([0, 0, self.k.get("mpos_mm", 0.0)]) - top

    def motors(self, r: Array) -> Array:
        return super().motors(r - self.shift)

    def computed_motors(self, r: Array) -> Array:
        return super().computed_motors(r - self.shift)

    def forward(self, motors: Array, number: type = np.float64) -> Array:
        return super().forward(motors, number) + self.shift.astype(number)


def crossed_circles(centres: Array, radii: Array) -> Array:
    """Where (N, 2) two circles (N, 2) about centres (2, 2) cross, right of the way between them."""
    (x0, y0), (x1, y1) = centres
    far = np.hypot(x1 - x0, y1 - y0)
    along = (radii[:, 0] ** 2 - radii[:, 1] ** 2 + far**2) / (2 * far)
    across = -np.sqrt(radii[:, 0] ** 2 - along**2)
    ux, uy = (x1 - x0) / far, (y1 - y0) / far
    return np.column_stack([x0 + along * ux - across * uy, y0 + along * uy + across * ux])
