"""Forward and inverse kinematics with a solver chosen by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from parallel_cal.base.errors import SolveError
from parallel_cal.base.options import convert_options, split_options
from parallel_cal.kinematics.all_solutions import direct_all, inverse_all
from parallel_cal.kinematics.kinematics import Solutions
from parallel_cal.kinematics.solutions import make_unsolved, stack_solutions
from parallel_cal.model.model import Model
from parallel_cal.model.shelf import list_plugins, load_module, wrap_plugin_function

Conditions = Mapping[str, Any]
SHELF = "kinematics.solvers"


def direct(
    model: Model, q: np.ndarray, at: Conditions, every: bool = False, solver: str = ""
) -> Solutions:
    """Find poses for joints: one each for (N, nq), or `every` one for (nq,), home branch first.

    Without a `solver`, Newton's method is used, or the most complete method for `every` one.
    SolveError if the solver is unknown or does not support this model.
    """
    if not every:
        return _load_solver(solver, "direct", every)(model, np.atleast_2d(q), at)
    solve = _load_solver(solver, "direct", every)
    none = stack_solutions([make_unsolved(model, q=q)])
    if not np.isfinite(q).all():
        return none
    found = solve(model, q, at)
    return found if len(found) else replace(none, complete=found.complete)


def inverse(
    model: Model,
    r: np.ndarray,
    R: np.ndarray | None,
    at: Conditions,
    every: bool = False,
    solver: str = "",
) -> Solutions:
    """Find joints for positions and rotations: one each for (N, 3), or `every` one for (3,).

    Only the controlled coordinates of the pose count (`controlled_pose`).
    """
    r, R = controlled_pose(model, r, R)
    if not every:
        turned = None if R is None else np.reshape(R, (-1, 3, 3))
        return _load_solver(solver, "inverse", every)(model, np.atleast_2d(r), turned, at)
    found = _load_solver(solver, "inverse", every)(model, r, R, at)
    if len(found):
        return found
    return replace(stack_solutions([make_unsolved(model, r=r)]), complete=found.complete)


def controlled_pose(
    model: Model, r: np.ndarray, R: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray | None]:
    """Replace uncontrolled coordinates of the position by those of home.

    The rotation is None if the robot controls none of its coordinates.
    """
    controlled = model.mechanism.controlled
    ignored = [i for i in range(3) if i not in controlled]
    if ignored:
        r = np.array(r)
        r[..., ignored] = np.array(model.mechanism.home.position)[ignored]
    return r, (R if any(i >= 3 for i in controlled) else None)


def solvers() -> dict[str, str]:
    """List name and purpose of every solver: the last paragraph of its module's docstring."""
    docs = {name: load_module(SHELF, name).__doc__ or "" for name in list_plugins(SHELF)}
    return {name: " ".join(doc.split("\n\n")[-1].split()) for name, doc in docs.items()}


def get_build_note(solver: str) -> str:
    """Name what a solver builds before its first solution, if that takes long, else ''."""
    name = solver.partition(":")[0]
    on_shelf = name in list_plugins(SHELF)
    return getattr(load_module(SHELF, name), "BUILDS", "") if on_shelf else ""


def _load_solver(text: str, problem: str, every: bool) -> Callable[..., Solutions]:
    """Load a solver's function by `NAME[:option=value,...]`; NAME is a file on the shelf solvers/
    or a Python path. SolveError if there is none for this problem."""
    if every and not text:
        return direct_all if problem == "direct" else inverse_all
    name, given = split_options(text or "newton", "solver", SolveError)
    if "." not in name and name not in list_plugins(SHELF):
        raise SolveError(
            f"no solver '{name}'; there are {', '.join(list_plugins(SHELF))} "
            "(`--solver help` describes them), or the Python path of your own"
        )
    module = load_module(SHELF, name, SolveError)
    if not hasattr(module, "direct"):
        raise SolveError(f"{name} is not a solver: it has no function direct(model, q, at)")
    solve = getattr(module, f"{problem}_all" if every else problem, None)
    if solve is None and every:
        raise SolveError(f"{name} finds one solution; --all needs another solver, such as newton")
    if solve is None:
        raise SolveError(f"{name} does not solve the {problem} problem; use newton")
    options = convert_options(given, solve, name, SolveError)
    return partial(wrap_plugin_function(name, solve), **options)
