"""All solutions of one sample, by a complete method if the mechanism has one, else by search."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from parallel_cal.base.errors import SolveError
from parallel_cal.kinematics.solutions import Solutions
from parallel_cal.kinematics.solvers import homotopy, newton, polynomial, three_circles
from parallel_cal.kinematics.solvers.newton import inverse_all
from parallel_cal.model.model import Model

__all__ = ["direct_all", "inverse_all"]

# Method of a mechanism -> solver that finds all its poses: six rods (6.2.4), three balls on circles
# (6.7.2) and on great circles (6.2.3).
COMPLETE = {"rods": homotopy, "circles": three_circles, "normals": polynomial}


def direct_all(model: Model, q: np.ndarray, at: Mapping[str, Any] | None = None) -> Solutions:
    """Find every pose for joints (nq,), home branch first; `complete` if no other pose exists."""
    methods = [m for name, m in COMPLETE.items() if hasattr(model.mechanism, name)]
    for method in methods if np.isfinite(q).all() else ():
        try:
            found = method.direct_all(model, q, at)
        except SolveError:  # an effect or this geometry violates its assumptions
            continue
        if len(found):
            return found
        rest = newton.direct_all(model, q, at, starts=0)
        return replace(rest, complete=found.complete and not rest.solved.any())
    return newton.direct_all(model, q, at)
