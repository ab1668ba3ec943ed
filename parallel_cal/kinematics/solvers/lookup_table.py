"""Corrections of the nominal solution, stored on a grid and interpolated (section 6.1).

The calibrated solution is nominal solution + table. The table is filled once, with the exact
solver; it holds for one set of conditions. Smooth interpolation (B-splines) needs far fewer
points than linear interpolation, which is what a simple controller can do.

Prefer it where a controller can do no more than look up and interpolate.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import casadi as ca
import numpy as np

from parallel_cal.base.errors import SolveError
from parallel_cal.kinematics.evaluating import match_shape, with_status
from parallel_cal.kinematics.kinematics import Kinematics, Solutions, Status
from parallel_cal.model.model import Model

BUILDS = "a table of the whole workspace"
SIZE = 9  # grid points per given coordinate
MIN_SIZE = {"linear": 2, "smooth": 4}  # grid points per coordinate, by order
EDGE = 0.02  # of each side: margin of the grid around the workspace


@dataclass(frozen=True, eq=False)
class LookUpTable:
    """Corrections of a nominal solver on a grid.

    `axes`: grid values of each given coordinate. `values` (n1, n2, .., n_answers): corrections of
    the nominal joints (inverse problem only), then of position (m) and rotation (rad). `nominal`:
    the solver whose solutions they correct.
    """

    problem: str
    axes: tuple[np.ndarray, ...]
    values: np.ndarray
    order: str
    nominal: Kinematics

    @property
    def bytes(self) -> int:
        """Memory of the corrections if stored as 4-byte floats."""
        return 4 * self.values.size

    @cached_property
    def interpolant(self) -> ca.Function:
        """Given coordinates -> corrections; a CasADi function, so C code can be generated."""
        # CasADi expects the first axis to vary fastest and a point's corrections side by side.
        points = np.moveaxis(self.values, -1, 0).ravel(order="F")
        kind = "linear" if self.order == "linear" else "bspline"
        return ca.interpolant("table", kind, [list(a) for a in self.axes], points)

    def corrections(self, given: np.ndarray) -> np.ndarray:
        """Interpolate corrections (N, n_answers) at coordinates (N, n); NaN outside the grid."""
        found = np.array(self.interpolant(given.T)).T
        low, high = (np.array([a[i] for a in self.axes]) for i in (0, -1))
        found[~((given >= low) & (given <= high)).all(axis=1)] = np.nan
        return found


def direct(
    model: Model,
    q: np.ndarray,
    at: Mapping[str, Any] | None = None,
    size: int = SIZE,
    order: str = "smooth",
) -> Solutions:
    """Find nominal pose + table at joints q; status NOT_CONVERGED outside the table."""
    table = table_for(model, "direct", at, size, order)
    nominal = table.nominal.direct(np.atleast_2d(q), at)
    return match_shape(_apply_corrections(model, table, nominal, np.atleast_2d(q), at), q)


def inverse(
    model: Model,
    position: np.ndarray,
    rotation: np.ndarray | None = None,
    at: Mapping[str, Any] | None = None,
    size: int = SIZE,
    order: str = "smooth",
) -> Solutions:
    """Find nominal joints + table at controlled coordinates; NOT_CONVERGED outside the table."""
    table = table_for(model, "inverse", at, size, order)
    nominal = table.nominal.inverse(np.atleast_2d(position), rotation, at)
    given = model.mechanism.controlled_coordinates(nominal.position, nominal.rotation)
    return match_shape(_apply_corrections(model, table, nominal, given, at), position)


def table_for(
    model: Model, problem: str, at: Mapping[str, Any] | None, size: int, order: str
) -> LookUpTable:
    """Return the table of a model for one set of conditions; it is built at the first call."""
    if order not in MIN_SIZE:
        raise SolveError(f"order='{order}'; expected 'linear' or 'smooth'")
    least = MIN_SIZE[order]
    if size < least:
        raise SolveError(f"size={size}, but order='{order}' needs at least {least} points per axis")
    if any(np.ndim(v) for v in (at or {}).values()):
        raise SolveError("a look-up table is valid for one set of conditions; give single numbers")
    conditions = tuple(sorted((k, float(v)) for k, v in (at or {}).items()))
    return _build_table(model, problem, conditions, size, order)


@lru_cache(maxsize=8)
def _build_table(
    model: Model, problem: str, conditions: tuple[tuple[str, float], ...], size: int, order: str
) -> LookUpTable:
    at = dict(conditions)
    exact, nominal = Kinematics(model), Kinematics(model.with_values(model.table.nominal))
    workspace = model.mechanism.workspace
    low, high = np.array(workspace.low), np.array(workspace.high)
    if problem == "direct":  # the joints with which both robots reach the workspace
        coarse = _grid([np.linspace(a, b, 5) for a, b in zip(low, high, strict=True)])
        joints = np.vstack([_solve_at(k, "inverse", coarse, {}).joints for k in (exact, nominal)])
        low, high = np.nanmin(joints, axis=0), np.nanmax(joints, axis=0)
    edge = EDGE * (high - low)
    axes = tuple(np.linspace(a, b, size) for a, b in zip(low - edge, high + edge, strict=True))
    points = _grid(axes)
    wanted, usual = (_solve_at(k, problem, points, at) for k in (exact, nominal))
    values = wanted.configuration.change_from(usual.configuration)
    if problem == "direct":
        values = values[:, len(model.joints) :]
    failed = ~(_usable(wanted) & _usable(usual))
    if failed.any():
        raise SolveError(
            f"the {problem} problem has no solution at {int(failed.sum())} of "
            f"{len(points)} points of the look-up table; make the model's workspace "
            "smaller"
        )
    shape = tuple(len(a) for a in axes)
    return LookUpTable(problem, axes, values.reshape(*shape, -1), order, nominal)


def _grid(axes: Sequence[np.ndarray]) -> np.ndarray:
    return np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, len(axes))


def _solve_at(
    kinematics: Kinematics, problem: str, points: np.ndarray, at: Mapping[str, Any]
) -> Solutions:
    """Solutions at grid points: joints, or controlled coordinates like those of `Workspace`."""
    if problem == "direct":
        return kinematics.direct(points, at)
    return kinematics.inverse(*kinematics.model.mechanism.poses(points), at)


def _apply_corrections(
    model: Model,
    table: LookUpTable,
    nominal: Solutions,
    given: np.ndarray,
    at: Mapping[str, Any] | None,
) -> Solutions:
    """Nominal solutions with the table's corrections and the resulting residual."""
    change = table.corrections(given)
    still = np.zeros((len(given), len(model.joints) if table.problem == "direct" else 0))
    x = nominal.configuration.apply_change(np.hstack([still, change]))
    solutions = with_status(model, x.rows, at, np.inf, table.problem)
    usable = _usable(nominal)
    solutions.status[~usable] = nominal.status[~usable]
    solutions.status[usable & np.isnan(change).any(axis=1)] = Status.NOT_CONVERGED
    return solutions


def _usable(s: Solutions) -> np.ndarray:
    return (s.status == Status.CONVERGED) | (s.status == Status.OUTSIDE_LIMITS)
