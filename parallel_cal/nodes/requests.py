"""Answers to ComputeFK and ComputeIK requests, each from one model alone."""

from __future__ import annotations

from array import array
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from parallel_cal_msgs.msg import SolutionSet

from parallel_cal.base.errors import SolveError
from parallel_cal.kinematics import solving
from parallel_cal.kinematics.kinematics import Solutions, Status
from parallel_cal.nodes.conversions import (
    conditions_of,
    invalid_solution,
    joint_order,
    pose_numbers,
    solution_messages,
)
from parallel_cal.nodes.model_server import Served

Rows = tuple[np.ndarray, ...]
At = dict[str, float] | None
# A singular pose has no finite covariance.
SOLVED = (Status.CONVERGED, Status.OUTSIDE_LIMITS)


def answer(served: Served | None, why_none: str, request: Any, response: Any) -> Any:
    """The response of either service; a request that cannot be understood gets a message."""
    if served is None:
        response.message = f"no model in use: {why_none}"
        return response
    response.model_hash = served.hash
    try:
        if hasattr(request, "targets"):
            response.joint_names = served.model.joints
            response.results = _inverse(served, request)
        else:
            response.results = _direct(served, request)
    except Exception as error:  # a user's own mechanism may raise anything; the node stays up
        response.results, response.message = [], str(error) or type(error).__name__
    return response


def _direct(served: Served, request: Any) -> list[SolutionSet]:
    model, at = served.model, conditions_of(served.model, request.conditions)
    names = request.joint_names
    order = joint_order(names, model.joints) if names else None
    if names and len(names) != len(model.joints):
        extra = ", ".join(n for n in names if n not in model.joints) or "one of them twice"
        raise SolveError(f"joint_names: {extra} besides {', '.join(model.joints)}")
    given = [_configuration(c.positions, order, len(model.joints)) for c in request.configurations]
    solve = _solver(served, request, at)
    noise = model.noise.joint or 0.0

    def covariance(solution: Solutions) -> np.ndarray:
        return served.kinematics.direct_covariance(solution, at, noise)

    return _sets(served, request, given, solve, covariance)


def _inverse(served: Served, request: Any) -> list[SolutionSet]:
    at = conditions_of(served.model, request.conditions)
    given = [_target(target) for target in request.targets]
    solve = _solver(served, request, at)

    def covariance(solution: Solutions) -> np.ndarray:
        return served.kinematics.inverse_covariance(solution, at)

    return _sets(served, request, given, solve, covariance)


def _configuration(positions: Any, order: list[int] | None, n: int) -> Rows | str:
    if len(positions) != n:
        return f"{len(positions)} positions, expected {n}"
    q = np.asarray(positions)
    return (q if order is None else q[order],)


def _target(pose: Any) -> Rows | str:
    try:
        return pose_numbers(pose)
    except SolveError as error:
        return str(error)


def _solver(served: Served, request: Any, at: At) -> Callable[..., Solutions]:
    """How this request wants its rows solved."""
    every, k, model = request.all_solutions, served.kinematics, served.kinematics.model
    inverse = hasattr(request, "targets")
    if every or request.solver:
        named: Callable[..., Solutions] = solving.inverse if inverse else solving.direct

        def by_name(*rows: Any) -> Solutions:
            found = named(model, *rows, at or {}, every, request.solver)
            return found[0] if np.ndim(rows[0]) == 1 and not every else found

        return by_name
    if inverse:
        return lambda r, R: k.inverse(*solving.controlled_pose(model, r, R), at)
    return lambda q: k.direct(q, at)


def _sets(
    served: Served,
    request: Any,
    given: Sequence[Rows | str],
    solve: Callable[..., Solutions],
    covariance: Callable[[Solutions], np.ndarray],
) -> list[SolutionSet]:
    """One set a row: solved together where each has one answer, one by one where all count."""
    good = [row for row in given if not isinstance(row, str)]
    if request.all_solutions or len(good) == 1:
        found = [solve(*row) for row in good]
        messages = [solution_messages(each) for each in found]
    elif good:
        found = [solve(*(np.array(part) for part in zip(*good, strict=True)))]
        messages = [[message] for message in solution_messages(found[0])]
    else:
        found, messages = [], []
    if request.with_covariance and served.model.covariance is not None:
        _add_covariances(found, messages, covariance)
    answered = iter(messages)
    # Only a search for all solutions counts them, and then each row has a search of its own.
    counted = iter(found if request.all_solutions else [])
    return [
        SolutionSet(solutions=[invalid_solution(row)], count_complex=-1)
        if isinstance(row, str)
        else SolutionSet(solutions=next(answered), **_counted(next(counted, None)))
        for row in given
    ]


def _counted(found: Solutions | None) -> dict[str, Any]:
    count = None if found is None else found.count_complex
    return {
        "count_complex": -1 if count is None else count,
        "complete": found is not None and bool(found.complete),
    }


def _add_covariances(
    found: list[Solutions],
    messages: list[list[Any]],
    covariance: Callable[[Solutions], np.ndarray],
) -> None:
    singles = (s for several in found for s in _each(several))
    for message, solution in zip((m for row in messages for m in row), singles, strict=True):
        if solution.status in SOLVED:
            message.covariance = array("d", covariance(solution).tobytes())


def _each(found: Solutions) -> list[Solutions]:
    return [found] if found.joints.ndim == 1 else list(found)
