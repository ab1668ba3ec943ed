"""The lines of a cable robot as its options describe them: where they run, and what winds them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from parallel_cal.base.errors import ModelError
from parallel_cal.base.units import MM
from parallel_cal.model.parameters import Parameter

GEAR, RADIUS = 255 / 20, 75 * MM  # of the Hangprinter HP4
MIN_LENGTH = 1e-6  # m, of a line


@dataclass(frozen=True)
class DrawnLines:
    """The lines of a cable robot as drawn.

    `anchors` are (n, 3) m, `ends` the second anchors (3,) m or None, `advantages` and `strands`
    (n,) the numbers of the pulleys. `used` are the coordinates (indices) in which the point moves,
    `home` (3,) m is where it was stated to be, if at all.
    """

    anchors: np.ndarray
    ends: Sequence[np.ndarray | None]
    advantages: Sequence[float]
    strands: Sequence[float]
    used: np.ndarray
    home: np.ndarray | None

    @classmethod
    def read(
        cls,
        anchors: Sequence[Sequence[float]],
        advantages: Sequence[float] | None,
        second_anchors: Sequence[Sequence[float] | None] | None,
        second_strands: Sequence[float] | None,
        home: Sequence[float] | None,
    ) -> DrawnLines:
        """Return the lines that these options of a cable robot describe, or ModelError."""
        n, points = len(anchors), _check_anchors(anchors)
        stated = None if home is None else _read_point("home", home)
        flat = len(anchors[0]) == 2 and (stated is None or not stated[2])
        used = np.flatnonzero([True, True, False]) if flat else _find_axes(points, stated)
        ends = _check_second_anchors(n, used, second_anchors, second_strands)
        advantages, strands = advantages or (1.0,) * n, second_strands or (1.0,) * n
        if len(advantages) != n:
            raise ModelError(f"{len(advantages)} advantages for {n} anchors, expected one for each")
        if not all(value > 0 for value in advantages):
            raise ModelError(f"advantages {list(advantages)}, expected numbers above 0")
        return cls(points, ends, advantages, strands, used, stated)

    @property
    def axes(self) -> tuple[str, ...]:
        """The coordinates in which the point moves, by name."""
        return tuple("xyz"[axis] for axis in self.used)

    @property
    def shares(self) -> np.ndarray:
        """The strands to the second anchor over the advantage (n,)."""
        return np.divide(self.strands, self.advantages)

    def parameters(self, gears: Sequence[float]) -> list[Parameter]:
        """Make the parameters of all lines; `gears` are those of their motors, if they have any."""
        table = list[Parameter]()
        for i, end in enumerate(self.ends):
            name = f"line{i + 1}."
            offset = "error of the line's length at reading zero"
            table += self._point(f"{name}A", "anchor", self.anchors[i])
            table.append(Parameter(f"{name}offset", "m", 0.0, 5 * MM, "offset", label=offset))
            if gears:
                table.append(_counted(f"{name}gear", gears[i], "gear ratio"))
            advantage = self.advantages[i]
            table.append(_counted(f"{name}advantage", advantage, "pulley's mechanical advantage"))
            if end is not None:
                strands = self.strands[i]
                table += self._point(f"{name}E", "second anchor", end)
                table.append(_counted(f"{name}strands", strands, "strands to the second anchor"))
        return table

    def _point(self, name: str, label: str, point: np.ndarray) -> list[Parameter]:
        return [
            Parameter(f"{name}_{axis}", "m", float(v), 20 * MM, "anchor", label=f"{label}'s {axis}")
            for axis, v in zip(self.axes, point[self.used], strict=True)
        ]

    def find_home(self) -> np.ndarray:
        """Return the stated home, or else the first of some points that the lines can hold.

        ModelError if they hold none.
        """
        n, freedoms = len(self.anchors), len(self.used)
        if n < freedoms:
            raise ModelError(
                f"{n} anchors given, expected at least 3 points [x, y, z] in m, or at least 2 "
                "points [x, y] of a planar robot"
            )
        every = np.array([*self.anchors, *(end for end in self.ends if end is not None)])
        middle, down = np.round(every.mean(axis=0), 3), np.zeros(3)
        down[self.used[-1]] = np.round(np.ptp(every, axis=0).max() / 2, 3)
        places = [np.zeros(3), middle, middle - down] if self.home is None else [self.home]
        for place in places:
            if self.count_directions(place) == freedoms:
                return place
        where = "at the origin" if self.home is None else f"at home {self.home.tolist()}"
        if np.min(np.linalg.norm(every - places[0], axis=1)) < MIN_LENGTH:
            raise ModelError(f"an anchor is {where}: its line has no length there")
        raise ModelError(
            f"the lines from the anchors {self.anchors.tolist()} do not hold the point {where}: "
            f"they pull along {self.count_directions(places[0])} of {freedoms} independent "
            "directions; expected anchors at different points that are not on one line (in space, "
            "in one plane) with home"
        )

    def directions(self, place: np.ndarray) -> np.ndarray:
        """Return by how much each line is longer per metre of motion (n, freedoms); NaN if the
        place is an anchor."""
        rows = []
        for anchor, end, share in zip(self.anchors, self.ends, self.shares, strict=True):
            row = _unit(place - anchor)
            rows.append(row if end is None else row + share * _unit(place - end))
        return np.array(rows)[:, self.used]

    def count_directions(self, place: np.ndarray) -> int:
        """Count the independent directions in which the lines pull; 0 at an anchor."""
        rows = self.directions(place)
        if not np.isfinite(rows).all():
            return 0
        return int(np.linalg.matrix_rank(rows, tol=1e-6))

    def find_independent(self) -> list[int]:
        """Return the first lines whose spheres meet in one point, or in two if there are no more
        lines than freedoms (by their numbers)."""
        centres = self.anchors.copy()
        for i, end in enumerate(self.ends):
            if end is not None:
                centres[i] += self.shares[i] / (1 + self.shares[i]) * (end - centres[i])
        found = list[int]()
        for i in range(len(centres)):
            apart = centres[[*found[1:], i]] - centres[found[0]] if found else np.eye(3)
            sizes = np.linalg.svd(apart[:, self.used], compute_uv=False)
            if sizes[min(len(apart), len(self.used)) - 1] > 0.05 * sizes[0]:
                found.append(i)
            if len(found) > len(self.used):
                break
        return found

    def find_gravity(self, home: np.ndarray) -> tuple[float, float, float] | None:
        """Return the gravity (m/s^2) along y that keeps both lines of a planar robot taut at home;
        None if neither direction does."""
        tensions = -np.linalg.solve(self.directions(home).T, np.array([0.0, 1.0]))
        if (tensions >= 0).all():
            return (0.0, -9.81, 0.0)
        return (0.0, 9.81, 0.0) if (tensions <= 0).all() else None


@dataclass(frozen=True)
class Motors:
    """Motors that turn the spools: for each line the number of its spool, the radius (m) of the
    spool, and the turns of the motor per turn of the spool."""

    spools: tuple[int, ...]
    radii: Sequence[float]
    gears: Sequence[float]

    @classmethod
    def read(
        cls,
        n: int,
        spools: Sequence[int] | None,
        radius: float | Sequence[float] | None,
        gear: float | Sequence[float] | None,
    ) -> Motors | None:
        """Return the motors of n lines, None if no option states one, or ModelError."""
        if all(option is None for option in (spools, radius, gear)):
            return None
        radii, gears = _numbers("radius", radius, RADIUS, n), _numbers("gear", gear, GEAR, n)
        own = tuple(spools or range(1, n + 1))
        if len(own) != n:
            raise ModelError(f"{len(own)} spools for {n} anchors, expected one for each")
        return cls(own, radii, gears)

    def parameters(self) -> list[Parameter]:
        """Make the parameters of the spools: the radius of each."""
        radii = {k: self.radii[self.spools.index(k)] for k in sorted({*self.spools})}
        return [
            Parameter(f"spool{k}.R", "m", size, 1 * MM, "spool", low=0, label="radius")
            for k, size in radii.items()
        ]


def _counted(name: str, value: float, label: str) -> Parameter:
    """Make a parameter that is counted, not measured."""
    return Parameter(name, "1", float(value), 1e-3, "drive", low=0, label=label)


def _numbers(name: str, given: Any, default: float, n: int) -> list[float]:
    """Return n numbers above 0, given as one or as n of them."""
    try:
        values = np.broadcast_to(np.array(default if given is None else given, float), n)
    except (TypeError, ValueError):
        raise ModelError(f"{name} {given!r}: expected a number, or {n} of them") from None
    if not (values > 0).all():
        raise ModelError(f"{name} {given!r}: expected numbers above 0")
    return [float(value) for value in values]


def _check_anchors(anchors: Sequence[Any]) -> np.ndarray:
    """Return the anchors (n, 3) m, or ModelError."""
    if {len(point) for point in anchors} not in ({2}, {3}):
        raise ModelError(f"anchors {list(anchors)}: expected points [x, y, z], or all [x, y], in m")
    points = np.zeros((len(anchors), 3))
    points[:, : len(anchors[0])] = np.array(anchors, dtype=float)
    return points


def _find_axes(points: np.ndarray, home: np.ndarray | None) -> np.ndarray:
    """Return the coordinates (indices) in which the point moves, or ModelError."""
    n, every = len(points), points if home is None else np.vstack([points, home])
    used = np.flatnonzero(every.any(axis=0))
    if len(used) < 2:
        raise ModelError(
            f"the {n} anchors {points.tolist()} are collinear with the origin: expected anchors "
            "that span a plane or space; state those in a plane as [x, y], or state a point that "
            "the lines hold as the option home"
        )
    return used


def _check_second_anchors(
    n: int,
    used: np.ndarray,
    given: Sequence[Sequence[float] | None] | None,
    strands: Sequence[float] | None,
) -> list[np.ndarray | None]:
    """Return the second anchor (3,) m of each line, None of a line without one, or ModelError."""
    for name, values in (("second_anchors", given), ("second_strands", strands)):
        if values is not None and len(values) != n:
            raise ModelError(f"{len(values)} {name} for {n} anchors, expected one for each")
    if strands is not None and not all(value > 0 for value in strands):
        raise ModelError(f"second_strands {list(strands)}, expected numbers above 0")
    ends = [
        None if end is None else _read_point("second anchor", end) for end in given or [None] * n
    ]
    for end in ends:
        if end is not None and np.delete(end, used).any():
            raise ModelError(
                f"second anchor {end.tolist()} is outside the plane of the anchors, which the "
                "lines of a planar robot do not leave"
            )
    return ends


def _read_point(name: str, given: Sequence[float]) -> np.ndarray:
    """Return a point (3,) m that is given as [x, y, z] or [x, y], or ModelError."""
    point = np.zeros(3)
    if len(given) not in (2, 3):
        raise ModelError(f"{name} {list(given)}: expected [x, y, z] or [x, y], in m")
    point[: len(given)] = np.array(given, dtype=float)
    return point


def _unit(vector: np.ndarray) -> np.ndarray:
    size = float(np.linalg.norm(vector))
    return vector / size if size > MIN_LENGTH else np.full(3, np.nan)
