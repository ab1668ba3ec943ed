"""Semiparametric calibration: independent linear factors instead of parameters (5.3.8).

The closure, expanded by program (`_separation`, `_factors`), becomes M_0 + sum f_j M_j = 0 with
one free number for each independent factor: 3 for the slider-crank, 36 for model 24. Its direct
and inverse problems are those of any mechanism. It fits well, but its factors are not dimensions
of parts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np

from parallel_cal.base.errors import FitError
from parallel_cal.identification.descent import (
    check_measured,
    make_estimate_at,
    propagate_covariance,
)
from parallel_cal.identification.estimate import Estimate, EstimationProblem
from parallel_cal.identification.linearisation import Linearisation
from parallel_cal.identification.methods import implicit
from parallel_cal.identification.observations import Observations
from parallel_cal.identification.prior import Prior
from parallel_cal.identification.thresholds import ROUNDING
from parallel_cal.model.mechanism import Mechanism
from parallel_cal.model.model import Model, new_model
from parallel_cal.model.parameters import Named, Parameter, ParameterTable
from parallel_cal.thesis.methods._factors import Row, separate_factors

ITERATIONS = 20


class FactorMechanism(Mechanism):
    """Another mechanism's closure with free factors, with its home, workspace and limits."""

    def __init__(self, model: Model, rows: Sequence[Row]):
        m = model.mechanism
        self.rows, self.origin = tuple(rows), model
        self.joints, self.joint_unit, self.periodic = m.joints, m.joint_unit, m.periodic
        self.moves, self.controls = m.moves, m.controls
        self.home, self.workspace, self.length = m.home, m.workspace, m.length
        self.joint_limits = m.joint_limits
        table = []
        for i, row in enumerate(rows):
            # The tolerance of a factor follows from the tolerances of the parameters.
            J = np.array(row.jacobian(model.values))
            tolerance = np.linalg.norm(J * model.table.tolerance, axis=1)
            tolerance = np.maximum(tolerance, 1e-3 * tolerance.max(initial=1e-12))
            for j, (f, t) in enumerate(zip(row.factors(model.values), tolerance, strict=True)):
                table.append(Parameter(f"row{i + 1}.f{j + 1}", "1", float(f), float(t), "factor"))
        self.parameters = ParameterTable(table)

    def closure(self, q: Any, r: Any, R: Any, p: Named) -> Any:
        """Eq. 5.40 for every row, in metres."""
        s = self.origin.structure
        at = ca.vertcat(q, r, ca.vec(ca.SX(R).T))
        rows = []
        for i, row in enumerate(self.rows):
            both = ca.vertcat(row.lead, row.monomials)
            M = ca.Function("monomials", [s.configuration], [both])(at)
            f = ca.vertcat(1, *[p[f"row{i + 1}.f{j + 1}"] for j in range(len(row))])
            rows.append(row.scale * ca.dot(f, M))
        return ca.vertcat(*rows)

    def _as_named(self) -> Named:
        m = self.origin.mechanism.parameters
        return Named(m.names, ca.SX(ca.DM(self.origin.values[: len(m)])))

    def candidates(self, q: Any, p: Named) -> list[tuple[Any, Any]]:
        """The candidates of the parametric model."""
        return self.origin.mechanism.candidates(q, self._as_named())

    def joint_candidates(self, r: Any, R: Any, p: Named) -> list[tuple[Any, ...]]:
        return self.origin.mechanism.joint_candidates(r, R, self._as_named())


@lru_cache(maxsize=16)
def make_factor_model(model: Model) -> Model:
    """The model with its linear factors as parameters; FitError if it cannot be separated."""
    factors = new_model(FactorMechanism(model, separate_factors(model)))
    return replace(factors, noise=model.noise, frames=model.frames)


def identify(model: Model, observations: Observations, weighted: bool = True) -> Model:
    """Fit the semiparametric model (eq. 5.41), to use in place of the parametric one.

    `weighted=False` is the method of the thesis: each row by SVD, without a start. Factors that the
    data do not determine keep the value of the given model. By default the linear solution is
    refined as in implicit calibration, weighted by inherited noise; only then it has a covariance.
    """
    factors = make_factor_model(model)
    free = np.ones(len(factors.values), dtype=bool)
    phi, M = closure_rows(factors, observations)
    linear = factors.with_values(factors.values - _inverse(factors, M) @ phi)
    if not weighted:
        return linear
    found = implicit.estimate(linear, observations, free)
    return linear.with_values(found.values, found.covariance)


def _inverse(factors: Model, M: np.ndarray) -> np.ndarray:
    """The linear map (n_factors, N * rows) from closure errors to minus the least-squares change of
    all factors; the closure is linear in them."""
    tolerance = factors.table.tolerance
    return np.asarray(tolerance[:, None] * np.linalg.pinv(M * tolerance, rcond=1e-12))


def closure_rows(model: Model, observations: Observations) -> tuple[np.ndarray, np.ndarray]:
    """phi (N * rows,) and its derivative by all parameters, at the measured configurations."""
    m, n = model.mechanism, len(model.joints)
    check_measured(
        observations,
        np.array([n + i for i in m.moved]),
        list(m.moves),
        "semiparametric or cascaded",
    )
    free = np.ones(len(model.values), dtype=bool)
    phi, _, J = Linearisation(model, observations, free, False).blocks(model.values, observations.x)
    return phi.ravel(), J.reshape(-1, J.shape[2])


def estimate(
    model: Model, observations: Observations, free: np.ndarray, prior: bool | Prior | None = False
) -> Estimate:
    """Find the parameters whose factors are nearest to the best linear factors.

    The solution is exact if there are as many factors as parameters (slider-crank). Otherwise the
    information about the factors weights them, or the result would fit badly (footnote to 5.3.8).
    The measured noise is not used as a weight, as in the thesis; sigma is that of this method.
    FitError with a prior.
    """
    if prior:
        raise FitError("semiparametric calibration takes no prior; use the implicit method")
    factors = make_factor_model(model)
    _, M = closure_rows(factors, observations)
    triangle = np.asarray(np.linalg.qr(M, mode="r"))
    return extract_parameters(
        EstimationProblem(model, free), observations, _inverse(factors, M), triangle
    )


def extract_parameters(
    sought: EstimationProblem, observations: Observations, inverse: np.ndarray, weight: np.ndarray
) -> Estimate:
    """Minimise |weight (f(p) - target)| over the parameters p, by Gauss-Newton (eq. 5.35).

    `inverse` (n_factors, N * rows) makes the closure's errors phi the linear target
    f - inverse phi.
    """
    factors, free, tolerance = make_factor_model(sought.model), sought.free, sought.tolerance
    mechanism, values = factors.mechanism, np.array(sought.model.values)
    assert isinstance(mechanism, FactorMechanism)
    target = factors.values - inverse @ closure_rows(factors, observations)[0]
    for _ in range(ITERATIONS):
        f = np.concatenate([row.factors(values) for row in mechanism.rows])
        J = np.vstack([np.array(row.jacobian(values)) for row in mechanism.rows])[:, free]
        A = weight @ J * tolerance
        step = np.linalg.lstsq(A, weight @ (target - f), rcond=1e-10)[0]
        values[free] += tolerance * step
        if np.abs(step).max() < ROUNDING:
            break
    else:
        raise FitError(
            f"no parameters fit the linear factors in {ITERATIONS} iterations; use the implicit "
            "method"
        )
    influence = -tolerance[:, None] * np.linalg.pinv(A, rcond=1e-10) @ weight @ inverse
    # The rows of the factors differ from those of the model, in which a root may not be squared.
    at_end = np.concatenate([row.factors(values) for row in mechanism.rows])
    covariance = propagate_covariance(influence, factors, at_end, observations)
    return make_estimate_at(sought, values, observations, covariance, 0)
