"""Identification of 42 parameters: ours beside scipy's least_squares with finite differences.

Both minimise the same unweighted merit (eq. 5.6) on the same 94 samples and must agree; the
weighted fit, which is what people use, is timed beside them, sigmas and rank included.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from timing import Row, seconds_each, show

sys.path.insert(0, str(Path(__file__).parents[1] / "test"))
import virtual_robot as vr
from datasets import measured

from parallel_cal.evidence import Evidence, gather
from parallel_cal.identification import fit, single_threaded
from parallel_cal.methods.implicit import Linearisation, estimate
from parallel_cal.model import Model, new_model


def scipy_fit(model: Model, evidence: Evidence, free: np.ndarray) -> np.ndarray:
    """The plain way: closure residuals, Jacobian by finite differences, in tolerances."""
    from scipy.optimize import least_squares

    linearise = Linearisation(model, evidence, free, weighted=False)
    scale = model.table.tolerance[free]

    def residual(u: np.ndarray) -> np.ndarray:
        values = model.values.copy()
        values[free] += u * scale
        return linearise.blocks(values, evidence.x)[0].ravel() * 1e5

    found = least_squares(residual, np.zeros(int(free.sum())), method="lm", xtol=1e-12)
    return model.values[free] + found.x * scale


def main() -> None:
    model, data = new_model("delta54", vr.TABLE_5_12), measured(0)
    evidence, free = gather(model, data), ~model.fixed
    with single_threaded():
        ours = estimate(model, evidence, free, weighted=False).values[free]
        apart = (scipy_fit(model, evidence, free) - ours) / model.table.tolerance[free]
        assert np.abs(apart).max() < 5e-3  # as near as finite differences come
        rows = [
            Row(
                "weighted fit, 42 parameters, 94 poses, with sigmas and rank",
                seconds_each(lambda: estimate(model, evidence, free), least=10),
            ),
            Row(
                "the same, 74 poses",
                seconds_each(
                    lambda: estimate(model, evidence.select(np.arange(74)), free), least=10
                ),
            ),
            Row(
                "unweighted fit (eq. 5.6)",
                seconds_each(lambda: estimate(model, evidence, free, weighted=False), least=10),
            ),
            Row(
                "scipy least_squares, finite differences",
                seconds_each(lambda: scipy_fit(model, evidence, free), least=1, repeats=3),
            ),
            Row(
                "fit() as a whole: errors, 4 folds left out, noise floor",
                seconds_each(lambda: fit(model, data), least=3, repeats=3),
            ),
        ]
    show("Identification", rows)


if __name__ == "__main__":
    main()
