"""Plan an update of a calibration: how few of the planned poses show the usual drifts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from parallel_cal.identification.prior import Knowledge, Prior
from parallel_cal.identification.update import SHOWN_SIGMAS, list_culprits, update_prior
from parallel_cal.model.model import Model


@dataclass(frozen=True)
class UpdatePlan:
    """What the first poses of a plan tell about the drift since the last calibration.

    Attributes
    ----------
    order : tuple of int
        The poses of the plan, the most informative one first.
    information : array (n,)
        Information about the parameters after each of them, in nats: half the change of the log
        determinant of their covariance.
    shown : dict of str to array (n,)
        For each usual drift, by how many standard deviations a drift of one sigma exceeds what the
        noise and the uncertainty of the last calibration leave, after each pose. Whether it drifted
        needs fewer poses than which part did.
    """

    order: tuple[int, ...]
    information: np.ndarray
    shown: dict[str, np.ndarray]

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
            "information_nats": self.information.tolist(),
            "drift_sigmas": {name: column.tolist() for name, column in self.shown.items()},
        }


def order_for_update(
    model: Model, free: np.ndarray, prior: Prior, blocks: np.ndarray
) -> UpdatePlan:
    """Order poses by what each adds to those before it.

    Parameters
    ----------
    model : Model
    free : ndarray of bool (n_parameters,)
    prior : Prior
        The last calibration with the usual drift.
    blocks : ndarray (n, rows, n_free)
        Whitened Jacobian of each pose, columns in tolerances.
    """
    known = Knowledge.of(prior, model.table, free)
    size = np.linalg.inv(known.information)
    # The null hypothesis: nothing has drifted since the last calibration.
    still = Knowledge.of(update_prior(model, 0.0), model.table, free).information
    changes = {c.name: c.change[free] / known.tolerance for c in list_culprits(model)}
    changes = {name: c for name, c in changes.items() if np.abs(c).max() > 0}
    left, order, information = list(range(len(blocks))), list[int](), list[float]()
    shown: dict[str, list[float]] = {name: [] for name in changes}
    total, normal = 0.0, np.zeros_like(size)
    while left:
        gains = [
            np.linalg.slogdet(np.eye(blocks.shape[1]) + blocks[k] @ size @ blocks[k].T)[1] / 2
            for k in left
        ]
        best = left.pop(int(np.argmax(gains)))
        order.append(best)
        total += float(max(gains))
        information.append(total)
        normal = normal + blocks[best].T @ blocks[best]
        size = np.linalg.inv(known.information + normal)
        for name, c in changes.items():
            seen = c @ (normal - normal @ np.linalg.solve(still + normal, normal)) @ c
            shown[name].append(float(np.sqrt(max(seen, 0.0))))
    return UpdatePlan(
        tuple(order), np.array(information), {k: np.array(v) for k, v in shown.items()}
    )
