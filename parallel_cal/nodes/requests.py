"""Answers ComputeFK and ComputeIK requests, each with a single model and within a budget."""

from __future__ import annotations

from array import array
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from threading import Thread
from typing import Any

import numpy as np
from parallel_cal_msgs.msg import Solution, SolutionSet

from parallel_cal.base.errors import SolveError
from parallel_cal.base.worker import TimeBudgetExceeded, Worker, WorkError
from parallel_cal.kinematics.answers import describe_missed
from parallel_cal.model.mechanism import Mechanism
from parallel_cal.nodes import computing
from parallel_cal.nodes.computing import Answer, Problems
from parallel_cal.nodes.conversions import (
    conditions_of,
    invalid_solution,
    joint_order,
    pose_numbers,
    solution_messages,
)
from parallel_cal.nodes.model_server import ServedModel

Rows = tuple[np.ndarray, ...]


@dataclass(frozen=True)
class Budget:
    """Limits of one request: number of configurations or targets, and seconds."""

    poses: int
    seconds: float


def answer(
    worker: Worker,
    budget: Budget,
    served: ServedModel | None,
    why_none: str,
    request: Any,
    response: Any,
) -> Any:
    """Fill the response of either service.

    A request that cannot be understood gets a message, and one that exceeds its budget gets the
    answers that were ready in time.
    """
    if served is None:
        response.message = f"no model in use: {why_none}"
        return response
    response.model_hash = served.hash
    given: list[Rows | str]  # or why there are none
    try:
        if hasattr(request, "targets"):
            response.joint_names = served.model.joints
            given, problem = [], "inverse"
            for pose in request.targets:
                try:
                    given.append(pose_numbers(pose))
                except SolveError as error:
                    given.append(str(error))
        else:
            given, problem = _read_configurations(served, request), "direct"
        at = conditions_of(served.model, request.conditions)
        response.results, response.message = _solve_rows(
            worker, budget, served, request, given, problem, at
        )
    except Exception as error:  # whatever it is, the node goes on and the caller gets a reason
        response.results, response.message = [], str(error) or type(error).__name__
    return response


def warm_up(worker: Worker, served: ServedModel) -> None:
    """Build the functions of a model in the worker before the first request."""
    Thread(target=_warm, args=(worker, served, False, True), daemon=True).start()


def _warm(worker: Worker, served: ServedModel, *every: bool) -> None:
    with suppress(WorkError, TimeBudgetExceeded):  # the request itself will report why
        computing.warm_in(worker, served.text, *every)


def _read_configurations(served: ServedModel, request: Any) -> list[Rows | str]:
    """Return the joints (nq,) of each configuration in the model's order, or why there are none."""
    model, names = served.model, request.joint_names
    order = joint_order(names, model.joints) if names else None
    if names and len(names) != len(model.joints):
        extra = ", ".join(n for n in names if n not in model.joints) or "a joint twice"
        raise SolveError(f"joint_names contain {extra}; expected {', '.join(model.joints)}")
    n, rows = len(model.joints), list[Rows | str]()
    for configuration in request.configurations:
        q = np.asarray(configuration.positions)
        if len(q) == n:
            rows.append((q if order is None else q[order],))
        else:
            rows.append(f"{len(q)} positions, expected {n}")
    return rows


def _solve_rows(
    worker: Worker,
    budget: Budget,
    served: ServedModel,
    request: Any,
    given: Sequence[Rows | str],
    problem: str,
    at: dict[str, float] | None,
) -> tuple[list[SolutionSet], str]:
    """Return one set for each row, and a message if the budget ended before the last of them."""
    good = [row for row in given[: budget.poses] if not isinstance(row, str)]
    done, over = list[Answer](), len(given) > budget.poses
    if good:
        rows = tuple(np.array(part) for part in zip(*good, strict=True))
        asked = Problems(
            problem, rows, at, request.all_solutions, request.solver, request.with_covariance
        )
        # Building a model's functions does not count against the budget of a request.
        _warm(worker, served, request.all_solutions)
        try:
            worker.work(
                computing.answer, served.text, asked, seconds=budget.seconds, tell=done.extend
            )
        except TimeBudgetExceeded:
            over = True
    found = iter(done)
    sets = [_make_set(row, found, served.model.mechanism) for row in given[: budget.poses]]
    late = SolutionSet(solutions=[_NOT_TRIED], count_complex=-1)
    sets += [late] * (len(given) - len(sets))
    solved = sum(one is not late and one.solutions[0] is not _NOT_TRIED for one in sets)
    limits = f"a request may contain {budget.poses} poses and take {budget.seconds:g} s"
    return sets, f"over budget: {solved} of {len(given)} were answered; {limits}" if over else ""


def _make_set(row: Rows | str, answers: Iterator[Answer], mechanism: Mechanism) -> SolutionSet:
    if isinstance(row, str):
        return SolutionSet(solutions=[invalid_solution(row)], count_complex=-1)
    answer = next(answers, None)
    if answer is None:
        return SolutionSet(solutions=[_NOT_TRIED], count_complex=-1)
    messages = solution_messages(answer.found)
    for message, covariance in zip(messages, answer.covariances, strict=True):
        if covariance is not None:
            message.covariance = array("d", covariance.tobytes())
    if len(row) == 2:  # a pose
        found = [answer.found] if answer.found.joints.ndim == 1 else answer.found
        for message, solution in zip(messages, found, strict=True):
            message.message = message.message or describe_missed(mechanism, solution, *row)
    count = answer.found.count_complex
    return SolutionSet(
        solutions=messages,
        count_complex=-1 if count is None else count,
        complete=bool(answer.found.complete),
    )


_NOT_TRIED = invalid_solution("not tried: the request exceeded its budget")
_NOT_TRIED.status = Solution.NOT_TRIED
