"""Weighted implicit calibration: least squares on the closure (5.3.3), in noise units.

The closure is evaluated at measured quantities h with covariance S, so its rows inherit the
noise W = J_h S J_h^T. Minimising phi^T W^-1 phi, with J_h taken at the adjusted (not the
measured) quantities, is the Gauss-Helmert model: orthogonal distance regression. Coordinates
that were not measured are projected out: every measuring set-up is this one routine.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from parallel_cal.accuracy import shown
from parallel_cal.errors import FitError
from parallel_cal.evidence import Evidence
from parallel_cal.kinematics import Kinematics
from parallel_cal.model import Model
from parallel_cal.observability import Spectrum, spectrum
from parallel_cal.rotation import rotation_matrix, rotation_vector

STEP = 1e-8  # in tolerances: smaller steps change nothing a person can measure
GAIN = 1e-10  # of chi2: steps that promise less have arrived, however long (weak directions)


@dataclass(frozen=True)
class Estimate:
    """What a method found: values and covariance (all parameters, fixed ones at zero),
    chi2 and its degrees of freedom, what the data can see, whitened residuals a sample."""

    values: np.ndarray
    covariance: np.ndarray
    lost: np.ndarray
    chi2: float
    dof: int
    spectrum: Spectrum
    residuals: np.ndarray
    iterations: int

    @property
    def chi2_per_dof(self) -> float:
        return self.chi2 / self.dof if self.dof > 0 else float("nan")

    @property
    def sigma(self) -> np.ndarray:
        """Standard deviation of every parameter; infinite where the data cannot see it."""
        return np.where(self.lost, np.inf, np.sqrt(np.diag(self.covariance)))


@dataclass
class _System:
    """Whitened residuals and Jacobian at one point, unmeasured coordinates projected out."""

    residual: np.ndarray
    jacobian: np.ndarray
    adjusted: Callable[[np.ndarray], np.ndarray]

    @property
    def chi2(self) -> float:
        return float(np.sum(self.residual**2))


def estimate(
    model: Model,
    evidence: Evidence,
    free: np.ndarray,
    prior: bool = False,
    weighted: bool = True,
    iterations: int = 200,
) -> Estimate:
    """Parameters by Levenberg-Marquardt (C.4) on whitened closure residuals.

    `free` (n_parameters,) mask; `prior` adds every tolerance as a measurement of the nominal
    value; `weighted=False` is the thesis' merit function (eq. 5.6): chains decouple, but
    sigma and chi2 lose their meaning. FitError when it does not converge.
    """
    tolerance = model.table.tolerance[free]
    linearise = Linearisation(model, evidence, free, weighted)
    values, x = np.array(model.values), linearise.start()
    system = linearise(values, x)
    damping = 1e-6
    for k in range(iterations):
        step, promised = _step(system, tolerance, damping, _prior(model, values, free, prior))
        trial = values.copy()
        trial[free] += step
        # The adjusted quantities follow from the step by the linearised closure.
        x_trial = system.adjusted(step)
        tried = linearise(trial, x_trial)
        better = tried.chi2 + _prior_cost(model, trial, free, prior) <= (
            system.chi2 + _prior_cost(model, values, free, prior)
        ) * (1 + 1e-9)
        small = np.max(np.abs(step / tolerance), initial=0.0) < STEP or promised < GAIN * tried.chi2
        if better or small:
            values, x, system, damping = trial, x_trial, tried, max(damping / 5, 1e-12)
        else:
            damping = max(damping * 3, 1e-6)
        if small:
            return _finished(model, values, system, free, prior, k + 1)
        if damping > 1e12:
            break
    raise FitError(
        f"identification did not converge in {iterations} iterations (chi2 {system.chi2:.3g} of "
        f"{len(evidence)} samples); is the starting model of the right robot, are units right?"
    )


def _finished(
    model: Model, values: np.ndarray, system: _System, free: np.ndarray, prior: bool, k: int
) -> Estimate:
    J = system.jacobian.reshape(-1, system.jacobian.shape[-1])
    seen = spectrum(J, model.table, free, prior)
    covariance = np.zeros((len(values), len(values)))
    covariance[np.ix_(free, free)] = seen.covariance
    lost = np.zeros(len(values), dtype=bool)
    lost[free] = seen.lost
    rows = int(np.count_nonzero(np.any(J != 0, axis=1)))
    chi2 = system.chi2
    return Estimate(values, covariance, lost, chi2, rows - seen.rank, seen, system.residual, k)


class Linearisation:
    """The closure linearised at parameters and adjusted quantities, in noise units."""

    def __init__(self, model: Model, evidence: Evidence, free: np.ndarray, weighted: bool):
        self._structure, self._evidence = model.structure, evidence
        self._free, self._weighted = np.flatnonzero(free), weighted
        self._model, self._batch = model, model.structure.rows_batch
        self._rows = model.structure.rows.shape[0]
        closure = model.structure.phi.shape[0]
        # A channel that was not read is an unknown of its own row, projected out as one.
        self._unread = np.zeros((len(evidence), self._rows), dtype=bool)
        self._unread[:, closure:] = np.isnan(evidence.reading)
        self._read = np.zeros((len(evidence), self._rows))
        self._read[:, closure:] = np.nan_to_num(evidence.reading)
        self._variance = np.zeros(self._rows)
        self._variance[closure:] = model.structure.accuracy**2
        self._n = len(model.joints)
        moved = np.zeros(self._n + 6, dtype=bool)
        moved[: self._n] = True
        moved[[self._n + i for i in model.mechanism.moved]] = True
        self._unknown = moved & ~evidence.measured
        self._any_unknown = bool(self._unknown.any() or self._unread.any())
        self._S = np.where(
            evidence.measured[:, :, None] & evidence.measured[:, None, :], evidence.S, 0.0
        )

    def start(self) -> np.ndarray:
        """The measured configurations; where nothing of a pose was measured, the model's own."""
        x, n = self._evidence.x.copy(), self._n
        blind = self._unknown[:, [n + i for i in self._model.mechanism.moved]].all(axis=1)
        if blind.any():
            at = dict(zip(self._model.conditions, self._evidence.a[blind].T, strict=True))
            pose = shown(self._model, Kinematics(self._model).direct(x[blind, :n], at))
            columns = np.concatenate([pose.position, pose.rotation.reshape(-1, 9)], axis=1)
            solved = np.isfinite(columns).all(axis=1)
            x[np.flatnonzero(blind)[solved], n:] = columns[solved]
        return x

    def __call__(self, values: np.ndarray, x: np.ndarray) -> _System:
        phi, C, J = self.blocks(values, x)
        away = self._from_adjusted(x)
        at_measured = phi + np.einsum("nij,nj->ni", C, away)
        SC = self._S @ C.transpose(0, 2, 1)
        L = self._whitening(C @ SC + np.diag(self._variance))
        white_rows = np.linalg.solve(L, np.concatenate([at_measured[:, :, None], J], axis=2))
        r, A = white_rows[:, :, 0], white_rows[:, :, 1:]
        U = self._unknown_columns(C, L) if self._any_unknown else None
        keep, solve_unknown = _projection(U, len(x), self._rows, self._n + 6)
        # The correction of all measured quantities, given a step of the parameters.

        def adjusted(step: np.ndarray) -> np.ndarray:
            white = r + A @ step
            unknown = -solve_unknown(white)
            if U is not None:
                white = white + np.einsum("nij,nj->ni", U, unknown)
            force = np.linalg.solve(L.transpose(0, 2, 1), white[:, :, None])
            correction = away - (SC @ force)[:, :, 0] if self._weighted else away
            unknown = unknown[:, : self._n + 6]
            return self._moved(x, np.where(self._unknown, unknown, correction))

        if keep is None:
            return _System(r, A, adjusted)
        return _System(np.einsum("nij,nj->ni", keep, r), keep @ A, adjusted)

    def blocks(self, values: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, ...]:
        phi, C, J = self._batch(x, self._evidence.a, values)
        rows = self._rows
        phi = phi - self._read
        C = C.reshape(len(x), -1, rows).transpose(0, 2, 1)
        J = J.reshape(len(x), -1, rows)[:, self._free].transpose(0, 2, 1)
        return phi, C, J

    def _unknown_columns(self, C: np.ndarray, L: np.ndarray) -> np.ndarray:
        """How unmeasured coordinates, and then channels not read, move the whitened rows."""
        columns = C * self._unknown[:, None, :]
        if self._unread.any():
            own = np.eye(self._rows) * self._unread[:, None, :]
            columns = np.concatenate([columns, own], axis=2)
        return np.linalg.solve(L, columns)

    def _whitening(self, W: np.ndarray) -> np.ndarray:
        """Cholesky factors of the noise that the rows inherit."""
        if not self._weighted:
            return np.broadcast_to(np.eye(self._rows), W.shape)
        tiny = 1e-14 * np.trace(W, axis1=1, axis2=2) / self._rows
        return np.linalg.cholesky(W + tiny[:, None, None] * np.eye(self._rows))

    def _from_adjusted(self, x: np.ndarray) -> np.ndarray:
        """Measured minus adjusted (q, r, w); zero where not measured."""
        n, measured = self._n, self._evidence.x
        turn = measured[:, n + 3 :].reshape(-1, 3, 3) @ x[:, n + 3 :].reshape(-1, 3, 3).transpose(
            0, 2, 1
        )
        away = np.concatenate([measured[:, : n + 3] - x[:, : n + 3], rotation_vector(turn)], axis=1)
        return np.where(self._evidence.measured, away, 0.0)

    def _moved(self, x: np.ndarray, change: np.ndarray) -> np.ndarray:
        n = self._n
        R = rotation_matrix(change[:, n + 3 :]) @ x[:, n + 3 :].reshape(-1, 3, 3)
        return np.concatenate([x[:, : n + 3] + change[:, : n + 3], R.reshape(-1, 9)], axis=1)


def _projection(
    U: np.ndarray | None, n: int, rows: int, columns: int
) -> tuple[np.ndarray | None, Callable[[np.ndarray], np.ndarray]]:
    """Projectors (N, rows, rows) onto what the unmeasured coordinates cannot explain, and
    the least-squares solution for them; None where everything was measured."""
    if U is None:
        return None, lambda white: np.zeros((n, columns))
    inverse = np.linalg.pinv(U, rcond=1e-9)
    left, sizes, _ = np.linalg.svd(U)
    rank = np.sum(sizes > 1e-9 * np.maximum(sizes[:, :1], 1e-300), axis=1)
    drop = np.arange(rows)[None, :] < rank[:, None]
    # Rows of an orthonormal basis, those spanned by U zeroed: the rest is free of them.
    keep = np.where(drop[:, :, None], 0.0, left.transpose(0, 2, 1))
    return keep, lambda white: np.einsum("nij,nj->ni", inverse, white)


def _step(
    system: _System, tolerance: np.ndarray, damping: float, prior: tuple[np.ndarray, np.ndarray]
) -> tuple[np.ndarray, float]:
    """One damped Gauss-Newton step from the normal equations, in units of tolerances, and
    the fall of chi2 that it promises."""
    J = system.jacobian.reshape(-1, len(tolerance)) * tolerance
    pull, weight = prior
    normal = J.T @ J + np.diag(weight)
    gradient = J.T @ system.residual.reshape(-1) + weight * pull
    size, directions = np.linalg.eigh(normal)
    floor = max(1e-13 * size[-1], 1e-300)
    # Directions the data cannot see keep their values: no walk along them.
    damped = size + damping * np.maximum(size, 1e-6 * size[-1])  # weak directions wait
    inverse = np.where(size > floor, 1 / np.maximum(damped, floor), 0.0)
    along = directions.T @ gradient
    return -tolerance * (directions @ (inverse * along)), float(np.sum(inverse * along**2))


def _prior(
    model: Model, values: np.ndarray, free: np.ndarray, prior: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Distance from nominal in tolerances, and the weight of each (0 without prior)."""
    table = model.table
    pull = ((values - table.nominal) / table.tolerance)[free]
    return pull, np.full(len(pull), 1.0 if prior else 0.0)


def _prior_cost(model: Model, values: np.ndarray, free: np.ndarray, prior: bool) -> float:
    pull, weight = _prior(model, values, free, prior)
    return float(np.sum(weight * pull**2))
