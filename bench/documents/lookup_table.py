"""Look-up table (section 6.1): error against grid size and memory, on the thesis' mock-up.

`differences` stores calibrated minus nominal, as the thesis proposes; `whole` stores the
calibrated joints themselves, to show what the differences are worth.

    python -m bench.documents.lookup_table [--json]
"""

from __future__ import annotations

import argparse
import json

import casadi as ca
import numpy as np

from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.kinematics.solvers import lookup_table
from parallel_cal.model.model import Model, new_model
from parallel_cal.virtual.robot import TABLE_5_18

SIZES = (4, 5, 9, 17, 33)


def study(poses: int = 2000) -> list[dict[str, float | str]]:
    """Position error (um) that the table leaves, for each problem, order and grid."""
    model, rng = new_model("delta54", TABLE_5_18), np.random.default_rng(0)
    asked = model.mechanism.sample(poses, rng)
    exact = Kinematics(model)
    joints = exact.inverse(asked).joints
    rows = []
    for size in SIZES:
        for order in ("linear", "smooth"):
            found = lookup_table.inverse(model, asked, size=size, order=order)
            reached = exact.direct(found.joints).position
            table = lookup_table.table_for(model, "inverse", None, size, order)
            rows.append(_row("inverse differences", order, table, reached - asked))
            reached = exact.direct(_whole(model, table, asked)).position
            rows.append(_row("inverse whole", order, table, reached - asked))
            found = lookup_table.direct(model, joints, size=size, order=order)
            table = lookup_table.table_for(model, "direct", None, size, order)
            rows.append(_row("direct differences", order, table, found.position - asked))
    return rows


def _whole(model: Model, table: lookup_table.LookUpTable, asked: np.ndarray) -> np.ndarray:
    """Joints interpolated from a table of joints instead of one of differences."""
    points = np.stack(np.meshgrid(*table.axes, indexing="ij"), -1).reshape(-1, 3)
    joints = Kinematics(model).inverse(points).joints
    values = joints.reshape(*(len(a) for a in table.axes), 3)
    kind = "linear" if table.order == "linear" else "bspline"
    flat = np.moveaxis(values, -1, 0).ravel(order="F")
    return np.array(ca.interpolant("whole", kind, [list(a) for a in table.axes], flat)(asked.T)).T


def _row(
    what: str, order: str, table: lookup_table.LookUpTable, miss: np.ndarray
) -> dict[str, float | str]:
    distance = 1e6 * np.linalg.norm(miss, axis=1)
    return {
        "table": what,
        "order": order,
        "points": len(table.axes[0]),
        "kilobytes": 12 * table.values[..., 0].size / 1000,
        "mean_um": float(np.mean(distance)),
        "max_um": float(np.max(distance)),
    }


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--json", action="store_true")
    rows = study()
    if options.parse_args().json:
        print(json.dumps(rows))
        return
    print(f"{'table':>20} {'order':>7} {'points':>8} {'kB':>8} {'mean um':>10} {'max um':>10}")
    form = "{table:>20} {order:>7} {points:>6}^3 {kilobytes:>8.1f} {mean_um:>10.4f} {max_um:>10.4f}"
    for row in sorted(rows, key=lambda row: (row["table"], row["order"], row["points"])):
        print(form.format(**row))


if __name__ == "__main__":
    main()
