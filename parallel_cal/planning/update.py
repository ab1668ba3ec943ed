"""Plan an update of a calibration: how few of the planned poses show the usual drifts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from parallel_cal.identification.drift_test import Columns, DriftTest
from parallel_cal.identification.observations import Observations
from parallel_cal.identification.prior import Knowledge, Prior
from parallel_cal.identification.recheck import CERTAINTY
from parallel_cal.identification.update import SHOWN_SIGMAS, list_culprits, update_prior
from parallel_cal.model.model import Model

DRAWS = 200  # sessions in which nothing has changed, to see when that is decided
SHARES = (0.5, 0.9)
EXCLUSION = 0.25  # of the squared sigmas of a change: what is left of it is exp of minus so much


@dataclass(frozen=True)
class UpdatePlan:
    """What the first poses of a plan tell about the drift since the last calibration.

    Attributes
    ----------
    order : tuple of int
        The poses of the plan; first those that exclude most changes that would count.
    information : array (n,)
        Information about the parameters after each of them, in nats: half the change of the log
        determinant of their covariance.
    shown : dict of str to array (n,)
        For each usual drift, by how many standard deviations a drift of one sigma exceeds what the
        noise and the uncertainty of the last calibration leave, after each pose. Whether it drifted
        needs fewer poses than which part did.
    unchanged : tuple of (int or None)
        If nothing has changed, the number of poses after which this is decided with 95 %, in half
        of the sessions and in 90 %; None if all poses of the plan decide it in fewer.
    """

    order: tuple[int, ...]
    information: np.ndarray
    shown: dict[str, np.ndarray]
    unchanged: tuple[int | None, ...] = ()

    @property
    def invisible(self) -> tuple[str, ...]:
        """Usual drifts that all poses of the plan together do not show at 3 sigma."""
        return tuple(name for name, column in self.shown.items() if column[-1] < SHOWN_SIGMAS)

    @property
    def enough(self) -> int | None:
        """The fewest poses after which each drift is shown that the plan can show; None if it shows
        none."""
        seen = [column for name, column in self.shown.items() if name not in self.invisible]
        return max(int(np.argmax(column >= SHOWN_SIGMAS)) + 1 for column in seen) if seen else None

    def document(self) -> dict[str, Any]:
        """The part of the JSON document of `parallel-cal plan` about the update."""
        return {
            "enough": self.enough,
            "invisible": list(self.invisible),
            "unchanged_after": {
                f"{share:g}": n for share, n in zip(SHARES, self.unchanged, strict=True)
            },
            "information_nats": self.information.tolist(),
            "drift_sigmas": {name: column.tolist() for name, column in self.shown.items()},
        }


def order_for_update(
    model: Model, free: np.ndarray, prior: Prior, blocks: np.ndarray, seen: Observations
) -> UpdatePlan:
    """Order poses so that few of them decide whether anything has changed.

    Parameters
    ----------
    model : Model
    free : ndarray of bool (n_parameters,)
    prior : Prior
        The last calibration with the usual drift.
    blocks : ndarray (n, rows, n_free)
        Whitened Jacobian of each pose, columns in tolerances.
    seen : Observations
        The poses, as they are expected to be measured.
    """
    columns = Columns.of(model, seen)
    test = DriftTest.of(model, columns)
    order = _order_by_exclusion(test, columns)
    known = Knowledge.of(prior, model.table, free)
    size = np.linalg.slogdet(known.information)[1]
    # The null hypothesis: nothing has drifted since the last calibration.
    still = Knowledge.of(update_prior(model, 0.0), model.table, free).information
    changes = {c.name: c.change[free] / known.tolerance for c in list_culprits(model)}
    changes = {name: c for name, c in changes.items() if np.abs(c).max() > 0}
    shown: dict[str, list[float]] = {name: [] for name in changes}
    information, normal = list[float](), np.zeros_like(still)
    for k in order:
        normal = normal + blocks[k].T @ blocks[k]
        information.append((np.linalg.slogdet(known.information + normal)[1] - size) / 2)
        for name, c in changes.items():
            squares = c @ (normal - normal @ np.linalg.solve(still + normal, normal)) @ c
            shown[name].append(float(np.sqrt(max(squares, 0.0))))
    return UpdatePlan(
        tuple(order),
        np.array(information),
        {k: np.array(v) for k, v in shown.items()},
        _count_until_unchanged(test, columns, order),
    )


def _order_by_exclusion(test: DriftTest, columns: Columns) -> list[int]:
    """Order poses; each next one leaves least of the single changes that would count."""
    J, left = columns.jacobian / np.sqrt(test.variance), list(range(len(columns.jacobian)))
    order, A, n = list[int](), np.zeros_like(test.C0), len(test.C0)
    squares = np.zeros(test.singles.shape[1])  # of each change, in sigmas
    while left:
        known = np.linalg.solve(np.eye(n) + test.C0 @ A, test.C0)
        new = J[left] @ (test.singles - known @ (A @ test.singles))
        spread = np.eye(J.shape[1]) + J[left] @ known @ J[left].transpose(0, 2, 1)
        gains = np.einsum("kie,kie->ke", new, np.linalg.solve(spread, new))
        least = np.exp(-EXCLUSION * (squares + gains)).sum(axis=1)
        k = int(np.argmin(least))
        squares = squares + gains[k]
        order.append(left.pop(k))
        A = A + J[order[-1]].T @ J[order[-1]]
    return order


def _count_until_unchanged(
    test: DriftTest, columns: Columns, order: list[int]
) -> tuple[int | None, ...]:
    """Return after how many poses it is decided that nothing has changed, for each of `SHARES`."""
    rng, n = np.random.default_rng(0), len(test.C0)
    values, vectors = np.linalg.eigh(test.C0)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    errors = root @ rng.standard_normal((n, DRAWS))
    A, b, after = np.zeros((n, n)), np.zeros((n, DRAWS)), np.full(DRAWS, np.inf)
    for count, k in enumerate(order, 1):
        J = columns.jacobian[k]
        noise = np.sqrt(test.variance) * rng.standard_normal((len(J), DRAWS))
        A, b = A + J.T @ J, b - J.T @ (J @ errors + noise)
        singles = test.log_factors(A, b)[1].max(axis=1, initial=-np.inf)
        decided = singles <= np.log(1 / CERTAINTY - 1)
        after = np.where(decided, np.minimum(after, count), after)
    found = np.quantile(after, SHARES, method="higher")
    return tuple(int(one) if np.isfinite(one) else None for one in found)
