"""The closure linearised at measured samples, in units of the noise it inherits.

Rows inherit the noise W = J_h S J_h^T of the measured quantities h. Coordinates that were not
measured are projected out: one routine serves every measuring set-up.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from parallel_cal.identification.observations import Observations
from parallel_cal.identification.predictions import apply_pose_device, axes_of_device
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.model import Model
from parallel_cal.recordings.transforming import MAX_ROUNDING

BLOCK = 1024  # samples at a time, so that their arrays fit the processor's cache
MAX_JACOBIAN_BYTES = 1 << 28  # bytes of a Jacobian; a larger one is computed again when needed

Adjust = Callable[[np.ndarray], np.ndarray]


def rms_by_sample(residual: np.ndarray, informative: np.ndarray) -> np.ndarray:
    """Rms (N,) of whitened residuals (N, rows), of which `informative` (N,) are independent."""
    squares = np.sum(residual**2, axis=1)
    return np.asarray(np.sqrt(squares / np.maximum(informative, 1)))


@dataclass
class System:
    """Whitened residuals (N, rows) and Jacobian (N, rows, n_free) at one point, with unmeasured
    coordinates projected out. `informative` (N,) is the number of independent rows that remain;
    `adjusted` returns the configurations after a step (n_free,)."""

    residual: np.ndarray
    jacobian: np.ndarray
    informative: np.ndarray
    adjusted: Adjust

    @property
    def chi2(self) -> float:
        return float(np.vdot(self.residual, self.residual))

    def chi2_of(self, other: System) -> float:
        """chi2 of another point, comparable with the one of this point."""
        return other.chi2

    def select(self, index: np.ndarray) -> System | None:
        """The system of some samples; None if linearising them again is cheaper."""
        return System(
            self.residual[index],
            self.jacobian[index],
            self.informative[index],
            lambda step: self.adjusted(step)[index],
        )

    @property
    def columns(self) -> np.ndarray:
        """The Jacobian's rows of all samples in one matrix (N * rows, n_free)."""
        return self.jacobian.reshape(-1, self.jacobian.shape[2])

    @property
    def triangle(self) -> np.ndarray:
        """A matrix with the singular values and directions of `columns`."""
        return self.columns

    @cached_property
    def normal(self) -> np.ndarray:
        """J^T J, (n_free, n_free)."""
        return self.columns.T @ self.columns

    @cached_property
    def gradient(self) -> np.ndarray:
        """J^T times the residuals, (n_free,)."""
        return self.columns.T @ self.residual.reshape(-1)


class Streamed(System):
    """A system of very many samples, whose Jacobian `parts` yield some samples at a time."""

    def __init__(
        self,
        residual: np.ndarray,
        informative: np.ndarray,
        adjusted: Adjust,
        parts: Callable[[], Iterator[np.ndarray]],
    ):
        self.residual, self.informative, self.adjusted = residual, informative, adjusted
        self._parts = parts

    def select(self, index: np.ndarray) -> None:
        return None

    @property
    def jacobian(self) -> np.ndarray:  # type: ignore[override]
        return np.concatenate([part.copy() for part in self._parts()])

    @property
    def triangle(self) -> np.ndarray:
        R: np.ndarray = np.zeros((0, len(self.gradient)))
        for part in self._parts():
            rows = np.concatenate([R, part.reshape(-1, part.shape[2])])
            R = np.asarray(np.linalg.qr(rows, mode="r"))
        return R


class Linearisation:
    """The closure linearised at parameters and adjusted quantities, in noise units."""

    def __init__(self, model: Model, observations: Observations, free: np.ndarray, weighted: bool):
        self._observations, self._model, self._weighted = observations, model, weighted
        self._free = None if np.all(free) else np.flatnonzero(free)  # no copy of all
        s, self._n_free = model.structure, int(np.sum(free))
        self._batch = s.rows_batch
        self._rows = model.structure.rows.shape[0]
        closure = self._closure = s.phi.shape[0]
        # Without a measured pose, no measured quantity moves the readings: their noise is their
        # own, as it is in an image. An effect on a sensor may depend on the joints.
        reads = any(effect.acts_on(c) for effect in model.effects for c in s.channels)
        device = observations.measured[:, len(model.joints) :].any()
        self._couples_readings = bool(reads or device)
        # The row of a channel that was not read is zero.
        self._unread = np.zeros((len(observations), self._rows), dtype=bool)
        self._unread[:, closure:] = np.isnan(observations.reading)
        self._all_read = not self._unread.any()
        self._read = np.nan_to_num(observations.reading)
        self._variance = np.zeros((len(observations), self._rows))
        self._variance[:, closure:] = observations.get_reading_sigma(model) ** 2
        self._n = len(model.joints)
        moved = np.zeros(observations.measured.shape[1], dtype=bool)
        moved[: self._n] = True
        moved[model.mechanism.dependent_columns] = True
        self._unknown = moved & ~observations.measured
        if self._unknown[:, self._n : self._n + 6].any():
            # The device may look across the plane in which the robot moves.
            axes = np.kron(np.eye(2), np.abs(axes_of_device(model)) > MAX_ROUNDING)
            self._unknown[:, self._n : self._n + 6] &= axes[model.mechanism.moved].any(axis=0)
        self._complete = not self._unknown.any()

    def start(self) -> np.ndarray:
        """The measured configurations. Positions that were not measured, and orientations without a
        measured part, are those of the model."""
        x, n = self._observations.x.copy(), self._n
        unplaced = self._unknown[:, n : n + 3]
        turned = self._observations.measured[:, n + 3 : n + 6].any(axis=1)
        unturned = self._unknown[:, n + 3 : n + 6].any(axis=1) & ~turned
        blind = np.flatnonzero(unplaced.any(axis=1) | unturned)
        if len(blind):
            at = dict(zip(self._model.conditions, self._observations.a[blind].T, strict=True))
            pose = apply_pose_device(self._model, Kinematics(self._model).direct(x[blind, :n], at))
            own, here = pose.configuration.rows, x[blind]
            solved = np.isfinite(own).all(axis=1)[:, None]
            rotated = np.repeat(unturned[blind, None], 9, axis=1)
            joints = np.zeros((len(blind), n), bool)
            passive = np.ones((len(blind), len(self._model.mechanism.passive)), bool)
            taken = np.hstack([joints, unplaced[blind], rotated, passive])
            x[blind] = np.where(taken & solved, own, here)
        return x

    def __call__(
        self, values: np.ndarray, x: np.ndarray, by_measured: np.ndarray | None = None
    ) -> System:
        """Residuals and Jacobian at parameters and adjusted configurations x (N, nq+12+nu).

        The derivatives of the rows by the measured quantities (q, r, w) are written to
        `by_measured` (N, rows, nq+6+nu), if it is given.
        """
        residual, informative = np.empty((len(x), self._rows)), np.full(len(x), self._rows)
        if len(x) * self._rows * self._n_free * 8 > MAX_JACOBIAN_BYTES:
            return self._streamed(values, x, residual, informative, by_measured)
        jacobian = np.empty((len(x), self._rows, self._n_free))
        adjusts = [
            self._fill(
                residual[part],
                jacobian[part],
                informative[part],
                values,
                x[part],
                part,
                None if by_measured is None else by_measured[part],
            )
            for part in _parts(x)
        ]
        return System(
            residual,
            jacobian,
            informative,
            lambda step: np.concatenate([adjust(step) for adjust in adjusts]),
        )

    def _streamed(
        self,
        values: np.ndarray,
        x: np.ndarray,
        residual: np.ndarray,
        informative: np.ndarray,
        by_measured: np.ndarray | None,
    ) -> Streamed:
        """The system with only a part of the Jacobian in memory at a time."""
        work = np.empty((BLOCK, self._rows, self._n_free))

        def filled() -> Iterator[tuple[slice, np.ndarray, Adjust]]:
            for part in _parts(x):
                A = work[: len(x[part])]
                C = None if by_measured is None else by_measured[part]
                args = residual[part], A, informative[part], values, x[part], part, C
                yield part, A, self._fill(*args)

        def adjusted(step: np.ndarray) -> np.ndarray:
            out = np.empty_like(x)
            for part, _, adjust in filled():
                out[part] = adjust(step)
            return out

        system = Streamed(residual, informative, adjusted, lambda: (A for _, A, _ in filled()))
        system.normal, system.gradient = np.zeros((self._n_free,) * 2), np.zeros(self._n_free)
        for part, A, _ in filled():
            columns = A.reshape(-1, self._n_free)
            system.normal += columns.T @ columns
            system.gradient += columns.T @ residual[part].reshape(-1)
        return system

    def _fill(
        self,
        r: np.ndarray,
        A: np.ndarray,
        informative: np.ndarray,
        values: np.ndarray,
        x: np.ndarray,
        part: slice,
        by_measured: np.ndarray | None,
    ) -> Adjust:
        """Fill in residuals, Jacobian, number of rows and, if asked, derivatives by the measured
        quantities of some samples; return how a step adjusts their configurations."""
        phi, C, J = self.blocks(values, x, part)
        if by_measured is not None:
            by_measured[:] = C
        away, here = self.compute_adjustments(x, part), self._model.configuration(x)
        SC = self._covariance(part) @ C.transpose(0, 2, 1)
        K = self._whitening(C @ SC + self._reading_covariance(part))
        r[:] = (K @ (phi[:, :, None] + C @ away[:, :, None]))[:, :, 0]
        np.matmul(K, J, out=A)
        informative[:] = self._rows - self._unread[part].sum(axis=1)
        explained, explain = self._projection(K, C, part)

        def corrections(white: np.ndarray) -> np.ndarray:
            force = SC @ (K.transpose(0, 2, 1) @ white[:, :, None])
            return away - force[:, :, 0] if self._weighted else away

        if explained is None:
            return lambda step: here.apply_change(corrections(r + A @ step)).rows
        r_all, A_all = r.copy(), A.copy()
        # Subtract projections, do not change to a basis of the rest: rounding can rotate a basis.
        across = explained.transpose(0, 2, 1)
        r -= (explained @ (across @ r[:, :, None]))[:, :, 0]
        A -= explained @ (across @ A)
        informative -= np.rint(np.sum(explained**2, axis=(1, 2))).astype(int)
        return lambda step: here.apply_change(explain(r_all + A_all @ step, corrections)).rows

    def whiten(self, C: np.ndarray, part: slice = slice(None)) -> np.ndarray:
        """T (N, rows, rows) that converts rows with the derivatives C into noise units, projects
        out unmeasured coordinates and ignores channels that were not read."""
        K = self._whitening(self.covariance_of(C, part))
        explained, T = self._projection(K, C, part)[0], K
        if explained is not None:
            T = K - explained @ (explained.transpose(0, 2, 1) @ K)
        return T if self._all_read else T * ~self._unread[part, None, :]

    def covariance_of(self, C: np.ndarray, part: slice = slice(None)) -> np.ndarray:
        """Covariance (N, rows, rows) of rows with the derivatives C by the measured quantities."""
        W = C @ self._covariance(part) @ C.transpose(0, 2, 1)
        return np.asarray(W + self._reading_covariance(part))

    def blocks(
        self, values: np.ndarray, x: np.ndarray, part: slice = slice(None)
    ) -> tuple[np.ndarray, ...]:
        """Rows minus readings (N, rows), derivatives by (q, r, w) and by free parameters; zero for
        channels that were not read."""
        phi, C, J = self._batch(x, self._observations.a[part], values)
        phi[:, self._rows - self._read.shape[1] :] -= self._read[part]
        C = C.reshape(len(x), -1, self._rows).transpose(0, 2, 1)
        J = J.reshape(len(x), -1, self._rows)
        if self._free is not None:
            J = J.take(self._free, axis=1)  # indexing would put samples last: slow to multiply
        J = J.transpose(0, 2, 1)
        if not self._all_read:
            unread = self._unread[part]
            phi[unread], C[unread], J[unread] = 0.0, 0.0, 0.0
        return phi, C, J

    def _covariance(self, part: slice) -> np.ndarray:
        """S of some samples, zero where not measured."""
        seen = self._observations.measured[part]
        S = self._observations.S[part]
        return S if seen.all() else np.where(seen[:, :, None] & seen[:, None, :], S, 0.0)

    def _reading_covariance(self, part: slice) -> np.ndarray:
        """Covariance (N, rows, rows) that the readings of sensors add to the rows."""
        return np.asarray(self._variance[part, :, None] * np.eye(self._rows))

    def _whitening(self, W: np.ndarray) -> np.ndarray:
        """K with K W K^T = 1, for the noise that the rows inherit."""
        if not self._weighted:
            return np.broadcast_to(np.eye(self._rows), W.shape)
        coupled = self._rows if self._couples_readings else self._closure
        block = W[:, :coupled, :coupled]
        tiny = 1e-14 * np.trace(block, axis1=1, axis2=2) / coupled
        K = np.zeros_like(W)
        K[:, :coupled, :coupled] = np.linalg.inv(
            np.linalg.cholesky(block + tiny[:, None, None] * np.eye(coupled))
        )
        alone = np.arange(coupled, self._rows)
        K[:, alone, alone] = 1 / np.sqrt(W[:, alone, alone])
        return K

    def _projection(
        self, K: np.ndarray, C: np.ndarray, part: slice
    ) -> tuple[np.ndarray | None, Callable[..., np.ndarray]]:
        """Orthonormal columns (N, rows, n) of the part that unmeasured coordinates explain, zero
        beyond its rank, and the change of all coordinates; None if all were measured."""
        if self._complete:
            return None, lambda *_: np.empty(0)
        unknown = self._unknown[part]
        # Only the columns of what is unknown at some sample: most of them are measured everywhere.
        at = np.flatnonzero(unknown.any(axis=0))
        U = K @ (C[:, :, at] * unknown[:, None, at])
        left, sizes, right = np.linalg.svd(U, full_matrices=False)
        spanned = sizes > 1e-9 * np.maximum(sizes[:, :1], 1e-300)
        left = left * spanned[:, None, :]
        inverse = right.transpose(0, 2, 1) * (spanned / np.maximum(sizes, 1e-300))[:, None, :]
        inverse = inverse @ left.transpose(0, 2, 1)

        def explain(
            white: np.ndarray, corrections: Callable[[np.ndarray], np.ndarray]
        ) -> np.ndarray:
            u = -inverse @ white[:, :, None]
            change = corrections(white + (U @ u)[:, :, 0]).copy()
            change[:, at] = np.where(unknown[:, at], u[:, :, 0], change[:, at])
            return change

        return left, explain

    def compute_adjustments(self, x: np.ndarray, part: slice = slice(None)) -> np.ndarray:
        """Measured minus adjusted (q, r, w), (N, nq+6+nu); zero where not measured."""
        measured = self._model.configuration(self._observations.x[part])
        away = measured.change_from(self._model.configuration(x))
        return np.where(self._observations.measured[part], away, 0.0)


def _parts(x: np.ndarray) -> Iterator[slice]:
    """Yield some samples at a time."""
    return (slice(begin, begin + BLOCK) for begin in range(0, len(x), BLOCK))


def follow_closure(
    model: Model, rows: np.ndarray, by: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """d pose / dy (N, n_moved, m) along the closure, and d reading / dy (N, n_channels, m), of the
    derivatives of the rows by (q, r, w) from `blocks` and by quantities y (N, rows, m). Without
    `by`, y are the joints."""
    by = rows[:, :, : len(model.joints)] if by is None else by
    closure, dependent = model.structure.phi.shape[0], model.mechanism.dependent_columns
    follows = -np.linalg.pinv(rows[:, :closure, dependent]) @ by[:, :closure]
    pose = follows[:, : len(model.mechanism.moved)]
    return pose, by[:, closure:] + rows[:, closure:, dependent] @ follows
