"""A ball on the platform, seated in sockets: where they are is unknown, or known on a plate."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from parallel_cal.base.errors import ModelError
from parallel_cal.base.rotation import cayley, rotation_matrix
from parallel_cal.base.units import DEGREE
from parallel_cal.model.mechanism import Mechanism
from parallel_cal.model.parameters import Named, Parameter
from parallel_cal.model.sensor import Sensor, point_on_platform, point_parameters
from parallel_cal.sensors._places import check_axes, check_touch, spread_places, workspace_radius

HOLE_TOLERANCE = 20e-6  # m, of the holes of a plate relative to each other
COLLINEAR = 1e-9  # m


@dataclass(frozen=True)
class Sockets(Sensor):
    """Position (m) of the ball at `tip` in {P} relative to the socket in which it is seated: zero.

    Without `holes` there are `n` sockets, each at an unknown place: visits to one socket have equal
    positions. With `holes` (m) the sockets are those of one plate: their positions relative to
    each other are known, and the position and rotation of the plate are identified. Holes on one
    line lie along the x-axis of the plate; its rotation about this line changes nothing. `rotation`
    (rad) is the rough rotation vector of the plate in {B}, and `places` (m) are the rough places of
    sockets, or of the plate, in {B}. By default they are somewhere in the workspace. `axes` are the
    coordinates that a seat holds: xy for a pin in a hole, or for a robot that moves in a plane.
    """

    n: int = 2
    holes: tuple[tuple[float, float, float], ...] = ()
    places: tuple[tuple[float, float, float], ...] = ()
    rotation: tuple[float, float, float] = (0.0, 0.0, 0.0)
    tip: tuple[float, float, float] = (0.0, 0.0, 0.0)
    axes: str = "xyz"
    sigma: float | None = 50e-6
    name: str = "socket"
    fixed: tuple[str, ...] = ("tip.*",)

    physics = "a ball on the platform is seated in sockets on the table"
    source = "Franzese et al., arXiv 2503.12584: a printed ball and socket"
    guessed_sigma = 50e-6
    needs_each_contact = False  # few touches do not visit every hole

    def __post_init__(self) -> None:
        check_touch(self, self.axes)
        expected = 1 if self.holes else self.n
        if self.places and len(self.places) != expected:
            raise ModelError(
                f"{self.name}: {len(self.places)} places, expected {expected}: "
                + ("that of the plate" if self.holes else "one for each socket")
            )
        if not self.holes and self.n < 1:
            raise ModelError(f"{self.name}: n is {self.n}, expected at least one socket")
        if self.holes and self.n not in (Sockets.n, len(self.holes)):
            raise ModelError(f"{self.name}: n is {self.n} beside {len(self.holes)} holes: omit n")
        if len(set(map(tuple, self.holes))) < len(self.holes):
            raise ModelError(f"{self.name}: two holes are at the same place")
        if not np.linalg.norm(self.rotation) <= 2 * np.pi:
            raise ModelError(
                f"{self.name}: rotation {self.rotation}, expected a rotation vector in rad"
            )
        if len(self.holes) == 1:
            raise ModelError(f"{self.name}: one hole has no distance: state n: 1 instead of holes")
        if self._on_a_line and np.ptp(self.holes, axis=0)[1:].max() > COLLINEAR:
            raise ModelError(
                f"{self.name}: the holes lie on one line, but not along x of their plate: state "
                "them as [x, 0, 0]"
            )

    def fixed_patterns(self) -> list[str]:
        """The holes of a plate are known, unless a fit is told to free them."""
        return [*super().fixed_patterns(), *([f"{self.name}.hole*"] if self.holes else [])]

    @property
    def _on_a_line(self) -> bool:
        holes = np.array(self.holes, dtype=float).reshape(-1, 3)
        return len(holes) > 1 and np.linalg.matrix_rank(holes - holes[0], tol=COLLINEAR) < 2

    @property
    def contacts(self) -> Mapping[str, tuple[str, ...]]:
        count = len(self.holes) or self.n
        names = [f"{self.name}{k}" for k in range(1, count + 1)]
        return {name: tuple(f"{name}.{axis}" for axis in self.axes) for name in names}

    @property
    def channels(self) -> tuple[str, ...]:
        return tuple(c for channels in self.contacts.values() for c in channels)

    def parameters(self, mechanism: Mechanism) -> list[Parameter]:
        check_axes(self, self.axes, mechanism)
        radius, tip = workspace_radius(mechanism), point_parameters("tip", self.tip, 1e-3)
        self._check_reach(2 * (radius + float(np.linalg.norm(self.tip))))
        if not self.holes:
            places = self.places or spread_places(mechanism, self.n, self.tip)
            rows = [
                point_parameters(f"place{k}", place, radius) for k, place in enumerate(places, 1)
            ]
            return [*self._select_held(rows), *tip]
        [place] = self.places or spread_places(mechanism, 1, self.tip)
        holes = [
            p
            for k, hole in enumerate(self.holes, 1)
            for p in point_parameters(f"hole{k}", hole, HOLE_TOLERANCE)
        ]
        return [
            *self._select_held([point_parameters("plate", place, radius)]),
            *[Parameter(f"plate.{a}", "rad", 0.0, 5 * DEGREE) for a in self._turns],
            *holes,
            *tip,
        ]

    def _check_reach(self, reach: float) -> None:
        """Raise ModelError if a ball that moves within `reach` (m) visits one hole at most."""
        holes = np.array(self.holes, dtype=float).reshape(-1, 3)
        apart = np.linalg.norm(holes[:, None] - holes, axis=2)[np.triu_indices(len(holes), 1)]
        if apart.min(initial=np.inf) > reach and len(holes):
            raise ModelError(
                f"{self.name}: the nearest two holes are {apart.min():.4g} m apart, but the ball "
                f"moves within {reach:.4g} m: expected positions in m on one plate that the robot "
                "reaches"
            )

    def _select_held(self, points: list[list[Parameter]]) -> list[Parameter]:
        """Return the coordinates that a seat holds; the others change nothing."""
        return [p for point in points for p in point if p.name[-1] in self.axes]

    def readings(self, r: Any, R: Any, s: Named) -> Any:
        def point(name: str) -> Any:
            return ca.vertcat(*(s.get(f"{name}.{a}", 0.0) for a in "xyz"))

        ball = point_on_platform(r, R, s)
        if not self.holes:
            places = [point(f"place{k}") for k in range(1, self.n + 1)]
        else:
            turns = ("rx", "ry", "rz")
            turn = ca.vertcat(*(s.get(f"plate.{a}", 0.0) for a in turns))
            R_plate = ca.DM(rotation_matrix(np.array(self.rotation))) @ cayley(turn)
            places = [
                point("plate") + R_plate @ s.vector(*[f"hole{k}.{a}" for a in "xyz"])
                for k in range(1, len(self.holes) + 1)
            ]
        held = ["xyz".index(a) for a in self.axes]
        return ca.vertcat(*((ball - place)[held] for place in places))

    @property
    def _turns(self) -> tuple[str, ...]:
        """Rotations of the plate that are identified."""
        if self.axes != "xyz":
            return ({"xy": "rz", "xz": "ry", "yz": "rx"}[self.axes],)
        return ("ry", "rz") if self._on_a_line else ("rx", "ry", "rz")
