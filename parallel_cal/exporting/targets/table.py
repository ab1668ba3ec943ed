"""The look-up table of section 6.1: corrections to the nominal solution, and their error.

It is for a controller that can only look up values and interpolate linearly.
"""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from parallel_cal.base.documents import to_json_value
from parallel_cal.base.errors import ModelError
from parallel_cal.exporting.projection import summary
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.kinematics.solvers import lookup_table
from parallel_cal.kinematics.solvers.lookup_table import LookUpTable
from parallel_cal.model.mechanism import POSE, poses_in_workspace
from parallel_cal.model.model import Model

PROBLEMS = ("inverse", "direct")
MAX_GRID_POINTS = 100_000  # they take a minute
N_VALIDATION_POSES = 2000  # poses over the workspace, none of them on the grid


def files(
    model: Model, problem: str = "inverse", size: int = 9, order: str = "linear"
) -> dict[str, str]:
    """Return a table with one line per grid point, and its description.

    There are `size` grid points per axis. A line contains the given coordinates and the corrections
    of the joints, or of the pose: x y z and a small rotation. The description states the nominal
    values and the remaining error.
    """
    if problem not in PROBLEMS:
        raise ModelError(f"problem={problem}: expected one of {', '.join(PROBLEMS)}")
    given = len(model.mechanism.controls if problem == "inverse" else model.joints)
    if size**given > MAX_GRID_POINTS:
        fits = int(MAX_GRID_POINTS ** (1 / given))
        raise ModelError(
            f"{given} axes at size={size} are {size**given} grid points, at most "
            f"{MAX_GRID_POINTS} are allowed: set table:size={fits} or less, or use "
            "another target, such as c"
        )
    table = lookup_table.table_for(model, problem, None, size, order)
    m, n = model.mechanism, len(model.joints)
    axes, answers = (m.controls, model.joints) if problem == "inverse" else (model.joints, POSE)
    values = table.values[..., : n if problem == "inverse" else 6]
    grid = np.stack(np.meshgrid(*table.axes, indexing="ij"), -1)
    rows = np.concatenate([grid, values], axis=-1).reshape(-1, len(axes) + len(answers))
    header = ",".join([*axes, *(f"d_{name}" for name in answers)])
    lines = [",".join(map(repr, row)) for row in rows.tolist()]
    about = {
        "problem": problem,
        "interpolation": order,
        "axes": dict(zip(axes, table.axes, strict=True)),
        "bytes_as_float32": 4 * values.size,
        "conditions": dict(zip(model.conditions, model.structure.neutral, strict=True)),
        "nominal": model.table.mapping(model.table.nominal),
        "error": _error(model, table, problem, size),
    }
    return {
        "table.csv": "\n".join([header, *lines]) + "\n",
        "table.json": json.dumps(to_json_value(about), indent=1, allow_nan=False) + "\n",
    }


def _error(model: Model, table: LookUpTable, problem: str, size: int) -> dict[str, Any]:
    """Return the error (m, rad) with the table, `without` it, and at `half_size`, at random poses.

    For the inverse problem it is the reached minus the commanded pose, for the direct problem the
    computed minus the true pose. The error at half the size says whether a larger table helps:
    not before the grid is finer than a ripple of the corrections.
    """
    exact, m = Kinematics(model), model.mechanism
    r, R = poses_in_workspace(m, N_VALIDATION_POSES, np.random.default_rng(1))
    wanted = exact.inverse(r, R)
    half = (size + 1) // 2

    def measure_error(size: int) -> dict[str, Any]:
        if problem == "inverse":
            found = lookup_table.inverse(model, r, R, size=size, order=table.order)
            return summary(model, wanted, exact.direct(found.joints))
        found = lookup_table.direct(model, wanted.joints, size=size, order=table.order)
        return summary(model, wanted, found)

    if problem == "inverse":
        usual = exact.direct(table.nominal.inverse(r, R).joints)
    else:
        usual = table.nominal.direct(wanted.joints)
    document = measure_error(size) | {"without": summary(model, wanted, usual)}
    if half >= lookup_table.MIN_SIZE[table.order]:
        document["half_size"] = {"size": half} | measure_error(half)
    return document
