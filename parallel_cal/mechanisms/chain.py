"""Any closed chain of bodies, joints and loops, described in the options of the model file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np

from parallel_cal.base.errors import ModelError, OpenLoopsError
from parallel_cal.base.rotation import exponential, matrix_to_quaternion, quaternion_to_matrix
from parallel_cal.base.units import DEGREE
from parallel_cal.mechanisms._chain_bodies import (
    SHIFTS,
    TURNS,
    Pose,
    Row,
    Skeleton,
    invert,
    multiply,
    rotation_rows,
    with_lengths,
)
from parallel_cal.mechanisms._chain_drawing import draw
from parallel_cal.mechanisms._chain_rank import CLOSED, TRIES, Motion, Survey, find_controls
from parallel_cal.mechanisms._chain_reading import (
    Entry,
    Frame,
    Joint,
    Loop,
    read_coordinates,
    read_joints,
    read_loops,
    read_masses,
)
from parallel_cal.model.configuration import Configuration
from parallel_cal.model.drawing import Line
from parallel_cal.model.mechanism import POSE, Home, Mechanism, Workspace
from parallel_cal.model.parameters import Named, ParameterTable

PLATFORM = "the platform"  # owner of the rows that join it to the tree
PLACES = {"position", "quaternion", "rpy"}
EXAMPLE = "{name: hip, type: revolute, parent: base, child: leg, axis: [0, 0, 1], driven: true}"
PREFERENCE = {"zero": 4.0, "length": 4.0} | dict.fromkeys(SHIFTS, 1.0) | dict.fromkeys(TURNS, 0.5)
SHARE_OF_LIMITS = 0.3  # of the range of a joint, for the motion around home
N_AROUND = 12  # configurations near home that show the motion
MAX_ROUNDED_M = 1e-6  # of redundant loops that stay open because the file states few digits
# Of lengths, by which redundant loops of a real robot may be open. Of a spherical wrist, true
# solutions are open by 2, and other extrema of the squares by more than 20.
MAX_OPEN_TOLERANCES = 10.0
MIN_REGULARITY = 0.05  # of that around home: of less, home is singular


class Chain(Mechanism):
    """Chain of bodies with any joints and closed loops.

    Options: `base`, `platform` and `joints` are needed. All vectors are in m and rad; see
    docs/chains.md for each key.

    - `base`: the body that carries {B}, which is the frame of this body; `platform`: the body that
      carries {P}, at `target` (and turned by `target_quaternion` or `target_rpy`) in its frame.
    - `joints`: list of joints. Each one has `name`, `type` (revolute, prismatic, universal,
      spherical, cylindrical, planar or fixed), `parent` and `child` (names of bodies), `origin` and
      `quaternion` (or `rpy`): frame of the child in that of the parent at value 0; `anchor`: point
      of the joint in the frame of the child; `axis` (`axes` of a universal joint); `driven`:
      whether a reading moves it; `home`, `limits`, and `zero`: its value where the reading is 0. A
      joint between two bodies that are already joined closes a loop.
    - `loops`: list of conditions between two bodies. Each one has `name`, `type` (point, axis, pose
      or distance), and its ends `a` and `b`: `body`, `point` and, if necessary, `axis` or
      `quaternion`. A distance is a rod with two balls: `length`, and `driven`, `home` and `limits`
      if it is an actuator.
    - `moves`, `controls`: coordinates of the platform. Default: found by rank, and those that
      determine the platform best over the range of the joints.
    - `home`: `position` and `quaternion` of {P} near which the loops close. Default: that of the
      joints at home.
    - `workspace`: `low` and `high` of the controlled coordinates. Default: around home.
    - `masses`: bodies with `mass` (kg) and `centre` (m, in their frame); parts of a rod or an
      actuator with `mass`, `rod` (name of the loop), `end` (a or b), and `distance` (m) from there.
    - `gravity`, `length_tolerance`, `angle_tolerance` (1 sigma of the geometry, m and rad).
    """

    def __init__(
        self,
        base: str,
        platform: str,
        joints: Sequence[Mapping[str, Any]],
        loops: Sequence[Mapping[str, Any]] = (),
        target: Sequence[float] = (0.0, 0.0, 0.0),
        target_quaternion: Sequence[float] | None = None,
        target_rpy: Sequence[float] | None = None,
        moves: Sequence[str] | None = None,
        controls: Sequence[str] | None = None,
        home: Mapping[str, Any] | None = None,
        workspace: Mapping[str, Any] | None = None,
        masses: Mapping[str, Any] | None = None,
        gravity: Sequence[float] = (0.0, 0.0, -9.81),
        length_tolerance: float = 0.5e-3,
        angle_tolerance: float = 0.5 * DEGREE,
    ):
        given = {"target": target}
        for key, value in (("quaternion", target_quaternion), ("rpy", target_rpy)):
            given |= {} if value is None else {f"target_{key}": value}
        entry = Entry("options", given, {"target", "target_quaternion", "target_rpy"})
        self.target = Frame(
            entry.vector("target"), entry.rotation("target_quaternion", "target_rpy")
        )
        self.skeleton = Skeleton.of(base, platform, read_joints(joints), read_loops(loops))
        if not self.skeleton.driven:
            raise ModelError(
                f"no joint is driven, expected driven: true of some, such as {EXAMPLE}"
            )
        self.held: dict[str, float] = {}  # idle passive coordinates, at home
        guess = self._guess(home)
        self.skeleton = self._measure_rods(guess)
        self._set_joints()
        x, y, z = Entry("options", {"gravity": gravity}, {"gravity"}).vector("gravity").tolist()
        self.gravity = (x, y, z)
        self.masses, self._centres = read_masses(
            masses,
            self.skeleton.bodies,
            [loop.name for loop in self.skeleton.loops if loop.type == "distance"],
        )
        self.parts = tuple(self.masses)
        self._length_tolerance = float(length_tolerance)
        tolerance = {"m": self._length_tolerance, "rad": float(angle_tolerance)}
        self.parameters = ParameterTable(self.skeleton.parameters(self._target_rows(), tolerance))
        self._combine: np.ndarray | None = None
        self._by_least_squares, self._chose_controls = False, False
        self._open: float | None = None  # m; redundant loops that are stated with few digits
        self._analyse(guess, moves, controls, workspace)
        self.bodies = {"links": [p.name for p in self.parameters if p.unit == "m"]}

    # ------------------------------------------------------------------ what the options state

    def _set_joints(self) -> None:
        """Set names, units and limits of the driven joints, and names of passive coordinates."""
        driven = self.skeleton.driven
        self.joints = tuple(part.name for part in driven)
        self._joint_units = tuple(
            "m" if isinstance(part, Loop) else part.units[0] for part in driven
        )
        self.joint_limits = tuple(part.limits for part in driven)
        free = [one for one in self.skeleton.passive if one[0] not in self.held]
        self.passive = tuple(name for name, _, _ in free)
        self._passive_units = tuple(unit for _, unit, _ in free)

    @property
    def joint_units(self) -> tuple[str, ...]:
        return self._joint_units

    @property
    def passive_units(self) -> tuple[str, ...]:
        return self._passive_units

    def _target_rows(self) -> list[tuple[str, str, float, str]]:
        shifts = zip(SHIFTS, self.target.position, strict=True)
        rows = [(f"target.{axis}", "m", float(v), "place of the target") for axis, v in shifts]
        return rows + [(f"target.{axis}", "rad", 0.0, "turn of the target") for axis in TURNS]

    def _guess(self, home: Mapping[str, Any] | None) -> np.ndarray:
        """Return a configuration (q, r, R9, u) near home, which need not close."""
        q = [
            part.home[0] if isinstance(part, Joint) else part.home for part in self.skeleton.driven
        ]
        u = [value for _, _, value in self.skeleton.passive]
        r, R = np.zeros(3), np.eye(3)
        if home is not None:
            entry = Entry("home", home, PLACES)
            r, R = entry.vector("position", (0.0, 0.0, 0.0)), entry.rotation()
        elif not self.skeleton.floats:
            r, R = self._place(np.array(q), np.array(u))
        return Configuration(np.array(q), r, R, np.array(u)).rows

    def _place(self, q: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the pose of {P} that the nominal tree gives."""
        table = ParameterTable(
            self.skeleton.parameters(self._target_rows(), {"m": 1.0, "rad": 1.0})
        )
        p = Named(table.names, ca.DM(table.nominal))
        values = self._values(ca.DM(q), ca.DM(u), p)
        frames = self.skeleton.frames(values, p, (ca.DM.zeros(3), ca.DM.eye(3)))
        r, R = multiply(frames[self.skeleton.platform], self._target(p))
        return np.array(ca.DM(r)).ravel(), np.array(ca.DM(R))

    def _measure_rods(self, guess: np.ndarray) -> Skeleton:
        """Return the skeleton in which rods without a stated length have that of home."""
        missing = [k for k in self.skeleton.loops if k.type == "distance" and k.length is None]
        if not missing:
            return self.skeleton
        table = ParameterTable(
            self.skeleton.parameters(self._target_rows(), {"m": 1.0, "rad": 1.0})
        )
        p = Named(table.names, ca.DM(table.nominal))
        x = Configuration.from_rows(guess, len(self.skeleton.passive))
        frames = self._frames(ca.DM(x.q), ca.DM(x.u), ca.DM(x.r), ca.DM(x.R), p)
        lengths = {}
        for loop in missing:
            a, b = (np.array(ca.DM(e)) for e in self.skeleton.rod_ends(loop, frames, p))
            lengths[loop.name] = float(np.linalg.norm(b - a)) - loop.home
            if not lengths[loop.name] > 0:
                raise ModelError(
                    f"loop '{loop.name}': both ends coincide at home, state its length"
                )
        return with_lengths(self.skeleton, lengths)

    # ------------------------------------------------------------------ the closure

    def closure(self, *args: Any, **kwargs: Any) -> Any:
        """Compute what is open of the loops, and the platform's distance from the tree (m, rad)."""
        q, *passive, r, R, p = args
        u = passive[0] if passive else ca.SX(0, 1)
        if self._by_least_squares:
            return self._normal_equations(q, r, R, u, p.column)
        rows = ca.vertcat(*[row.value for row in self._rows(q, u, r, R, p)])
        if self._combine is None:
            return rows
        plain = np.count_nonzero(self._combine, axis=1) == 1
        found = []
        for k, weights in enumerate(self._combine):
            used = np.flatnonzero(weights)
            if plain[k]:
                found.append(rows[int(used[0])])
            else:  # rows of different units are combined in metres
                scaled = ca.DM(weights[used] * self._row_scale[used])
                found.append(ca.dot(scaled, rows[used.tolist()]))
        return ca.vertcat(*found)

    def overstretch(self, *args: Any, **kwargs: Any) -> Any:
        """Compute by how much redundant loops are more open than the tolerances explain, m.

        The normal equations are zero at the maxima of the squares, too.
        """
        if not self._by_least_squares:
            return None
        q, *passive, r, R, p = args
        rows = self._rows(q, passive[0] if passive else ca.SX(0, 1), r, R, p)
        scale = self._row_scale.tolist()
        gap = ca.norm_2(ca.vertcat(*[k * row.value for k, row in zip(scale, rows, strict=True)]))
        return ca.fmax(0, gap - MAX_OPEN_TOLERANCES * self._length_tolerance)

    @cached_property
    def _normal_equations(self) -> ca.Function:
        """Build the conditions, as a function of (q, r, R, u, geometry), that the sum of the
        squares of all rows (m^2; angles times `length`) is least.

        They are the derivatives of half this sum by the unknown coordinates, in m, if angles are
        counted times `length`. Where the loops can close, they are zero where the loops are closed.
        """
        q, u = ca.SX.sym("q", len(self.joints)), ca.SX.sym("u", len(self.passive))
        r, R, w = ca.SX.sym("r", 3), ca.SX.sym("R", 3, 3), ca.SX.sym("w", 3)
        v = ca.SX.sym("v", len(self.parameters))
        p = Named(self.parameters.names, v)
        rows = ca.vertcat(*[x.value for x in self._rows(q, u, r, R + ca.skew(w) @ R, p)])
        rows *= ca.DM(self._row_scale)
        unknown = ca.vertcat(ca.vertcat(r, w)[self.moved], u)
        half = ca.sumsqr(rows) / 2
        units = [*(["m"] * 3 + ["rad"] * 3), *self.passive_units]
        used = [units[i] for i in [*self.moved, *range(6, len(units))]]
        scale = ca.DM([self.length if unit == "rad" else 1.0 for unit in used])
        normal = ca.substitute(ca.gradient(half, unknown) / scale, w, ca.DM.zeros(3))
        return ca.Function("normal", [q, r, R, u, v], [normal])

    def _rows(self, q: Any, u: Any, r: Any, R: Any, p: Named) -> list[Row]:
        """Return the rows of the moved coordinates of a platform in the tree, and of all loops."""
        values = self._values(q, u, p)
        frames = self._frames(q, u, r, R, p)
        rows = []
        if not self.skeleton.floats:
            at, turned = multiply(frames[self.skeleton.platform], self._target(p))
            apart = [*ca.vertsplit(ca.SX(r - at)), *rotation_rows(ca.SX(turned), ca.SX(R))]
            names = zip(POSE, "m m m rad rad rad".split(), apart, strict=True)
            rows = [Row(PLATFORM, unit, v) for name, unit, v in names if name in self.moves]
        return rows + self.skeleton.rows(frames, values, p)

    def _values(self, q: Any, u: Any, p: Named) -> dict[str, Any]:
        """Return the value of every coordinate by its name; idle ones are held."""
        values: dict[str, Any] = dict(self.held)
        for i, part in enumerate(self.skeleton.driven):
            values[part.name] = q[i] + p[part.name].zero if isinstance(part, Joint) else q[i]
        free = [name for name, _, _ in self.skeleton.passive if name not in self.held]
        return values | {name: u[k] for k, name in enumerate(free)}

    def _target(self, p: Named) -> Pose:
        """Compute {P} in the frame of its body."""
        turn = ca.DM(self.target.rotation) @ exponential(p.target.vector(*TURNS))
        return p.target.vector(*SHIFTS), turn

    def _frames(self, q: Any, u: Any, r: Any, R: Any, p: Named) -> dict[str, Pose]:
        """Compute the frame of every body in {B}."""
        platform = multiply((r, R), invert(self._target(p)))
        return self.skeleton.frames(self._values(q, u, p), p, platform)

    # ------------------------------------------------------------------ found by rank

    def _survey(self) -> Survey:
        """Return the rows, with all six coordinates of the platform, as functions of numbers."""
        q, u = ca.SX.sym("q", len(self.joints)), ca.SX.sym("u", len(self.passive))
        r, R9, w = ca.SX.sym("r", 3), ca.SX.sym("R", 9), ca.SX.sym("w", 3)
        R, v = ca.reshape(R9, 3, 3).T, ca.SX.sym("v", len(self.parameters))
        p = Named(self.parameters.names, v)
        found = self._rows(q, u, r, R + ca.skew(w) @ R, p)
        rows = ca.vertcat(*[row.value for row in found])
        J = ca.substitute(ca.jacobian(rows, ca.vertcat(q, r, w, u)), w, ca.DM.zeros(3))
        J_p = ca.substitute(ca.jacobian(rows, v), w, ca.DM.zeros(3))
        rows = ca.substitute(rows, w, ca.DM.zeros(3))
        x = ca.vertcat(q, r, R9, u)
        f = ca.Function("rows", [x, v], [rows, ca.densify(J), ca.densify(J_p)])
        units = [*self.joint_units, *["m"] * 3, *["rad"] * 3, *self.passive_units]
        return Survey(
            f,
            self.parameters.nominal,
            np.array([self.length if row.unit == "rad" else 1.0 for row in found]),
            np.array([self.length if unit == "rad" else 1.0 for unit in units]),
            len(self.joints),
            len(self.passive),
            self.length,
            CLOSED * self.length if self._open is None else MAX_ROUNDED_M,
        )

    def _explore(self, home: np.ndarray) -> tuple[Survey, np.ndarray]:
        """Return closed configurations around home, and the survey that found them.

        Redundant loops whose geometry is stated with few digits may close at home and nowhere else,
        or along few motions. They count as closed where more is closed so, or moves more freely.
        """
        survey = self._survey()
        x = survey.around(home, N_AROUND, self._spread())
        rounded = replace(survey, closed=MAX_ROUNDED_M)
        freer = rounded.compute_rank(home) < survey.compute_rank(home)
        if self._open is not None or (len(x) == N_AROUND and not freer):
            return survey, x
        more = rounded.around(home, N_AROUND, self._spread())
        if len(more) < len(x) + (not freer):
            return survey, x
        self._open = max(float(np.abs(rounded.evaluate(one)[0]).max()) for one in more)
        return rounded, more

    def _analyse(
        self,
        guess: np.ndarray,
        moves: Sequence[str] | None,
        controls: Sequence[str] | None,
        workspace: Mapping[str, Any] | None,
    ) -> None:
        """Close the loops at home, and find freedoms, independent rows and parameters."""
        stated = None if moves is None else read_coordinates("moves", moves)
        self.moves, self.length = tuple(stated or POSE), self._find_length(guess)
        home = self._close_at_home(self._survey(), guess)
        home = self._hold_idle(home)
        survey, x = self._explore(home)
        motion = Motion.of(survey, x, self.moved)
        if stated is None:
            loops = [k for k, owner in enumerate(self._owners()) if owner != PLATFORM]
            self.moves = tuple(POSE[i] for i in motion.find_moves(loops))
        if (loose := motion.find_loose()).size:
            first = len(self.joints) + len(POSE)
            most = self.passive[int(np.argmax(np.abs(loose[first:, 0])))] if self.passive else ""
            locked = f"; if {most}, which moves most, rests in the robot, lock it" if most else ""
            raise ModelError(
                f"with all driven joints locked ({', '.join(self.joints)}), the chain can still "
                f"move in {loose.shape[1]} of its {motion.freedoms} freedoms; drive more joints, "
                f"or join more bodies{locked}"
            )
        regular = motion.regularity
        if regular[0] < MIN_REGULARITY * regular.max():
            raise self._other_home(
                survey.climb(home, self.moved, np.array(self.joint_limits), self._spread()),
                "the chain is singular at home: two assembly modes meet there. It is regular at",
                singular=True,
            )
        if controls is not None:
            self.controls = tuple(read_coordinates("controls", controls))
        elif motion.independent == len(self.moves):
            self.controls = self.moves
        else:
            self._choose_controls(survey, home, motion.independent)
        self._set_home(x, stated is not None)
        self._set_workspace(x, workspace)
        self._choose_rows_and_parameters(home)

    def _close_at_home(self, survey: Survey, guess: np.ndarray) -> np.ndarray:
        """Close the loops with the driven joints at home. Where they cannot, OpenLoopsError states
        a home next to it at which they do."""
        n, every = len(self.joints), list(range(len(survey.scale)))
        limits = np.array(self.joint_limits)
        x, left = survey.close_near(guess, every[n:], limits)
        if np.linalg.norm(left) < CLOSED * self.length:
            return x
        if np.linalg.norm(left) < MAX_ROUNDED_M:
            self._open = float(np.abs(left).max())
            return x
        open_at_home = self._describe_open(left)
        x, left = survey.close_near(guess, every, limits)
        if np.linalg.norm(left) < CLOSED * self.length:
            x = survey.climb(x, self.moved, limits, self._spread())
            raise self._other_home(
                x,
                f"the loops do not close at home: {open_at_home} with the driven joints at their "
                "home. They close at",
            )
        raise OpenLoopsError(
            f"the loops do not close at home: {open_at_home} with the driven joints at their home, "
            f"and {self._describe_open(left)} if these may move, too, from {TRIES} starts. "
            "Correct the home of joints and platform, the geometry, or a joint or loop whose type "
            "is too stiff"
        )

    def _other_home(self, x: np.ndarray, problem: str, singular: bool = False) -> OpenLoopsError:
        """Make the error that states another home, after a problem with the stated one."""
        at = Configuration.from_rows(x, len(self.passive))
        values = dict(zip([*self.joints, *self.passive], [*at.q, *at.u], strict=True))
        units = [*self.joint_units, *self.passive_units]
        words = ", ".join(
            f"{name} {value:.6g} {unit}"
            for (name, value), unit in zip(values.items(), units, strict=True)
        )
        return OpenLoopsError(
            f"{problem} {words}: state these as the home of the joints",
            values,
            at.r.tolist(),
            matrix_to_quaternion(at.R).tolist(),
            singular,
        )

    def _describe_open(self, left: np.ndarray) -> str:
        """Say which loop is widest open, from the rows in metres."""
        worst = int(np.argmax(np.abs(left)))
        return f"'{self._owners()[worst]}' stays {1e3 * abs(left[worst]):.3g} mm open"

    def _owners(self) -> list[str]:
        p = Named(self.parameters.names, ca.DM(self.parameters.nominal))
        q, u = ca.DM.zeros(len(self.joints)), ca.DM.zeros(len(self.passive))
        return [row.owner for row in self._rows(q, u, ca.DM.zeros(3), ca.DM.eye(3), p)]

    def _hold_idle(self, home: np.ndarray) -> np.ndarray:
        """Hold passive coordinates that nothing determines, and return home without them.

        They rest where the description draws them, not where a search for closed loops left them:
        a guide that does not spin is written into a file as it was read.
        """
        survey = self._survey()
        x = survey.around(home, 3, self._spread())
        first, n = len(self.joints) + 6, len(self.joints) + 12
        idle = [c - first for c in Motion.of(survey, x, self.moved).find_idle()]
        drawn = {name: value for name, _, value in self.skeleton.passive}
        rest = np.delete(home, [n + k for k in idle])
        found = {self.passive[k]: float(home[n + k]) for k in idle}
        self.held = {name: drawn[name] for name in found}
        self._set_joints()
        moved = self._survey()
        x, left = moved.close(rest, range(len(self.joints), len(moved.scale)))
        if np.linalg.norm(left) < moved.closed:
            return x
        self.held = found
        return rest

    def _spread(self) -> np.ndarray:
        """How far the joints are moved around home (nq,), rad or m."""
        return SHARE_OF_LIMITS * self.joint_ranges

    def _find_length(self, guess: np.ndarray) -> float:
        """Return the characteristic length: 0.3 times the distance of the farthest joint from the
        base, at home."""
        p = Named(self.parameters.names, ca.DM(self.parameters.nominal))
        x = Configuration.from_rows(guess, len(self.passive))
        lines = self._lines(ca.DM(x.q), ca.DM(x.u), ca.DM(x.r), ca.DM(x.R), p)
        points = [np.array(ca.DM(point)).ravel() for line in lines for point in line.points]
        reach = max((float(np.linalg.norm(point)) for point in [*points, x.r]), default=0.0)
        return round(0.3 * reach, 6) or 0.1

    def _choose_controls(self, survey: Survey, home: np.ndarray, count: int) -> None:
        """Choose as many coordinates as the platform has motions, and make them an option, so that
        a model file states what its workspace is about."""
        paths = survey.walk(home, np.array(self.joint_limits))
        found = find_controls([Motion.of(survey, path, self.moved) for path in paths], count)
        self.controls = tuple(POSE[i] for i in found)
        self.options = {"controls": list(self.controls)}
        self._chose_controls = True

    def complete_workspace(self, workspace: Workspace) -> Workspace:
        """Return the workspace of a model file.

        Files of earlier releases do not state its coordinates. ModelError if they seem to be others
        than those that are chosen now.
        """
        home = np.array([*self.home.position, *self.home.rotation_vector])[self.controlled]
        inside = (np.array(workspace.low) <= home) & (home <= np.array(workspace.high))
        if self._chose_controls and not inside.all():
            raise ModelError(
                f"home, {', '.join(self.controls)} = {', '.join(f'{v:.4g}' for v in home)}, is "
                "outside, and the options do not state which coordinates these are, as those of an "
                "earlier release: state the controls in the options, such as controls: [x, y], or "
                "delete the workspace"
            )
        return workspace

    def _set_home(self, x: np.ndarray, stated: bool) -> None:
        """Set home. If the stated moves contain no turn of a platform that does turn, its
        orientation is none there."""
        home = Configuration.from_rows(x[0], len(self.passive))
        r, R = home.r, home.R
        if not self.skeleton.floats:
            at = Configuration.from_rows(x, len(self.passive))
            places = [self._place(q, u) for q, u in zip(at.q, at.u, strict=True)]
            r, R = places[0]
            turns = max(np.abs(other - R).max() for _, other in places) > 1e-6
            if stated and turns and not set(self.moves) & set(POSE[3:]):
                R = np.eye(3)
        parts = (home.q, r, matrix_to_quaternion(R), home.u)
        self.home = Home(*(tuple((np.round(part, 13) + 0.0).tolist()) for part in parts))

    def _set_workspace(self, x: np.ndarray, given: Mapping[str, Any] | None) -> None:
        """Set the workspace: the stated one, or half of where the joints around home lead."""
        if given is not None:
            entry, n = Entry("workspace", given, {"low", "high"}), len(self.controls)
            low, high = (entry.vector(key, size=n) for key in ("low", "high"))
            self.workspace = Workspace(tuple(low.tolist()), tuple(high.tolist()))
            return
        at = Configuration.from_rows(x, len(self.passive))
        home = np.array([*self.home.position, *self.home.rotation_vector])[self.controlled]
        turned = at.R @ at.R[0].T @ quaternion_to_matrix(self.home.quaternion)
        self.workspace = Workspace(tuple(home - 1.0), tuple(home + 1.0))
        reached = self.controlled_coordinates(at.r, turned)
        half = 0.5 * np.abs(reached - home).max(axis=0)
        low, high = (np.round(home + sign * half, 6).tolist() for sign in (-1, 1))
        self.workspace = Workspace(tuple(low), tuple(high))

    def _choose_rows_and_parameters(self, home: np.ndarray) -> None:
        """Keep independent rows, hold parameters that others replace, and say so."""
        survey, count = self._survey(), len(self.parameters)
        x = survey.around(home, 8 + -(-2 * count // len(survey.row_scale)), self._spread())
        motion = Motion.of(survey, x, self.moved)
        self._row_scale = survey.row_scale
        combine = motion.find_rows()
        self._by_least_squares = combine is None
        passive = self.passive_columns
        tolerance = self.parameters.tolerance
        # Of equivalent parameters, prefer those that an owner can measure.
        own = [(p.name.startswith("target."), p.name.rpartition(".")[2]) for p in self.parameters]
        preference = np.array([0.25 if last else PREFERENCE.get(key, 2.0) for last, key in own])
        kept = motion.normal_rows if combine is None else combine
        replaced, unseen = motion.find_replaced(kept, tolerance, preference, passive)
        self._combine = combine
        self.fixed = tuple(
            name for name, held in zip(self.parameters.names, replaced, strict=True) if held
        )
        at_home = Motion.of(survey, home[None], self.moved)
        dead = at_home.is_dead_point(self.controlled)
        self.remarks = tuple(self._remarks(motion.freedoms, kept.shape[-2], replaced, unseen, dead))

    def _remarks(
        self, freedoms: int, kept: int, replaced: np.ndarray, unseen: np.ndarray, dead: bool
    ) -> list[str]:
        """Say what is held, and why; and whether joints are driven that cannot move alone."""
        names, found = np.array(self.parameters.names), list[str]()
        rows = len(self._row_scale)
        if freedoms < len(self.joints):
            found.append(
                f"{len(self.joints)} joints are driven, but the chain has {freedoms} freedoms: not "
                "all readings are possible, and those that are not are fitted by least squares. If "
                "the robot moves more freely, a joint or a loop of the description is too stiff"
            )
        if dead:
            found.append(
                "home is at a dead point: two sets of readings have the same pose near it. inverse "
                "answers with those on one side of it: home's, or, if home is on neither side, "
                "that where the joint has more room. State a home on the side that you want"
            )
        if self._by_least_squares:
            found.append(
                f"{rows - kept} of {rows} rows of the loops depend on the others at every pose, as "
                "those of hinges do that point at one centre: the robot is where the sum of the "
                "squares of all is least"
            )
        elif kept < rows:
            found.append(
                f"{rows - kept} of {rows} rows of the loops depend on the others, as those do that "
                "leave the plane of a plane mechanism: they are not used"
            )
        if self._open is not None:
            found.append(
                f"the loops stay up to {1e6 * self._open:.2g} um open: they are "
                "redundant, and the geometry is stated with few digits"
            )
        if unseen.any():
            found.append(f"fixed, because only such rows contain them: {_group(names[unseen])}")
        if (others := replaced & ~unseen).any():
            found.append(
                "fixed, because free parameters or passive joints replace them: "
                f"{_group(names[others])}"
            )
        if self.held:
            found.append(
                f"held at home, because they turn idly: {', '.join(self.held)} (nothing depends on "
                "them)"
            )
        return found

    # ------------------------------------------------------------------ for solvers and effects

    def candidates(self, q: Any, p: Named) -> list[tuple[Any, Any]]:
        """Evaluate the chain if it has no loop; otherwise home."""
        if self.skeleton.floats or self.passive or self.skeleton.loops or self.skeleton.cuts:
            return super().candidates(q, p)
        frames = self._frames(q, ca.SX(0, 1), ca.DM.zeros(3), ca.DM.eye(3), p)
        return [multiply(frames[self.skeleton.platform], self._target(p))]

    def rod_lengths(self, p: Named) -> list[Any]:
        """Return the lengths of the rods without reading."""
        return [
            p[k.name].length for k in self.skeleton.loops if k.type == "distance" and not k.driven
        ]

    def struts(self, r: Any, R: Any, p: Named) -> list[tuple[Any, Any]]:
        """Return both ends of the actuators if they alone carry the platform."""
        s, joints = self.skeleton, {part.name for part in self.skeleton.driven}
        ends = {s.base, s.platform}
        legs = [k for k in s.loops if k.driven and {k.a.body, k.b.body} == ends]
        if not s.floats or {k.name for k in legs} != joints or s.steps:
            return []
        frames = self._frames(ca.DM.zeros(len(joints)), ca.SX(0, 1), r, R, p)
        pairs = [(k, s.rod_ends(k, frames, p)) for k in legs]
        return [pair if k.a.body == s.base else pair[::-1] for k, pair in pairs]

    def centres(self, *args: Any, **kwargs: Any) -> Mapping[str, list[Any]]:
        """Return the centres of mass of the bodies, and the parts of rods, with a mass."""
        q, *passive, r, R, p = args
        frames = self._frames(q, passive[0] if passive else ca.SX(0, 1), r, R, p)
        rods = {loop.name: loop for loop in self.skeleton.loops}
        found = dict[str, list[Any]]()
        for part, centre in self._centres.items():
            if centre.end:
                ends = self.skeleton.rod_ends(rods[centre.owner], frames, p)
                near, far = ends if centre.end == "a" else ends[::-1]
                found[part] = [near + centre.distance * (far - near) / ca.norm_2(far - near)]
            else:
                at, turned = frames[centre.owner]
                found[part] = [at + turned @ ca.DM(centre.point)]
        return found

    def spans(self, q: Any, p: Named) -> list[tuple[float, Any, Any]]:
        """Return length and ends of the links of an arm without loops, from joint to joint."""
        s = self.skeleton
        if s.floats or self.passive or s.loops or s.cuts:
            return []
        points = self._joints_of_arm(q, p)
        nominal = Named(self.parameters.names, ca.DM(self.parameters.nominal))
        at_home = [
            np.array(ca.DM(v)) for v in self._joints_of_arm(ca.DM(self.home.joints), nominal)
        ]
        lengths = [float(np.linalg.norm(b - a)) for a, b in pairwise(at_home)]
        return [(n, *ends) for n, ends in zip(lengths, pairwise(points), strict=True)]

    def _joints_of_arm(self, q: Any, p: Named) -> list[Any]:
        """Compute the places of the joints between base and platform, and of {P}."""
        s = self.skeleton
        frames = self._frames(q, ca.SX(0, 1), ca.DM.zeros(3), ca.DM.eye(3), p)
        body, path = s.platform, [multiply(frames[s.platform], self._target(p))[0]]
        for step in reversed(s.steps):
            if step.reached == body:
                at, turned = frames[step.joint.child]
                path.append(at + turned @ ca.DM(step.joint.anchor))
                body = step.joint.parent if step.forward else step.joint.child
        return path[::-1]

    def drawing(self, *args: Any, **kwargs: Any) -> list[Line]:
        """Draw every body through its joints, the rods, and the axes of the joints."""
        q, *passive, r, R, p = args
        return self._lines(q, passive[0] if passive else ca.SX(0, 1), r, R, p)

    def _lines(self, q: Any, u: Any, r: Any, R: Any, p: Named) -> list[Line]:
        return draw(self.skeleton, self._frames(q, u, r, R, p), r, 0.2 * self.length, p)


def _group(names: Sequence[str]) -> str:
    """List names such as arm.x, arm.y, leg.z as `arm (x y), leg (z)`."""
    parts: dict[str, list[str]] = {}
    for name in names:
        owner, _, own = str(name).rpartition(".")
        parts.setdefault(owner, []).append(own)
    return ", ".join(f"{owner} ({' '.join(own)})" for owner, own in parts.items())
