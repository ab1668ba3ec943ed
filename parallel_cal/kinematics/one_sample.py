"""Solve one sample in microseconds, through the buffers of a problem."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import lru_cache
from struct import Struct
from typing import Any

import numpy as np

from parallel_cal.base.compiled import Single
from parallel_cal.kinematics.problem import Problem
from parallel_cal.kinematics.solutions import (
    CONVERGED,
    MAX_SETTLED_STEP_M,
    SUSPECT_PIVOT,
    Solutions,
)
from parallel_cal.model.configuration import NO_PASSIVE

# (joints or position, rotation, conditions) -> the solution; None unless it is usual
FastSolver = Callable[[Any, Any, Mapping[str, Any] | None], Solutions | None]


class _Part:
    """An array of a `ConvergedSolution`: a part of its output, made when it is read first.

    A `cached_property` would lock, which takes as long as the rest of a reading.
    """

    def __init__(self, place: slice | int, shape: tuple[int, ...] = ()):
        self._place, self._shape = place, shape

    def __set_name__(self, owner: type, name: str) -> None:
        self._name = name

    def __get__(self, one: Any, owner: type) -> Any:
        own = one.__dict__
        part = own["_output"][self._place]
        if self._shape:
            part = part.reshape(self._shape)
        own[self._name] = part
        return part


class ConvergedSolution(Solutions):
    """One converged solution, whose arrays are made when they are read.

    `_output` holds the results of `NewtonFunctions.solve`: configuration, last step, residual,
    pivot and distance from the joint limits. The `__init__` of a dataclass is bypassed: it takes a
    microsecond.
    """

    joints = _Part(slice(-16))
    position = _Part(slice(-16, -13))
    rotation = _Part(slice(-13, -4), (3, 3))
    residual = _Part(-3)
    status = CONVERGED
    passive = NO_PASSIVE

    def __reduce__(self) -> tuple[Any, ...]:
        x = self.joints, self.position, self.rotation, self.residual, self.status
        return Solutions, (*x, None, None, None, self.passive)


@lru_cache(maxsize=64)
def _solution_class(passive: int) -> type[ConvergedSolution]:
    """Return the class of solutions that have some passive coordinates behind the rotation."""
    if not passive:
        return ConvergedSolution
    parts = {
        "joints": _Part(slice(-16 - passive)),
        "position": _Part(slice(-16 - passive, -13 - passive)),
        "rotation": _Part(slice(-13 - passive, -4 - passive), (3, 3)),
        "passive": _Part(slice(-4 - passive, -4)),
    }
    return type("PassiveSolution", (ConvergedSolution,), parts)


def fast_solver(problem: Problem) -> FastSolver:
    """Return the function that solves one sample; None unless it is regular and within limits.

    It looks up here what does not depend on the sample, and it compares Python numbers: every
    look-up and every operation on arrays would be some per cent of a call.
    """
    model, first = problem.model, problem.single_solver
    row, conditions, _ = first.arguments
    n, home = len(model.joints), model.mechanism.home.configuration
    given_part = row[n : n + 3] if problem.unknown_joints else row[:n]
    rotation_part, home_rotation = (x[n + 3 : n + 12].reshape(3, 3) for x in (row, home))
    shape, has_conditions = given_part.shape, bool(len(conditions))
    # Reads what comes behind the configuration.
    read = Struct(f"{len(row) * 8}x4d").unpack
    acquire, release = first.lock.acquire, first.lock.release
    evaluate, output, memory = first.evaluate, first.output, first.output.data
    inverse, neutral, largest = problem.unknown_joints, problem.neutral, problem.largest
    array, new = np.ndarray, object.__new__
    kind = _solution_class(len(model.mechanism.passive))
    more: Single | None = None  # made once it is needed
    memory_of_more = memory

    def solve(given: Any, rotation: Any, at: Mapping[str, Any] | None) -> Solutions | None:
        nonlocal more, memory_of_more
        acquire()
        try:
            if type(given) is not array:
                given = np.asarray(given)
            if given.shape != shape:
                return None
            given_part[...] = given
            if inverse:
                rotation = home_rotation if rotation is None else np.asarray(rotation)
                if rotation.shape != (3, 3):
                    return None
                rotation_part[...] = rotation
            if at is not None:
                conditions[...] = model.condition_rows(at, 1)[0]
            elif has_conditions:
                conditions[...] = neutral
            evaluate()
            step, residual, pivot, inside = read(memory)
            if step < MAX_SETTLED_STEP_M or not pivot > 0.0:
                end = output.copy()  # a copy, because the buffers are shared
            else:
                if more is None:
                    more = problem.single_refiner
                    memory_of_more = more.output.data
                more.evaluate()
                step, residual, pivot, inside = read(memory_of_more)
                end = more.output.copy()
                if not step < MAX_SETTLED_STEP_M:
                    return None
        except (TypeError, ValueError):
            return None  # no numbers: the way of many samples says what was expected
        finally:
            release()
        if not (inside >= 0.0 and pivot > SUSPECT_PIVOT and residual < largest):
            return None
        one = new(kind)
        one.__dict__["_output"] = end
        return one

    return solve
