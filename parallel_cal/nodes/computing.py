"""Solves many direct or inverse problems in pieces, in a worker; independent of ROS."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from parallel_cal.base.errors import SolveError
from parallel_cal.base.worker import Worker
from parallel_cal.kinematics import solving
from parallel_cal.kinematics.kinematics import Kinematics, Solutions, Status
from parallel_cal.kinematics.solvers import newton
from parallel_cal.model.file.modelfile import parse_model
from parallel_cal.model.shelf import forbid_foreign

BUILD_TIMEOUT_S = 60.0  # s for building a model's functions on a busy machine
SAME_BRANCH = 1e-3  # rad or m: solutions of the same pose that differ less are the same branch
PIECE_DURATION_S = 0.1  # s that one piece of a request should take; then its answers are sent
# A singular pose has no finite covariance.
SOLVED = (Status.CONVERGED, Status.OUTSIDE_LIMITS)


@dataclass(frozen=True)
class Problems:
    """Rows (N, ..) of joints, or of positions and rotations, and how to solve them."""

    problem: str
    rows: tuple[np.ndarray, ...]
    at: dict[str, float] | None
    every: bool
    solver: str
    with_covariance: bool


@dataclass(frozen=True)
class Answer:
    """The solutions of one row, and their covariances if requested and known."""

    found: Solutions
    covariances: tuple[np.ndarray | None, ...]


def prepare(foreign: bool) -> None:
    """Prepare a new process; `foreign` allows modules outside the package."""
    if not foreign:
        forbid_foreign()


def answer(text: str, asked: Problems, tell: Callable[[list[Answer]], None]) -> None:
    """Solve problems for the model with this file text; send the answers in order, in pieces."""
    kinematics = _kinematics(text)
    solve = _select_solver(kinematics, asked)
    n, begin, size = len(asked.rows[0]), 0, 1 if asked.every or asked.solver else 16
    while begin < n:
        start = time.monotonic()
        rows = tuple(part[begin : begin + size] for part in asked.rows)
        if asked.every or n == 1:
            found = [solve(*(part[i] for part in rows)) for i in range(len(rows[0]))]
        else:  # one answer to each row: solved together
            found = list(solve(*rows))
        tell([_with_covariances(kinematics, asked, solutions) for solutions in found])
        begin += size
        if not asked.every:
            lapse = max(time.monotonic() - start, 1e-6)
            size = int(np.clip(size * PIECE_DURATION_S / lapse, size / 4, size * 4).clip(1, 512))


@lru_cache(maxsize=8)
def warm(text: str, every: bool) -> None:
    """Build the functions that a model's first request needs; with `every`, for all solutions."""
    kinematics = _kinematics(text)
    home, model = kinematics.model.mechanism.home, kinematics.model
    q, r = np.array(home.joints, float), np.array(home.position, float)
    if every:
        solving.direct(model, q, {}, every=True)
    else:
        kinematics.direct(q), kinematics.inverse(r)


def warm_in(worker: Worker, text: str, *every: bool) -> None:
    """Build the functions that the first requests need, in a worker."""
    for each in every or (False,):
        worker.work(warm, text, each, seconds=BUILD_TIMEOUT_S)


def solve_near(
    text: str,
    seed: np.ndarray | None,
    r: np.ndarray,
    R: np.ndarray,
    at: Mapping[str, float] | None,
) -> Solutions:
    """Solve the joints for one pose on the branch of the joints `seed`, by default that of home."""
    kinematics = _kinematics(text)
    return solve_on_branch(kinematics, seed, *solving.controlled_pose(kinematics.model, r, R), at)


def solve_on_branch(
    kinematics: Kinematics,
    last: np.ndarray | None,
    r: np.ndarray,
    R: np.ndarray | None,
    at: Mapping[str, float] | None,
) -> Solutions:
    """Solve on the home branch, or for a robot on another branch nearest to its joints `last`."""
    found = kinematics.inverse(r, R, at)
    if last is None or _is_on_home_branch(kinematics, last, at):
        return found
    # Without random starts, the search is fast enough for a stream.
    others = newton.inverse_all(kinematics.model, r, R, at, starts=0)
    usable = np.flatnonzero(others.status == Status.CONVERGED)
    if not len(usable):
        return found
    return others[usable[np.argmin(np.abs(others.joints[usable] - last).max(axis=1))]]


def _is_on_home_branch(
    kinematics: Kinematics, q: np.ndarray, at: Mapping[str, float] | None
) -> bool:
    """Return whether inverse kinematics on the home branch recovers the robot's joints."""
    here = kinematics.direct(q, at)
    if here.status not in (Status.CONVERGED, Status.OUTSIDE_LIMITS):
        return True  # unknown: use the branch that the model file selects
    back = kinematics.inverse(here.position, here.rotation, at)
    return bool(np.abs(back.joints - q).max() < SAME_BRANCH)


@lru_cache(maxsize=4)
def _kinematics(text: str) -> Kinematics:
    return Kinematics(parse_model(text).robot())


def _select_solver(kinematics: Kinematics, asked: Problems) -> Callable[..., Solutions]:
    """Return the function that solves rows as the request asks."""
    inverse, model, at = asked.problem == "inverse", kinematics.model, asked.at
    if asked.every or asked.solver:
        if why := solving.get_build_note(asked.solver):
            raise SolveError(
                f"{asked.solver.partition(':')[0]} builds {why} before its first answer, which "
                "takes too long for a request; use `parallel-cal direct --solver` or export it"
            )
        named: Callable[..., Solutions] = solving.inverse if inverse else solving.direct

        def by_name(*rows: Any) -> Solutions:
            found = named(model, *rows, at or {}, asked.every, asked.solver)
            return found[0] if np.ndim(rows[0]) == 1 and not asked.every else found

        return by_name
    if inverse:
        return lambda r, R: kinematics.inverse(*solving.controlled_pose(model, r, R), at)
    return lambda q: kinematics.direct(q, at)


def _with_covariances(kinematics: Kinematics, asked: Problems, found: Solutions) -> Answer:
    singles = [found] if found.joints.ndim == 1 else list(found)
    wanted = asked.with_covariance and kinematics.model.covariance is not None

    def covariance(solution: Solutions) -> np.ndarray | None:
        if not wanted or solution.status not in SOLVED:
            return None
        if asked.problem == "inverse":
            return kinematics.inverse_covariance(solution, asked.at)
        noise = np.nan_to_num(kinematics.model.joint_noise)
        return kinematics.direct_covariance(solution, asked.at, noise)

    return Answer(found, tuple(map(covariance, singles)))
