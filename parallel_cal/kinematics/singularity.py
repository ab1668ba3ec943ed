"""Distance of a configuration from a direct and an inverse singularity (6.2.4)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from parallel_cal.kinematics.solutions import Solutions
from parallel_cal.model.model import Model


@dataclass(frozen=True)
class Distances:
    """Smallest scaled singular values (N,) of the closure's Jacobian in the pose (`direct`)
    and in joints and parasitic coordinates (`inverse`), and the signs of their determinants.
    Passive coordinates are unknowns of both.

    They are metres of closure error per metre of motion; 0 is singular. In a direct singularity
    the platform moves with locked joints, in an inverse one the joints move with a locked platform.
    If a determinant changes its sign along a path, the path passes a singularity.
    """

    direct: np.ndarray
    inverse: np.ndarray
    direct_sign: np.ndarray
    inverse_sign: np.ndarray


def distances(model: Model, solutions: Solutions, at: Mapping[str, Any] | None = None) -> Distances:
    """Compute both distances of N solved configurations."""
    direct, inverse = jacobians(model, solutions, at)
    return Distances(
        smallest_singular_values(direct),
        smallest_singular_values(inverse),
        _sign(direct),
        _sign(inverse),
    )


def jacobians(
    model: Model, solutions: Solutions, at: Mapping[str, Any] | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Compute d phi/d(unknowns) of forward and of inverse kinematics, (N, rows, unknowns) each,
    in metres."""
    s, m, n = model.structure, model.mechanism, len(model.joints)
    x = np.atleast_2d(solutions.configuration.rows)
    C = s.jacobians(x, model.condition_rows(at, len(x)), model.values)[0] / s.scale
    dependent = [*range(n), *(n + i for i in m.parasitic), *m.passive_columns]
    return C[:, :, m.dependent_columns], C[:, :, dependent]


def smallest_singular_values(J: np.ndarray) -> np.ndarray:
    """Compute the smallest singular value of each Jacobian; NaN if it is not finite."""
    finite = np.isfinite(J).all(axis=(1, 2))
    sizes = np.full(len(J), np.nan)
    if finite.any():
        sizes[finite] = np.linalg.svd(J[finite], compute_uv=False)[:, -1]
    return sizes


def _sign(J: np.ndarray) -> np.ndarray:
    """Sign of the determinant; 1 if there are more rows than unknowns."""
    signs = np.ones(len(J))
    if J.shape[1] == J.shape[2]:
        finite = np.isfinite(J).all(axis=(1, 2))
        signs[finite] = np.sign(np.linalg.det(J[finite]))
        signs[~finite] = np.nan
    return signs
