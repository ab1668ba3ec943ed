"""The direct and inverse problem with a solver chosen by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from importlib import import_module
from inspect import signature
from itertools import product
from typing import Any

import numpy as np

from parallel_cal.errors import SolveError
from parallel_cal.kinematics import CLOSED, Kinematics, Solutions, Status
from parallel_cal.mechanism import shelf_names
from parallel_cal.model import Model
from parallel_cal.rotation import quaternion_to_matrix

Conditions = Mapping[str, Any]
Solver = tuple[Callable[..., Solutions], Callable[..., Solutions]]


def direct(
    model: Model, q: np.ndarray, at: Conditions, every: bool = False, solver: str = "newton"
) -> Solutions:
    """Poses for joints: one each for (N, nq), or `every` one for (nq,), home branch first.

    SolveError where the solver is unknown or not made for this model.
    """
    return _solver(solver)[0](model, q, at, every)


def inverse(
    model: Model,
    r: np.ndarray,
    R: np.ndarray | None,
    at: Conditions,
    every: bool = False,
    solver: str = "newton",
) -> Solutions:
    """Joints for positions and rotations: one each for (N, 3), or `every` one for (3,)."""
    return _solver(solver)[1](model, r, R, at, every)


def _solver(name: str) -> Solver:
    """A solver by name: Newton's method, the closed form, or a file on the shelf solvers/."""
    if name in SOLVERS:
        return SOLVERS[name]
    if name not in shelf_names("solvers") or not _is_solver(name):
        others = [n for n in shelf_names("solvers") if n not in SOLVERS and _is_solver(n)]
        raise SolveError(f"no solver '{name}'; there are {', '.join([*SOLVERS, *others])}")
    module = import_module(f"parallel_cal.solvers.{name}")
    return partial(_shelf_direct, module), partial(_shelf_inverse, module)


def _is_solver(name: str) -> bool:
    """Whether a file offers `direct(model, q, at)` and `inverse(model, position, rotation, at)`."""
    function = getattr(import_module(f"parallel_cal.solvers.{name}"), "direct", None)
    return function is not None and next(iter(signature(function).parameters)) == "model"


def _shelf_direct(module: Any, model: Model, q: np.ndarray, at: Conditions, every: bool) -> Any:
    if not every:
        return module.direct(model, np.atleast_2d(q), at)
    found = _all_of(module, "direct_all")(model, q, at)
    return found if len(found) else _unsolved(model, q, None)


def _shelf_inverse(
    module: Any, model: Model, r: np.ndarray, R: np.ndarray | None, at: Conditions, every: bool
) -> Any:
    if every:
        found = _all_of(module, "inverse_all")(model, r, R, at)
        return found if len(found) else _unsolved(model, None, r)
    turned = None if R is None else np.reshape(R, (-1, 3, 3))
    return module.inverse(model, np.atleast_2d(r), turned, at)


def _all_of(module: Any, name: str) -> Callable[..., Solutions]:
    """A solver's function that finds every solution; SolveError where it has none."""
    if not hasattr(module, name):
        short = module.__name__.rsplit(".", 1)[-1]
        raise SolveError(f"{short} finds one solution; --all needs another solver, newton")
    return getattr(module, name)


# ---------------------------------------------------------------------------------- newton


def _newton_direct(model: Model, q: np.ndarray, at: Conditions, every: bool) -> Solutions:
    kinematics = Kinematics(model)
    return kinematics.direct_all(q, at) if every else kinematics.direct(np.atleast_2d(q), at)


def _newton_inverse(
    model: Model, r: np.ndarray, R: np.ndarray | None, at: Conditions, every: bool
) -> Solutions:
    kinematics = Kinematics(model)
    if every:
        return kinematics.inverse_all(r, R, at)
    return kinematics.inverse(np.atleast_2d(r), R, at)


# ---------------------------------------------------------------------------------- closed form


def _closed_direct(model: Model, q: np.ndarray, at: Conditions, every: bool) -> Solutions:
    """The candidates themselves, where the closure says that they are exact."""
    if q.ndim == 2:
        return _stacked([_closed_direct(model, row, _at(at, i), every) for i, row in enumerate(q)])
    home = np.array(model.mechanism.home.position)
    columns = np.array(model.structure.candidates(q, model.values)).T
    found = [(q, c[:3], c[3:].reshape(3, 3)) for c in columns if np.isfinite(c).all()]
    found.sort(key=lambda s: float(np.linalg.norm(s[1] - home)))
    return _judged(model, found, at, every) or _unsolved(model, q, None)


def _closed_inverse(
    model: Model, r: np.ndarray, R: np.ndarray | None, at: Conditions, every: bool
) -> Solutions:
    if r.ndim == 2:
        turns = [None] * len(r) if R is None else np.reshape(R, (-1, 3, 3))
        rows = zip(r, turns, strict=True)
        return _stacked(
            [_closed_inverse(model, *row, _at(at, i), every) for i, row in enumerate(rows)]
        )
    home = np.array(model.mechanism.home.joints)
    R = quaternion_to_matrix(np.array(model.mechanism.home.quaternion)) if R is None else R
    choices = model.structure.joint_candidates.call([r, R.ravel(), model.values])
    sets = [np.array(c) for c in product(*(np.array(c).ravel() for c in choices))]
    found = [(q, r, R) for q in sets if np.isfinite(q).all()]
    found.sort(key=lambda s: float(np.sum(1 - np.cos(s[0] - home))))
    return _judged(model, found, at, every) or _unsolved(model, None, r)


def _judged(
    model: Model,
    found: list[tuple[np.ndarray, np.ndarray, np.ndarray]],
    at: Conditions,
    every: bool,
) -> Solutions | None:
    """The exact ones with status; SolveError where there are candidates but none is exact."""
    if not found:
        return None
    q, r, R = (np.array(part) for part in zip(*found, strict=True))
    configuration = np.hstack([q, r, R.reshape(len(R), 9)])
    conditions = model.condition_rows(at, len(q))
    phi = model.structure.closure_batch(configuration, conditions, model.values)
    residual = np.linalg.norm(phi[0], axis=1)
    exact = np.flatnonzero(residual < CLOSED)
    if not len(exact):
        raise SolveError(
            f"closed_form is not exact for this {model.mechanism.name} and its effects "
            f"(off by {residual.min():.2g} m); there is newton"
        )
    limits = np.array(model.mechanism.joint_limits)
    inside = ((q >= limits[:, 0]) & (q <= limits[:, 1])).all(axis=1)
    status = np.where(inside, Status.CONVERGED, Status.OUTSIDE_LIMITS)
    return Solutions(q, r, R, residual, status)[exact if every else exact[:1]]


def _unsolved(model: Model, q: np.ndarray | None, r: np.ndarray | None) -> Solutions:
    """The one answer where nothing is real: out of reach, or not a number to begin with."""
    given = q if q is not None else r
    bad = given is not None and not np.isfinite(given).all()
    status = Status.INVALID_INPUT if bad else Status.UNREACHABLE
    nan = np.full((1, 12), np.nan)
    joints = np.full((1, len(model.joints)), np.nan) if q is None else q[None]
    position = nan[:, :3] if r is None else r[None]
    return Solutions(joints, position, nan[:, 3:].reshape(1, 3, 3), nan[:, 0], np.array([status]))


def _at(at: Conditions, i: int) -> dict[str, float]:
    """The conditions of row i, where some are columns."""
    return {name: float(np.ravel(v)[i] if np.ndim(v) else v) for name, v in at.items()}


def _stacked(found: list[Solutions]) -> Solutions:
    parts = ("joints", "position", "rotation", "residual", "status")
    q, r, R, residual, status = (np.concatenate([getattr(s, p) for s in found]) for p in parts)
    return Solutions(q, r, R, residual, status)


SOLVERS: dict[str, Solver] = {
    "newton": (_newton_direct, _newton_inverse),
    "closed_form": (_closed_direct, _closed_inverse),
}
