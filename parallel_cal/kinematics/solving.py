"""The direct and inverse problem with a solver chosen by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from inspect import signature
from itertools import product
from typing import Any

import numpy as np

from parallel_cal.base.errors import SolveError
from parallel_cal.base.rotation import quaternion_to_matrix
from parallel_cal.kinematics.kinematics import CLOSED, Kinematics, Solutions, Status
from parallel_cal.kinematics.solutions import concatenated
from parallel_cal.kinematics.solvers._common import home_first, sample, with_status
from parallel_cal.model.mechanism import poses_in_workspace
from parallel_cal.model.model import Model
from parallel_cal.model.shelf import load_module, own, shelf_names

Conditions = Mapping[str, Any]
Candidate = tuple[np.ndarray, np.ndarray, np.ndarray]  # joints, position, rotation
Solver = tuple[Callable[..., Solutions], Callable[..., Solutions]]
SHELF = "kinematics.solvers"


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
    """Joints for positions and rotations: one each for (N, 3), or `every` one for (3,).

    Of the pose only what the robot controls counts (`controlled_pose`).
    """
    return _solver(solver)[1](model, *controlled_pose(model, r, R), at, every)


def controlled_pose(
    model: Model, r: np.ndarray, R: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray | None]:
    """The pose with what the robot does not control taken from home; None: all of the rotation."""
    controlled = model.mechanism.controlled
    ignored = [i for i in range(3) if i not in controlled]
    if ignored:
        r = np.array(r)
        r[..., ignored] = np.array(model.mechanism.home.position)[ignored]
    return r, (R if any(i >= 3 for i in controlled) else None)


def _solver(text: str) -> Solver:
    """A solver by `NAME[:option=value,...]`: Newton's method, the closed form, a file on the
    shelf solvers/, or the file at a Python path."""
    name, _, given = text.partition(":")
    if name in SOLVERS:
        if given:
            raise SolveError(f"{name} has no options, '{given}' given")
        return SOLVERS[name]
    if "." not in name and not (name in shelf_names(SHELF) and _is_solver(name)):
        known = [*SOLVERS, *filter(_is_solver, sorted({*shelf_names(SHELF)} - {*SOLVERS}))]
        raise SolveError(
            f"no solver '{name}'; there are {', '.join(known)}, or the Python path of your own"
        )
    module = load_module(SHELF, name, SolveError)
    if not _is_solver(name):
        raise SolveError(f"{name} is no solver: it has no direct(model, q, at)")
    return partial(_shelf_direct, module, given), partial(_shelf_inverse, module, given)


def _options(solve: Callable[..., Solutions], given: str) -> dict[str, Any]:
    """`half_steps=5,rough=true` as keyword arguments, of the types of the function's defaults."""
    defaults = {p.name: p.default for p in signature(solve).parameters.values()}
    known = {k: v for k, v in defaults.items() if isinstance(v, (bool, int, float, str))}
    options = {}
    for item in filter(None, given.split(",")):
        key, _, value = (part.strip() for part in item.partition("="))
        try:
            options[key] = _like(known[key], value)
        except (KeyError, ValueError):
            words = ", ".join(f"{k}={v}" for k, v in known.items())
            expected = f"expected one of {words}" if words else "this solver has none"
            raise SolveError(f"solver option '{item}': {expected}") from None
    return options


def _like(default: Any, text: str) -> Any:
    """Text as a value of the default's type; ValueError where it is none."""
    if isinstance(default, bool):
        return bool(("false", "true").index(text.lower()))
    return type(default)(text)


def _is_solver(name: str) -> bool:
    """Whether a file offers `direct(model, q, at)` and `inverse(model, position, rotation, at)`."""
    function = getattr(load_module(SHELF, name, SolveError), "direct", None)
    return function is not None and next(iter(signature(function).parameters)) == "model"


def _shelf_direct(
    module: Any, given: str, model: Model, q: np.ndarray, at: Conditions, every: bool
) -> Any:
    solve = _one_of(module, "direct", every)
    options = _options(solve, given)
    if not every:
        return solve(model, np.atleast_2d(q), at, **options)
    found = solve(model, q, at, **options)
    return found if len(found) else _unsolved(model, q, None)


def _shelf_inverse(
    module: Any,
    given: str,
    model: Model,
    r: np.ndarray,
    R: np.ndarray | None,
    at: Conditions,
    every: bool,
) -> Any:
    solve = _one_of(module, "inverse", every)
    options = _options(solve, given)
    if every:
        found = solve(model, r, R, at, **options)
        return found if len(found) else _unsolved(model, None, r)
    turned = None if R is None else np.reshape(R, (-1, 3, 3))
    return solve(model, np.atleast_2d(r), turned, at, **options)


def _one_of(module: Any, problem: str, every: bool) -> Callable[..., Solutions]:
    """A solver's function for one solution or `every`; SolveError where it has none."""
    short = module.__name__.removeprefix(f"parallel_cal.{SHELF}.")
    wanted = f"{problem}_all" if every else problem
    if hasattr(module, wanted):
        return own(short, getattr(module, wanted))
    if every:
        raise SolveError(f"{short} finds one solution; --all needs another solver, newton")
    raise SolveError(f"{short} does not solve the {problem} problem; use newton")


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
        return concatenated(
            [_closed_direct(model, row, sample(at, i) or {}, every) for i, row in enumerate(q)]
        )
    exact = _exact(model, _poses(model, q), at, "direct")
    if exact is None:
        return _unsolved(model, q, None)
    order = home_first(model, exact, at)
    return exact[order if every else order[:1]]


def _closed_inverse(
    model: Model, r: np.ndarray, R: np.ndarray | None, at: Conditions, every: bool
) -> Solutions:
    if r.ndim == 2:
        turns = [None] * len(r) if R is None else np.reshape(R, (-1, 3, 3))
        rows = zip(r, turns, strict=True)
        return concatenated(
            [_closed_inverse(model, *row, sample(at, i) or {}, every) for i, row in enumerate(rows)]
        )
    home = np.array(model.mechanism.home.joints)
    R = quaternion_to_matrix(np.array(model.mechanism.home.quaternion)) if R is None else R
    found = sorted(_joint_sets(model, r, R), key=lambda s: np.sum(1 - np.cos(s[0] - home)))
    exact = _exact(model, found, at, "inverse")
    if exact is None:
        return _unsolved(model, None, r)
    return exact if every else exact[:1]


def _poses(model: Model, q: np.ndarray) -> list[Candidate]:
    columns = np.array(model.structure.candidates(q, model.values)).T
    return [(q, c[:3], c[3:].reshape(3, 3)) for c in columns if np.isfinite(c).all()]


def _joint_sets(model: Model, r: np.ndarray, R: np.ndarray) -> list[Candidate]:
    choices = model.structure.joint_candidates.call([r, R.ravel(), model.values])
    sets = [np.array(c) for c in product(*(np.array(c).ravel() for c in choices))]
    return [(q, r, R) for q in sets if np.isfinite(q).all()]


def _exact(model: Model, found: list[Candidate], at: Conditions, problem: str) -> Solutions | None:
    """The exact ones with status; SolveError where none is, in the workspace neither."""
    if not found:
        return None
    solutions = _judged(model, found, at, problem)
    exact = np.flatnonzero(solutions.residual < CLOSED)
    if len(exact):
        return solutions[exact]
    off = _off_within(model, at, problem)
    if off < CLOSED:  # the formula holds for this model: the sample is out of reach
        return None
    raise SolveError(
        f"closed_form is not exact for this {model.mechanism.name} and its effects "
        f"(off by {off:.2g} m); there is newton"
    )


def _off_within(model: Model, at: Conditions, problem: str) -> float:
    """The largest residual (m) of the formula's best answers at five poses of the workspace."""
    r, R = poses_in_workspace(model.mechanism, 5, np.random.default_rng(0))
    solved = Kinematics(model).inverse(r, R, at)
    direct = problem == "direct"
    found = [
        _poses(model, solved.joints[i]) if direct else _joint_sets(model, r[i], R[i])
        for i in np.flatnonzero(solved.ok)
    ]
    best = [_judged(model, sets, at, problem).residual.min() for sets in found if sets]
    return float(max(best, default=np.inf))


def _judged(model: Model, found: list[Candidate], at: Conditions, problem: str) -> Solutions:
    rows = np.array([np.concatenate([q, r, R.ravel()]) for q, r, R in found])
    return with_status(model, rows, at, CLOSED, problem)


def _unsolved(model: Model, q: np.ndarray | None, r: np.ndarray | None) -> Solutions:
    """The one answer where nothing is real: out of reach, or not a number to begin with."""
    given = q if q is not None else r
    bad = given is not None and not np.isfinite(given).all()
    status = Status.INVALID_INPUT if bad else Status.UNREACHABLE
    nan = np.full((1, 12), np.nan)
    joints = np.full((1, len(model.joints)), np.nan) if q is None else q[None]
    position = nan[:, :3] if r is None else r[None]
    return Solutions(joints, position, nan[:, 3:].reshape(1, 3, 3), nan[:, 0], np.array([status]))


SOLVERS: dict[str, Solver] = {
    "newton": (_newton_direct, _newton_inverse),
    "closed_form": (_closed_direct, _closed_inverse),
}
