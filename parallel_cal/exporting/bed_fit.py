"""Fit a firmware's numbers to a bed that was touched, and keep x and y where nothing measured them.

Touches determine heights. They hardly determine x and y: other rods, radii and tower angles that
change x and y by millimetres give nearly the same heights. At the same motor positions, the fit
therefore makes the firmware's heights agree with those of the model, and its x and y with those of
the firmware's present numbers. Where a printed length or a device measured x and y, they agree with
the model instead. Rods keep their lengths as far as the heights allow: an owner knows a rod better
than its tower's place. All values are in SI units.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import casadi as ca
import numpy as np

from parallel_cal.base.errors import ModelError
from parallel_cal.exporting.projection import Array, Firmware, Machine
from parallel_cal.importing.deltas import compute_positions
from parallel_cal.importing.touch_samples import Touches
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.model import Model
from parallel_cal.model.parameters import Named

PROBE = "probe"
XY_SIGMA = 0.1e-3  # m, rms over the bed: how exact x and y by the present numbers are taken to be
MODEL_XY_SIGMA = 0.01e-3  # m, rms over the bed: x and y by no model are taken to be more exact
COMMON_SIGMA = 0.5e-3  # m, rms: how exact the common shift and turn of all points are taken to be
ROD_SIGMA = 1e-3  # m: how exact the rods' present lengths are taken to be
MAX_UNMEASURED_MOVE = 0.5e-3  # m, of x and y against each other, if nothing measured it
MAX_TIGHTENINGS = 8  # each halves XY_SIGMA, until the movement is within MAX_UNMEASURED_MOVE
LOOSEST = 1 / 16  # of the tightenings: heights alone decide, as far as they can
MAX_HEIGHT_LOSS = 1.25  # the most by which a tightening may multiply the rms height at the touches
NOISE_ROUNDS = 3  # of estimating the noise of the heights from the residuals of the fit before
N_BED_POINTS = 60  # where x and y are compared in a fit, at each of the LAYERS
N_JUDGED_POINTS = 240  # where the largest movement is searched: 60 miss up to 15 % of it
LAYERS = (0.5, 1.0)  # above the bed, in heights of the workspace
SLOPE_STEP = 1e-7  # of the size of a number, for slopes
UNDETERMINED = 1e-12  # of a variance in tolerances: the data leave this combination open


@dataclass(frozen=True)
class Touched:
    """Where the nozzle was at touches of the bed, in the frame of a machine's firmware.

    `model_height` is the height at which the model says that the probe touches. It is not the
    height of the model's nozzle: for a probe beside the nozzle, the two differ by how the effector
    and the bed tilt, which touches hardly determine and for which a firmware has no numbers. If the
    bed is `anywhere`, only differences of heights count.
    """

    steps: Array  # motors (N, 3) from the end-stops, m or rad
    position: Array  # (N, 3) by the model, m
    height: Array  # (N,) by the touch itself, m
    model_height: Array  # (N,), m
    anywhere: bool = False

    @classmethod
    def by(cls, model: Model, machine: Machine, touches: Touches) -> Touched:
        frame = machine.frame
        found = Kinematics(model, quick=True).direct(touches.q)
        position, _ = frame.poses(found.position, found.rotation)
        [probe] = [sensor for sensor in model.sensors if sensor.name == PROBE]
        tip = probe.options.get("tip")
        below = 0.0 if tip is None else float(tip[2])
        upwards = np.sign(frame.turn[2, 2])  # 1 if z of the firmware points along z of {B}, else -1
        numbers = Named(model.table.names, model.values)[PROBE]
        read = [
            float(probe.readings(ca.DM(r), ca.DM(R), numbers))
            for r, R in zip(found.position, found.rotation, strict=True)
        ]
        by_touch, by_model = (upwards * (h - below) for h in (touches.height, np.array(read)))
        steps = frame.motors(touches.q - machine.stops)
        return cls(steps, position, by_touch, by_model, frame.bed_anywhere)

    def positions(self, firmware: Firmware) -> Array:
        """Return the nozzle's positions (N, 3) by a firmware, in its own frame."""
        return compute_positions(firmware, firmware.homed + self.steps, self.position)

    def errors(self, firmware: Firmware, by_model: bool = False) -> Array:
        """Return heights (N,) in m of the nozzle over a firmware's bed, minus the touches' own, or
        minus those by the model."""
        off = self.positions(firmware)[:, 2] - (self.model_height if by_model else self.height)
        return np.asarray(off - off.mean() if self.anywhere else off)

    def bed_height(self, firmware: Firmware) -> float:
        """Return the mean height (m) of the bed by a firmware."""
        return float(np.mean(self.positions(firmware)[:, 2] - self.height))


@dataclass(frozen=True)
class Present:
    """A firmware with the numbers of its files, and touches of the bed that it moved to."""

    firmware: Firmware
    touches: Touches
    by_touch: bool = False

    def refine(self, model: Model, numbers: Array, machine: Callable[[Array], Machine]) -> Array:
        """Return the numbers (k,) that fit the bed best, from those that agree with the model."""
        old = replace(machine(numbers), firmware=self.firmware)
        return BedFit(model, old, self.touches, self.by_touch).fit(numbers, machine)


@dataclass(frozen=True)
class Movement:
    """How far x and y move over the bed at the same motor positions, in m.

    `largest` is the largest movement, `shape` the largest one that remains after the shift and the
    turn that all points have in common: these move a part on the bed and leave its shape as it is.
    `sigma` is the standard deviation with which the model knows x and y, None if it was not fitted.
    `unsupported` is the part of `shape` that nothing measured.
    """

    largest: float
    shape: float
    unsupported: float
    sigma: float | None
    measured: bool


@dataclass(frozen=True)
class BedFit:
    """Fits the numbers of a firmware to touches of a bed.

    `old` is the machine with its present numbers. The heights at the touches are those of the
    model; those of the touches themselves if `by_touch`, which predicts heights at other touches.
    x and y are compared at `n_points` points over the bed.
    """

    model: Model
    old: Machine
    touches: Touches
    by_touch: bool = False
    n_points: int = N_BED_POINTS

    @cached_property
    def touched(self) -> Touched:
        return Touched.by(self.model, self.old, self.touches)

    @cached_property
    def points(self) -> Array:
        """Points (n, 3) in m, by the present numbers, over the bed where it was touched."""
        at = self.touched.positions(self.old.firmware)
        at = at[np.isfinite(at).all(axis=1)]
        if not len(at):
            raise ModelError(
                f"{self.touches.source}: the firmware's present numbers reach no touch"
            )
        centre = at[:, :2].mean(axis=0)
        radius = np.linalg.norm(at[:, :2] - centre, axis=1).max()
        k = np.arange(self.n_points) + 0.5
        out, around = radius * np.sqrt(k / self.n_points), k * np.pi * (3 - 5**0.5)  # a sunflower
        xy = centre + np.column_stack([out * np.cos(around), out * np.sin(around)])
        points = np.column_stack([xy, np.full(len(xy), at[:, 2].mean())])
        return points[np.isfinite(self._motors(points)).all(axis=1)]

    @cached_property
    def raised(self) -> list[Array]:
        """The points, raised to layers above the bed."""
        low, high = self.model.mechanism.workspace.low[2], self.model.mechanism.workspace.high[2]
        layers = [self.points + [0.0, 0.0, share * abs(high - low)] for share in LAYERS]
        return [layer for layer in layers if np.isfinite(self._motors(layer)).all()]

    def _motors(self, points: Array) -> Array:
        return self.old.firmware.joints(points, np.broadcast_to(np.eye(3), (len(points), 3, 3)))

    def moves(self, firmware: Firmware, points: Array) -> Array:
        """Return how far (n, 3) a firmware moves points, at the same motor positions."""
        motors = self._motors(points) - self.old.firmware.homed + firmware.homed
        return compute_positions(firmware, motors, points) - points

    @cached_property
    def model_moves(self) -> tuple[Array, Array]:
        """Movements (2n,) of x and y to those by the model, and their covariance (2n, 2n)."""
        m = self.model
        frame = self.old.frame
        q = self.old.stops + frame.readings(self._motors(self.points) - self.old.firmware.homed)
        found = Kinematics(m, quick=True).direct(q)

        def xy(model: Model) -> Array:
            at = Kinematics(model, quick=True).direct(q, start=found)
            return np.asarray(frame.poses(at.position, at.rotation)[0][:, :2].ravel())

        here = xy(m)
        free = np.flatnonzero(~m.fixed)
        tolerance = m.table.tolerance[free]
        covariance = np.asarray(m.covariance)[np.ix_(free, free)] / np.outer(tolerance, tolerance)
        variances, directions = np.linalg.eigh(covariance)
        # The covariance contains only what data determine; the rest is known by its tolerance.
        sizes = np.sqrt(np.where(variances < UNDETERMINED, 1.0, variances))
        changes = []
        for size, direction in zip(sizes, directions.T, strict=True):
            values = m.values.copy()
            values[free] += size * tolerance * direction
            changes.append(xy(m.with_values(values)) - here)
        J = np.array(changes)
        return here - self.points[:, :2].ravel(), J.T @ J

    def supported(self, tightening: float = 1.0) -> tuple[Array, Array]:
        """Movements (2n,) of x and y that measurements support, and the whitening (2n, 2n) of
        deviations from them. `tightening` divides XY_SIGMA.

        The model with its covariance and the present numbers with XY_SIGMA are two independent
        statements on x and y. Without a measurement of x and y, only the second one is used.
        """
        size = 2 * len(self.points)
        # A firmware without a tilt of its bed shifts x and y by its end-stops instead.
        common, _ = np.linalg.qr(self._common_moves)
        present = (XY_SIGMA / tightening) ** 2 * np.eye(size) + COMMON_SIGMA**2 * common @ common.T
        present = len(self.points) * present
        if not self.touches.xy_measured or self.model.covariance is None:
            return np.zeros(size), np.linalg.inv(np.linalg.cholesky(present))
        target, covariance = self.model_moves
        covariance = covariance + len(self.points) * MODEL_XY_SIGMA**2 * np.eye(size)
        both = np.linalg.inv(present + covariance)
        combined = present - present @ both @ present
        return present @ both @ target, np.linalg.inv(np.linalg.cholesky(combined))

    def fit(self, start: Array, machine: Callable[[Array], Machine]) -> Array:
        """Return the numbers (k,) of the machine that fits best, from `start`.

        x and y are held ever more tightly while they move too far. If the heights suffer, x and y
        are nearly free: heights were measured, and x and y were not.
        """
        free = self._fit(start, machine, LOOSEST)
        limit = MAX_HEIGHT_LOSS * _rms(self.touched.errors(machine(free).firmware))
        for tightening in 2.0 ** np.arange(MAX_TIGHTENINGS + 1):
            found = self._fit(start, machine, tightening)
            firmware = machine(found).firmware
            if _rms(self.touched.errors(firmware)) > limit:
                break
            if self.movement(firmware).unsupported <= MAX_UNMEASURED_MOVE:
                return found
        return free

    def _fit(
        self,
        start: Array,
        machine: Callable[[Array], Machine],
        tightening: float,
    ) -> Array:
        from scipy.optimize import least_squares

        target, whitening = self.supported(tightening)
        scale = np.maximum(np.abs(start), 0.01)
        [probe] = [sensor for sensor in self.model.sensors if sensor.name == PROBE]
        noise = probe.weighing_sigma
        # All layers at once: for a hundred points, calls take longer than what they compute.
        layers = [self.points, *self.raised]
        places, ends = np.concatenate(layers), np.cumsum([len(layer) for layer in layers[:-1]])
        # A point at the edge of the present reach may be beyond that of other numbers.
        unreached = ~np.isfinite(self.moves(machine(start).firmware, places))

        def missed(numbers: Array) -> Array:
            firmware = machine(numbers).firmware
            moves = np.where(unreached, 0.0, self.moves(firmware, places))
            on_bed, *above = np.split(moves, ends)
            weight = tightening / (np.sqrt(len(self.points)) * XY_SIGMA)
            rows = [
                self.touched.errors(firmware, by_model=not self.by_touch) / noise,
                whitening @ (on_bed[:, :2].ravel() - target),
                *((raised - on_bed).ravel() * weight for raised in above),
                (_rods(firmware) - _rods(self.old.firmware)) / ROD_SIGMA,
                1e-6 * (numbers - start) / scale,  # numbers that change no position stay
            ]
            return np.concatenate(rows)

        def slopes(numbers: Array) -> Array:
            here, columns = missed(numbers), []
            for step in np.diag(SLOPE_STEP * scale):
                ahead = missed(numbers + step) - here
                # A point may be reached on one side only, or just here.
                behind = here - missed(numbers - step) if np.isnan(ahead).any() else ahead
                columns.append(np.where(np.isnan(ahead), np.nan_to_num(behind), ahead) / step.max())
            return np.column_stack(columns)

        numbers = start
        for _ in range(NOISE_ROUNDS):
            found = least_squares(missed, numbers, jac=slopes, x_scale=scale)
            numbers = np.asarray(found.x)
            off = self.touched.errors(machine(numbers).firmware)
            spare = len(off) - len(start)
            if spare > 0:
                noise = float(np.sqrt(np.sum(off**2) / spare))
        return numbers

    @cached_property
    def _judge(self) -> BedFit:
        return replace(self, n_points=N_JUDGED_POINTS)

    def movement(self, firmware: Firmware) -> Movement:
        """Return how far a firmware moves x and y over the bed."""
        return self._judge._movement(firmware)

    def _movement(self, firmware: Firmware) -> Movement:
        moves = self.moves(firmware, self.points)[:, :2]
        target = self.supported()[0].reshape(-1, 2)
        moves = np.where(np.isfinite(moves), moves, target)  # beyond reach, nothing moves
        sigma = None
        if self.model.covariance is not None:
            variances = np.diag(self.model_moves[1]).reshape(-1, 2).sum(axis=1)
            sigma = float(np.sqrt(variances.max()))
        shape, unsupported = (self._largest_shape(each) for each in (moves, moves - target))
        largest = float(np.linalg.norm(moves, axis=1).max())
        return Movement(largest, shape, unsupported, sigma, self.touches.xy_measured)

    @cached_property
    def _common_moves(self) -> Array:
        """Movements (2n, 3) of x and y by a shift along x, one along y, and a turn about z."""
        x, y = (self.points[:, :2] - self.points[:, :2].mean(axis=0)).T
        common = np.zeros((len(x), 2, 3))
        common[:, 0, 0] = common[:, 1, 1] = 1.0
        common[:, :, 2] = np.column_stack([-y, x])
        return common.reshape(-1, 3)

    def _largest_shape(self, moves: Array) -> float:
        """Return the largest of movements (n, 2) after their common shift and turn."""
        rows = self._common_moves
        rest = moves.ravel() - rows @ np.linalg.lstsq(rows, moves.ravel(), rcond=None)[0]
        return float(np.linalg.norm(rest.reshape(-1, 2), axis=1).max())


def _rms(errors: Array) -> float:
    return float(np.sqrt(np.mean(errors**2)))


def _rods(firmware: Firmware) -> Array:
    """Return the rods' lengths (3,) in m, empty for a firmware without them."""
    return np.asarray(getattr(firmware, "rods", ()), float)
