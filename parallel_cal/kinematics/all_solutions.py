"""All solutions of one sample: by a complete method where the mechanism has one, else searched."""

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

# The method of a mechanism that names its methods: complete for six rods (6.2.4), for three balls
# on circles (6.7.2) and on great circles (6.2.3).
COMPLETE = {"rods": homotopy, "circles": three_circles, "normals": polynomial}


def direct_all(model: Model, q: np.ndarray, at: Mapping[str, Any] | None = None) -> Solutions:
    """Every pose for joints (nq,), home branch first; `complete` where no other exists."""
    methods = [m for name, m in COMPLETE.items() if hasattr(model.mechanism, name)]
    for method in methods if np.isfinite(q).all() else ():
        try:
            found = method.direct_all(model, q, at)
        except SolveError:  # an effect or this geometry denies it what it needs
            continue
        if len(found):
            return found
        rest = newton.direct_all(model, q, at, starts=0)
        return replace(rest, complete=found.complete and not rest.solved.any())
    return newton.direct_all(model, q, at)
