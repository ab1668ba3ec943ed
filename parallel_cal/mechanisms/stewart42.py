"""Stewart platform with perfect ball joints, 7 parameters a leg (section 3.3.2, eq. 3.8): 42."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np

from parallel_cal.base.errors import ModelError
from parallel_cal.base.units import DEGREE
from parallel_cal.mechanisms._controller import read_controller
from parallel_cal.mechanisms._size import rms_radius
from parallel_cal.model.drawing import Line
from parallel_cal.model.drawing import ring as closed
from parallel_cal.model.mechanism import Home, Mechanism, Workspace
from parallel_cal.model.parameters import Named, Parameter, ParameterTable

BASE_RADIUS, PLATFORM_RADIUS, HEIGHT, RETRACTED = 0.25, 0.15, 0.3, 0.25  # m
TRAVEL = 0.2  # m, of each leg
# Joints come in pairs 20 degrees apart; each leg leads to the nearer pair of the platform.
BASE_ANGLES = (-10, 10, 110, 130, 230, 250)
PLATFORM_ANGLES = (-50, 50, 70, 170, 190, 290)


def ring(radius: float, degrees: tuple[float, ...]) -> np.ndarray:
    """Place points (n, 3) on a circle in the plane z = 0."""
    angles = np.radians(degrees)
    return radius * np.column_stack([np.cos(angles), np.sin(angles), np.zeros(len(angles))])


ENDS = {"B": "platform joint", "C": "base joint"}


def one_leg(leg: str, B: np.ndarray, C: np.ndarray, retracted: float) -> list[Parameter]:
    """Make the parameters of one leg: centres B in {P} and C in {B}, (3,) or (2,) m, and the length
    at reading zero."""
    balls = [
        Parameter(
            f"{leg}.{name}_{axis}",
            "m",
            float(value),
            1e-3,
            f"{name} balls",
            label=f"{ENDS[name]}'s {axis}",
        )
        for name, point in (("B", B), ("C", C))
        for axis, value in zip("xyz", point, strict=False)
    ]
    offset = Parameter(f"{leg}.L0", "m", retracted, 1e-3, "offset", label="length at reading zero")
    return [*balls, offset]


def leg_parameters(
    platform: np.ndarray, base: np.ndarray, retracted: float | np.ndarray
) -> ParameterTable:
    """Make the parameters of n legs; centres B in {P} and C in {B} are (n, 3) m each."""
    legs = zip(platform, base, np.broadcast_to(retracted, len(base)), strict=True)
    return ParameterTable(
        p for i, (B, C, L0) in enumerate(legs, start=1) for p in one_leg(f"leg{i}", B, C, float(L0))
    )


def read_points(name: str, points: Points) -> np.ndarray:
    """Return six or more points (n, 3) m, given as coordinates or on a circle."""
    try:
        if isinstance(points, Mapping):
            known: Any = dict(points)
            found = ring(float(known.pop("radius")), tuple(known.pop("angles")))
            if known:
                raise ValueError(f"unknown key {', '.join(known)}")
        else:
            found = np.array(points, dtype=float)
    except (KeyError, TypeError, ValueError) as error:
        raise ModelError(f"{name}: {error}; {SIX_POINTS}") from None
    if len(found) < 6 or found.shape != (len(found), 3) or not np.isfinite(found).all():
        raise ModelError(f"{name} has the shape {found.shape}; {SIX_POINTS}")
    return found


def read_ends(
    base: Points | None, platform: Points | None, usual: tuple[np.ndarray, np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the points (n, 3) m of the legs on the base and on the platform, one of each for every
    leg; the `usual` ones where none are given."""
    C = usual[0] if base is None else read_points("base", base)
    B = usual[1] if platform is None else read_points("platform", platform)
    if len(B) != len(C):
        raise ModelError(
            f"{len(B)} points of the platform for {len(C)} points of the base, expected one of "
            "each for every leg"
        )
    return C, B


Points = Sequence[Sequence[float]] | np.ndarray | Mapping[str, Any]
SIX_POINTS = (
    "expected six points [x, y, z] in m, or {radius: m, angles: [six angles in degrees]}, or one "
    "for each leg if there are more than six legs"
)
PLATFORM, BASE = ring(PLATFORM_RADIUS, PLATFORM_ANGLES), ring(BASE_RADIUS, BASE_ANGLES)
BODIES = {"base": ("*.C_?",), "platform": ("*.B_?",), "legs": ("*.L0",)}


class Stewart42(Mechanism):
    """Stewart platform: six legs with measured lengths (6-SPS).

    Leg i connects the point B on the platform with the point C on the base (`legI.B_x`, `legI.C_x`,
    ...). The points B are stated in {P}, the frame of the platform, and the points C in {B}, the
    frame of the base. Each leg gives one equation, `|r + R B - C| = q + L0`.

    Options: `base` and `platform`, the six points C in {B} and B in {P}: (6, 3) in m, or a radius
    in m and six angles in degrees, such as `{radius: 0.25, angles: [-10, 10, 110, 130, 230, 250]}`
    (seven points or angles for seven legs, and so on); `height` in m of the platform above the base
    at home; `retracted`, the length in m of a leg at reading zero (default: its length at home, so
    that the readings at home are 0; 0 if the readings are whole lengths); `limits` of the readings
    in m; `tolerance` in m of all these numbers. Without options, the nominal robot has two flat
    hexagons.

    The default of `limits` is 0 to 0.2 m. If you state `base` or `platform` without `retracted`, so
    that the readings at home are 0, it is -L to L, with L = 0.1 m at the default `height`, and in
    proportion to `height`.

    Two further options describe the controller with which the legs were recorded; an export for it
    starts from them. `switches` are the readings in m at which the legs are homed (default: the
    upper limits). `scale` is how many counts of its encoder or steps of its motor make a leg's
    reading 1 m longer (default: unknown).

    A robot with more than six legs needs no measuring device: if its parameters are wrong, the
    lengths of the legs do not agree on one pose.
    """

    joint_unit = "m"
    closed_forms = ("inverse",)
    bodies = BODIES
    parts = ("leg",)

    def __init__(
        self,
        base: Points | None = None,
        platform: Points | None = None,
        height: float = HEIGHT,
        retracted: float | None = None,
        limits: Sequence[float] | None = None,
        tolerance: float = 1e-3,
        switches: Sequence[float] | None = None,
        scale: Sequence[float] | None = None,
    ):
        drawn = base is not None or platform is not None
        C, B = read_ends(base, platform, (BASE, PLATFORM))
        n = len(C)
        self.joints = tuple(f"leg{i + 1}" for i in range(n))
        try:
            height, tolerance = float(height), float(tolerance)
            if limits is None:
                travel = TRAVEL / 2 * height / HEIGHT
                limits = (-travel, travel) if drawn and retracted is None else (0.0, TRAVEL)
            low, high = (float(limit) for limit in limits)
        except (TypeError, ValueError):
            raise ModelError(
                f"height {height!r}, tolerance {tolerance!r}, limits {limits!r}: expected a number "
                "in m each, and two limits in m"
            ) from None
        lengths = np.linalg.norm(B + [0, 0, height] - C, axis=1).round(13)
        if retracted is None:
            zero = lengths if drawn else np.full(n, RETRACTED)
        else:
            zero = np.full(n, retracted)
        if not (np.isfinite(lengths).all() and (lengths > 0).all() and (zero >= 0).all()):
            raise ModelError(
                f"height {height} and retracted {retracted}: expected legs longer than 0 m at "
                "home, and no shorter than 0 m at reading zero"
            )
        if not low < high:
            raise ModelError(f"limits {low} to {high} m: expected the lower limit first")
        self.parameters = ParameterTable(
            replace(p, tolerance=tolerance) for p in leg_parameters(B, C, zero)
        )
        readings = tuple(float(q) for q in lengths - zero)
        self.home = Home(joints=readings, position=(0.0, 0.0, height))
        reach = np.array([0.04, 0.04, 0.03]) * height / HEIGHT
        middle, turn = np.array([0.0, 0.0, height]), (10 * DEGREE,) * 3
        self.workspace = Workspace.around(middle, reach, turn)
        self.joint_limits = ((low, high),) * n
        self.scale, self.switches = read_controller(scale, switches, n, "leg")
        self.length = rms_radius(B)

    def closure(self, q: Any, r: Any, R: Any, p: Named) -> Any:
        """Compute the length error of each leg, eq. 3.8 without the squares, in metres."""
        legs = self.legs(p)
        return ca.vertcat(*[self.span(r, R, c) - (q[i] + c.L0) for i, c in enumerate(legs)])

    def legs(self, p: Named) -> list[Named]:
        """Return the parameters of each leg."""
        return [p[leg] for leg in self.joints]

    @staticmethod
    def span(r: Any, R: Any, c: Named) -> Any:
        """Distance between the ball centres of one leg."""
        B, C = c.vector("B_x", "B_y", "B_z"), c.vector("C_x", "C_y", "C_z")
        return ca.norm_2(r + R @ B - C)

    def rods(self, q: Any, p: Named) -> tuple[list[Any], list[Any], list[Any]]:
        """Return the legs' ends C in {B} and B in {P}, (3, 1) each, and their lengths."""
        legs = self.legs(p)
        C = [c.vector("C_x", "C_y", "C_z") for c in legs]
        B = [c.vector("B_x", "B_y", "B_z") for c in legs]
        return C, B, [q[i] + c.L0 for i, c in enumerate(legs)]

    def struts(self, r: Any, R: Any, p: Named) -> list[tuple[Any, Any]]:
        """Return the legs' ends C and B in {B}, (3, 1) m each."""
        return [
            (c.vector("C_x", "C_y", "C_z"), r + R @ c.vector("B_x", "B_y", "B_z"))
            for c in self.legs(p)
        ]

    def centres(self, q: Any, r: Any, R: Any, p: Named) -> Mapping[str, list[Any]]:
        """Return the middles of the legs."""
        C, B, _ = self.rods(q, p)
        return {"leg": [(c + r + R @ b) / 2 for c, b in zip(C, B, strict=True)]}

    def drawing(self, q: Any, r: Any, R: Any, p: Named) -> list[Line]:
        """Draw both hexagons and the legs between them."""
        C, B, _ = self.rods(q, p)
        tops = [r + R @ b for b in B]
        legs = enumerate(zip(C, tops, strict=True), start=1)
        return [
            closed("base", C, "*.C_?"),
            *[Line("driven", ends, (f"leg{i}.L0",)) for i, ends in legs],
            closed("platform", tops, "*.B_?"),
        ]

    def joint_candidates(self, r: Any, R: Any, p: Named) -> list[tuple[Any, ...]]:
        """Find the only solution: a leg's length is positive."""
        return [(self.span(r, R, c) - c.L0,) for c in self.legs(p)]
