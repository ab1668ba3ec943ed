"""The functions that follow from a model's closure and do not depend on its values."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from functools import cached_property, lru_cache
from typing import Any

import casadi as ca
import numpy as np

from parallel_cal.base.compiled import Batch, dense
from parallel_cal.base.errors import ModelError, wrap_plugin_error
from parallel_cal.base.rotation import left_generators
from parallel_cal.model.declaration import check_parameters
from parallel_cal.model.drawing import Line
from parallel_cal.model.effect import CONDITIONS, Effect, Seen
from parallel_cal.model.machine_class import scale_usual_sizes
from parallel_cal.model.mechanism import Mechanism
from parallel_cal.model.parameters import Named, Parameter, ParameterTable
from parallel_cal.model.sample_rows import SampleRows
from parallel_cal.model.sensor import Sensor, apply_sensor_tolerances
from parallel_cal.model.shelf import load_effect

MIN_SAMPLES_TO_COMPILE = 50_000  # samples after which compiling, a second or two, has paid


class Structure:
    """The symbolic part of a model, without values; shared and cached.

    Symbols: q joints, r position, R9 rotation (row-major), u passive coordinates, v parameter
    vector, a conditions.
    """

    def __init__(
        self, mechanism: Mechanism, effects: Sequence[Effect], sensors: Sequence[Sensor] = ()
    ):
        # A copy: whoever changes the mechanism does not change the models that share this.
        self.mechanism, self.content = copy(mechanism), mechanism.content
        self.effects = tuple(effects)
        self.sensors = tuple(sensors)
        self.table = ParameterTable(mechanism.parameters)
        tables = [
            apply_sensor_tolerances(sensors, part.table(mechanism), mechanism) for part in effects
        ]
        for table in (*tables, *(sensor.table(mechanism) for sensor in sensors)):
            self.table = self.table + table
        check_parameters(self.table)
        needed = [c for effect in effects for c in effect.conditions(mechanism)]
        self.conditions = tuple(dict.fromkeys(needed))
        self.q = ca.SX.sym("q", len(mechanism.joints))
        self.r, self.R9 = ca.SX.sym("r", 3), ca.SX.sym("R", 9)
        self.u = ca.SX.sym("u", len(mechanism.passive))
        self.v = ca.SX.sym("v", len(self.table))
        self.a = ca.SX.sym("a", len(self.conditions))

    @lru_cache(maxsize=64)  # noqa: B019  (lives as long as the structure, which is cached itself)
    def table_of(
        self, machine_class: str, tolerances: tuple[tuple[str, float], ...]
    ) -> ParameterTable:
        """Return the table with the usual sizes of a class of machines, and with own tolerances."""
        scaled: dict[str, Parameter] = {}
        for effect in self.effects:
            own = ParameterTable(p for p in self.table if p.name.startswith(f"{effect.name}."))
            scaled |= {p.name: p for p in scale_usual_sizes(effect, own, machine_class)}
        table = ParameterTable(scaled.get(p.name, p) for p in self.table)
        return table.with_tolerances(dict(tolerances))

    @cached_property
    def neutral(self) -> list[float]:
        """The neutral value of each condition: effects do nothing, or nothing is known."""
        return [CONDITIONS[name.split(".")[0]][1] for name in self.conditions]

    @property
    def R(self) -> Any:
        return ca.reshape(self.R9, 3, 3).T

    @property
    def configuration(self) -> Any:
        """(q, r, R9, u) as one column: the coordinates of the closure."""
        return ca.vertcat(self.q, self.r, self.R9, self.u)

    @cached_property
    def seen(self) -> Seen:
        """Joints, pose and geometry after the effects."""
        seen = Seen(self.q, self.r, self.R, self.geometry, self.u)
        numbers, at = Named(self.table.names, self.v), Named(self.conditions, self.a)
        for effect in self.effects:
            seen = self._apply_effect(effect, seen, numbers, at)
        return seen

    def _apply_effect(self, effect: Effect, seen: Seen, numbers: Named, at: Named) -> Seen:
        """Apply one effect and check its result."""
        try:
            ideal: Any = effect.ideal(seen, numbers[effect.name], at, self.mechanism)
            if not isinstance(ideal, Seen):
                raise ModelError(
                    f"ideal returns a {type(ideal).__name__}, expected the Seen that it was "
                    "given, with changes"
                )
            found = [ca.SX(part).shape for part in (ideal.q, ideal.r, ideal.R)]
            expected = [self.q.shape, (3, 1), (3, 3)]
            if found != expected:
                raise ModelError(f"ideal returns q, r, R of shapes {found}, expected {expected}")
        except Exception as error:
            raise wrap_plugin_error(effect.name, error) from error
        return ideal

    @cached_property
    def phi(self) -> Any:
        """The closure of the ideal mechanism, at its inputs after the effects."""
        seen = self.seen
        if self.effects or self.sensors:  # most of the work is the same for all of them
            return self._check_closure(self.ideal.closure_of_seen(_column(seen)))
        try:
            m = self.mechanism
            phi = m.closure(*m.arguments(seen.q, seen.u, seen.r, seen.R, seen.p))
        except Exception as error:
            raise wrap_plugin_error(self.mechanism.name, error) from error
        return self._check_closure(phi)

    @cached_property
    def beyond(self) -> Any:
        """How far (m) a configuration is out of the robot's reach although its closure is zero."""
        m, seen = self.mechanism, self.seen
        found = m.overstretch(*m.arguments(seen.q, seen.u, seen.r, seen.R, seen.p))
        return ca.SX(0) if found is None else found

    @cached_property
    def residual(self) -> Any:
        """The rows whose norm is the residual: the closure, and where it is zero out of the robot's
        reach, how far (m)."""
        return self.phi + self.beyond

    @cached_property
    def residual_batch(self) -> Batch:
        """(configuration, a, v) -> `residual`, on arrays of samples."""
        return Batch(dense("residual", (self.configuration, self.a, self.v), (self.residual,)))

    @property
    def equations(self) -> int:
        """Number of equations between joints and pose: rows of the closure, less those that
        determine the passive coordinates."""
        return int(self.phi.shape[0]) - len(self.mechanism.passive)

    @cached_property
    def closure_of_seen(self) -> ca.Function:
        """(q, r, R9, u and geometry) -> phi; for an ideal mechanism."""
        return ca.Function("phi", [ca.vertcat(self.configuration, self.v)], [self.phi])

    @cached_property
    def start_pose(self) -> ca.Function:
        """(q, geometry) -> r, R9 from which the direct problem starts; for an ideal mechanism."""
        r, R = self.mechanism.start(self.q, self.geometry)
        return ca.Function("start_pose", [self.q, self.v], [r, ca.vec(ca.SX(R).T)])

    @cached_property
    def start_joints(self) -> ca.Function:
        """(r, R9, geometry) -> q from which the inverse problem starts; for an ideal mechanism."""
        q = self.mechanism.start_inverse(self.r, self.R, self.geometry)
        return ca.Function("start_joints", [self.r, self.R9, self.v], [q])

    def _check_closure(self, phi: Any) -> Any:
        """The closure as SX, after checks of type, shape, symbols and values at home."""
        m, its = self.mechanism, f"{self.mechanism.name}: its closure"
        moved = len(m.moves) + len(m.passive)
        try:
            phi = ca.cse(ca.SX(phi))  # before differentiation: once, not for each derivative
        except NotImplementedError:
            kind = type(phi).__name__
            raise ModelError(f"{its} is a {kind}, expected casadi.vertcat of its rows") from None
        if phi.shape[1] != 1 or phi.shape[0] < moved:
            raise ModelError(
                f"{its} has shape {phi.shape}, expected one column with at least {moved} rows, "
                "one for each moved coordinate"
                + (" and each passive coordinate" if m.passive else "")
            )
        inputs = ca.vertcat(self.configuration, self.v, self.a)
        if unknown := {str(s) for s in ca.symvar(phi)} - {str(s) for s in ca.symvar(inputs)}:
            raise ModelError(f"{its} has unknown symbols {sorted(unknown)}")
        home = [*self.mechanism.home.configuration, *self.table.nominal, *self.neutral]
        rows = np.array(ca.Function("home", [inputs], [phi])(home)).ravel()
        if bad := np.flatnonzero(~np.isfinite(rows)).tolist():
            raise ModelError(f"{its} is not finite in rows {bad} at home with nominal values")
        return phi

    def drawing(self) -> list[Line]:
        """The lines that draw the mechanism, in terms of the configuration and the parameters."""
        m = self.mechanism
        return m.drawing(*m.arguments(self.q, self.u, self.r, self.R, self.geometry))

    @cached_property
    def jacobian_pose(self) -> Any:
        """d phi / d (r, w) with R <- exp(w) R, shape (rows, 6)."""
        # Differentiate by a small rotation w, not by R's nine entries: a third fewer operations.
        w = ca.SX.sym("w", 3)
        turned = ca.substitute(self.phi, self.R9, ca.vec((self.R + ca.skew(w) @ self.R).T))
        by_turn = ca.substitute(ca.jacobian(turned, w), w, ca.DM.zeros(3))
        return ca.horzcat(ca.jacobian(self.phi, self.r), by_turn)

    @cached_property
    def jacobian_configuration(self) -> Any:
        """d phi / d (q, r, w, u), shape (rows, n_joints + 6 + n_passive)."""
        by_q, by_u = (ca.jacobian(self.phi, part) for part in (self.q, self.u))
        return ca.horzcat(by_q, self.jacobian_pose, by_u)

    def differentiate_closure(self, columns: Sequence[int]) -> Any:
        """d phi/d some of (q, r, w, u), each divided by its scale."""
        scale = ca.repmat(ca.DM(self.scale[columns]).T, self.phi.shape[0])
        return self.jacobian_configuration[:, columns] / scale

    def _slopes(self, rows: Any) -> tuple[Any, Any]:
        """d rows / d (q, r, w, u) and d rows / dv in one pass: they share most operations."""
        J, n = ca.jacobian(rows, ca.vertcat(self.configuration, self.v)), self.q.numel() + 3
        end = n + 9 + self.u.numel()
        by_turn = J[:, n : n + 9] @ left_generators(self.R)
        return ca.horzcat(J[:, :n], by_turn, J[:, n + 9 : end]), J[:, end:]

    @cached_property
    def closure(self) -> ca.Function:
        """(configuration, a, v) -> phi, d phi/d(q, r, w, u), d phi/dv."""
        inputs = (self.configuration, self.a, self.v)
        return dense("closure", inputs, (self.phi, *self._slopes(self.phi)))

    @cached_property
    def closure_batch(self) -> SampleRows:
        """`closure` on arrays of samples."""
        return self._make_rows(_column(self.seen))

    def jacobians(
        self, x: np.ndarray, a: np.ndarray, v: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Compute d phi/d(q, r, w, u) and d phi/dv of N samples: (N, rows, columns) each."""
        _, J_x, J_v = self.closure_batch(x, a, v)  # stored column by column
        rows, n = self.phi.shape[0], len(x)
        J_x, J_v = (J.reshape(n, J.shape[1] // rows, rows) for J in (J_x, J_v))
        return J_x.transpose(0, 2, 1), J_v.transpose(0, 2, 1)

    @cached_property
    def platform_pose(self) -> tuple[Any, Any]:
        """The pose of {P} in {B} if the pose device shows (r, R)."""
        r, R, numbers = self.r, self.R, Named(self.table.names, self.v)
        for sensor in self._with_numbers:
            r, R = sensor.pose(r, R, numbers[sensor.name])
        return r, R

    @cached_property
    def to_device(self) -> Batch:
        """(r and R9 of {P} in {B}, v) -> r, R9 that the pose device shows."""
        r, R, numbers = self.r, self.R, Named(self.table.names, self.v)
        for sensor in reversed(self._with_numbers):
            r, R = sensor.shown(r, R, numbers[sensor.name])
        return Batch(self._pose_function("shown", r, R))

    @cached_property
    def to_base(self) -> Batch:
        """The inverse of `to_device`: (r and R9 that the device shows, v) -> pose of {P} in {B}."""
        return Batch(self._pose_function("located", *self.platform_pose))

    def _pose_function(self, name: str, r: Any, R: Any) -> ca.Function:
        return dense(name, (ca.vertcat(self.r, self.R9), self.v), (r, ca.vec(ca.SX(R).T)))

    @property
    def _with_numbers(self) -> list[Sensor]:
        return [s for s in self.sensors if len(s.table(self.mechanism))]

    @property
    def channels(self) -> tuple[str, ...]:
        """The channels of all sensors besides the pose, one row each."""
        return tuple(c for sensor in self.sensors for c in sensor.channels)

    @property
    def standard_uncertainty(self) -> np.ndarray:
        """Standard deviation of each channel in its unit; a guess if none is stated."""
        return np.array([s.weighing_sigma for s in self.sensors for _ in s.channels], dtype=float)

    @property
    def channel_units(self) -> np.ndarray:
        """Unit of each channel."""
        return np.array([s.unit for s in self.sensors for _ in s.channels], dtype=str)

    @property
    def reading_lengths(self) -> np.ndarray:
        """Factor of each channel that makes lengths of its readings: an angle is the arc at the
        characteristic length. NaN for pixels."""
        factors = {"m": 1.0, "rad": self.mechanism.length}
        return np.array([factors.get(unit, np.nan) for unit in self.channel_units], dtype=float)

    @property
    def channels_without_sigma(self) -> tuple[str, ...]:
        """Channels without a stated standard deviation."""
        return tuple(c for s in self.sensors if s.sigma is None for c in s.channels)

    @cached_property
    def rows(self) -> Any:
        """The rows of the measurement equations: the closure at the measured pose, then the
        reading of every channel there."""
        r, R = self.platform_pose
        numbers = Named(self.table.names, self.v)
        readings = [self._readings(s, r, R, numbers) for s in self._with_numbers]
        return ca.vertcat(self._substitute_platform_pose(self.phi), *readings)

    def _readings(self, sensor: Sensor, r: Any, R: Any, numbers: Named) -> Any:
        """Readings of a sensor's channels at a pose, after the effects on them."""
        s = numbers[sensor.name]
        passive = {name: self.u[k] for k, name in enumerate(self.mechanism.passive)}
        shown = sensor.readings_with_passive(r, R, passive, s)
        rows = ca.vertsplit(shown) if sensor.channels else []
        for k, channel in enumerate(sensor.channels):
            if acting := [effect for effect in self.effects if effect.acts_on(channel)]:
                pose = r, R
                for effect in acting:
                    pose = effect.at_sensor(*pose, s, numbers[effect.name])
                rows[k] = sensor.readings_with_passive(*pose, passive, s)[k]
        return ca.vertcat(ca.SX(0, 1), *rows)

    @cached_property
    def rows_batch(self) -> SampleRows:
        """(configuration, a, v) -> rows, d rows/d(q, r, w, u), d rows/dv, on arrays of samples."""
        if not self.sensors:
            return self.closure_batch
        seen = self._substitute_platform_pose(_column(self.seen))
        return self._make_rows(seen, self._readings_function if self.channels else None)

    def _make_rows(self, seen: Any, readings: ca.Function | None = None) -> SampleRows:
        given = self.configuration, self.a, self.v
        return SampleRows(self.ideal.closure_seen, given, self.q.numel(), seen, readings)

    @property
    def _readings_function(self) -> ca.Function:
        """(configuration, a, v) -> readings, and their derivatives. Where readings follow from
        points, the derivatives of the points are computed once, not for each reading: this halves
        the operations of an image."""
        r, R = self.platform_pose
        numbers, parts = Named(self.table.names, self.v), []
        for sensor in self._with_numbers:
            readings = self._readings(sensor, r, R, numbers)
            is_changed = any(e.acts_on(c) for e in self.effects for c in sensor.channels)
            points = None if is_changed else sensor.points(r, R, numbers[sensor.name])
            if points is None:
                parts.append((readings, *self._slopes(readings)))
            else:
                z = ca.SX.sym("z", points.shape[0])
                shown = sensor.show(z, numbers[sensor.name])
                by = ca.jacobian(shown, z), ca.jacobian(shown, self.v)
                by_points, by_numbers = ca.Function("by", [z, self.v], by)(points, self.v)
                by_x, by_v = self._slopes(points)
                parts.append((readings, by_points @ by_x, by_points @ by_v + by_numbers))
        outputs = [ca.vertcat(*some) for some in zip(*parts, strict=True)]
        return dense("readings", (self.configuration, self.a, self.v), outputs)

    @cached_property
    def residuals(self) -> Batch:
        """(configuration, a, v) -> rows alone, on arrays of samples."""
        return Batch(dense("residuals", (self.configuration, self.a, self.v), (self.rows,)))

    @lru_cache(maxsize=256)  # noqa: B019  (lives as long as the structure, which is cached itself)
    def columns(self, which: tuple[int, ...]) -> Batch:
        """(configuration, a, v) -> d rows/d(some of v), on arrays; used for a new effect."""
        inputs = (self.configuration, self.a, self.v)
        by_v = ca.jacobian(self.rows, ca.vertcat(*[self.v[i] for i in which]))
        return Batch(dense("columns", inputs, (by_v,)))

    @cached_property
    def ideal(self) -> Structure:
        """The mechanism without effects and sensors."""
        return structure_of(self.mechanism, ())

    @cached_property
    def robot(self) -> Structure:
        """The mechanism with its effects: how it moves depends on no sensor. Its parameters are the
        first ones."""
        return structure_of(self.mechanism, self.effects) if self.sensors else self

    @cached_property
    def closure_seen(self) -> Batch:
        """(q, r, R9, u and geometry) -> phi and d phi/d these, column by column, on arrays; for an
        ideal mechanism. It is compiled for work that repays it."""
        z = ca.vertcat(self.configuration, self.v)
        function = dense("closure_seen", (z,), (self.phi, ca.jacobian(self.phi, z)))
        return Batch(function, MIN_SAMPLES_TO_COMPILE)

    @lru_cache(maxsize=256)  # noqa: B019
    def effect_jacobian(self, name: str, which: tuple[int, ...]) -> tuple[Batch, np.ndarray]:
        """Build the derivatives of `seen` by some parameters of one more effect.

        For an ideal mechanism: (q, r, R9 and geometry after the effects before, conditions,
        parameters of the effect) -> d seen/d(parameters `which`). Entries of `seen` that these
        parameters do not change are omitted; the second result lists the indices of the others.
        """
        effect = load_effect(name)
        names, at = effect.table(self.mechanism).names, effect.conditions(self.mechanism)
        e, a = ca.SX.sym("e", len(names)), ca.SX.sym("a", len(at))
        seen = self._apply_effect(effect, self.seen, Named(names, e), Named(at, a))
        J = ca.jacobian(_column(seen), ca.vertcat(*[e[i] for i in which]))
        moved = np.unique(np.array(J.sparsity().get_triplet()[0], dtype=int))
        inputs = (ca.vertcat(self.configuration, self.v), a, e)
        return Batch(dense("seen_by", inputs, (J[moved.tolist(), :],))), moved

    def _substitute_platform_pose(self, expression: Any) -> Any:
        """An expression of the pose of {P} in {B}, in terms of the measured pose."""
        r, R = self.platform_pose
        return ca.substitute([expression], [self.r, self.R9], [r, ca.vec(ca.SX(R).T)])[0]

    @cached_property
    def closure_configuration(self) -> ca.Function:
        """(configuration, a, v) -> phi, d phi/d(q, r, w, u), for the careful solver."""
        inputs = (self.configuration, self.a, self.v)
        return dense("closure_configuration", inputs, (self.phi, self.jacobian_configuration))

    @property
    def geometry(self) -> Named:
        names = self.mechanism.parameters.names
        return Named(names, self.v[: len(names)])

    @cached_property
    def candidates(self) -> ca.Function:
        """(q, v) -> one column (r, R9) for each candidate pose of the direct problem."""
        poses = self.mechanism.candidates(self.q, self.geometry)
        columns = [ca.vertcat(r, ca.vec(ca.SX(R).T)) for r, R in poses]
        return dense("candidates", (self.q, self.v), [ca.horzcat(*columns)])

    @cached_property
    def joint_candidates(self) -> ca.Function:
        """(r, R9, v) -> for each joint one column of its candidate values."""
        m = self.mechanism
        choices = m.wrap_to_home(m.joint_candidates(self.r, self.R, self.geometry))
        return dense("joints", (self.r, self.R9, self.v), [ca.vertcat(*c) for c in choices])

    @cached_property
    def scale(self) -> np.ndarray:
        """Motion in metres per unit of each of (q, r, w, u): the mechanism's length for angles."""
        m = self.mechanism
        joints, passive = (
            [m.length if unit == "rad" else 1.0 for unit in units]
            for units in (m.joint_units, m.passive_units)
        )
        return np.array(joints + [1.0] * 3 + [m.length] * 3 + passive)


def _column(seen: Seen) -> Any:
    """q, r, R9 (row-major), u and the geometry as one column."""
    pose = ca.SX(seen.r), ca.vec(ca.SX(seen.R).T)
    return ca.vertcat(ca.SX(seen.q), *pose, seen.u, seen.p.column)


# A diagnosis of three effects makes five hundred. Most of them are symbols alone; those that were
# solved or fitted have functions of 2 MB. A smaller cache derives them anew in every diagnosis.
@lru_cache(maxsize=640)
def _cached_structure(
    mechanism: Mechanism, effects: tuple[type[Effect], ...], sensors: tuple[Sensor, ...]
) -> Structure:
    return Structure(mechanism, [effect() for effect in effects], sensors)


def structure_of(
    mechanism: Mechanism, effects: tuple[Effect, ...], sensors: tuple[Sensor, ...] = ()
) -> Structure:
    """Return the structure of a mechanism with effects and sensors; it is derived once."""
    return _cached_structure(mechanism, tuple(map(type, effects)), sensors)
