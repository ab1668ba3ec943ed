"""Identification of 42 parameters: ours beside scipy's least_squares with finite differences.

Both minimise the same unweighted merit (eq. 5.6) on the same 94 samples and must agree; the
weighted fit, which is what people use, is timed beside them, sigmas and rank included. Beside
the weighted one stands ODRPACK's implicit orthogonal distance regression, on one chain of model 24.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from datasets import measured

from bench.speed.timing import Row, processor_each, show
from parallel_cal.base.threads import single_threaded
from parallel_cal.identification.fit import fit
from parallel_cal.identification.linearisation import Linearisation
from parallel_cal.identification.methods.implicit import estimate
from parallel_cal.identification.observations import Observations, observe
from parallel_cal.mechanisms.delta24 import Delta24
from parallel_cal.model.model import Model, new_model
from parallel_cal.virtual import robot as vr


def scipy_fit(model: Model, observations: Observations, free: np.ndarray) -> np.ndarray:
    """The plain way: closure residuals, Jacobian by finite differences, in tolerances."""
    from scipy.optimize import least_squares

    linearise = Linearisation(model, observations, free, weighted=False)
    scale = model.table.tolerance[free]

    def residual(u: np.ndarray) -> np.ndarray:
        values = model.values.copy()
        values[free] += u * scale
        return linearise.blocks(values, observations.x)[0].ravel() * 1e5

    found = least_squares(residual, np.zeros(int(free.sum())), method="lm", xtol=1e-12)
    return model.values[free] + found.x * scale


class FirstChain(Delta24):
    """Model 24 with the rod of chain 1 alone: one row, every coordinate measured."""

    moves = controls = ("x",)

    def closure(self, q: Any, r: Any, R: Any, p: Any) -> Any:
        return self.rod(q[0], r, p["chain1"])


def odr_fit(model: Model, observations: Observations, free: np.ndarray) -> np.ndarray:
    """ODRPACK on the same row: it adjusts the chain's joint and x, y, z by itself."""
    from scipy import odr

    unit, used = model.table.tolerance[free], np.array([0, 3, 4, 5])

    def rod(b: np.ndarray, x: np.ndarray) -> np.ndarray:
        rows = np.tile(observations.x[:1], (x.shape[1], 1))
        rows[:, used] = x.T
        values = np.array(model.values)
        values[free] = b * unit
        conditions = np.zeros((len(rows), 0))
        return model.structure.closure_batch(rows, conditions, values)[0][:, 0] * 1e3

    data = odr.Data(
        observations.x[:, used].T, y=1, we=1e14, wd=1 / np.diag(observations.S[0])[used]
    )
    problem = odr.ODR(
        data,
        odr.Model(rod, implicit=True),
        beta0=model.values[free] / unit,
        maxit=1000,
        sstol=1e-15,
        partol=1e-15,
    )
    problem.set_job(fit_type=1, deriv=1)
    return np.asarray(problem.run().beta * unit)


def beside_odr() -> list[Row]:
    """Both on one chain: the same estimates to 1e-6, and the times."""
    small = new_model("delta24").table.names
    robot = vr.Delta({**vr.TABLE_5_12, **{name: vr.TABLE_5_18[name] for name in small}})
    model = new_model(FirstChain())
    observations, free = (
        # One chain alone has no inverse problem, by which readings could be doubted.
        observe(model, measured(0, robot=robot), doubts=""),
        model.table.matching(["chain1.*"]),
    )
    ours, theirs = (
        estimate(model, observations, free).values[free],
        odr_fit(model, observations, free),
    )
    large = np.abs(theirs) > 0.01  # the others are zero to within their sigma
    apart = np.abs(ours / theirs - 1)[large].max()
    assert apart < 1e-6
    return [
        Row(
            "weighted implicit, one chain, 94 poses",
            processor_each(lambda: estimate(model, observations, free), least=10),
        ),
        Row(
            f"ODRPACK's implicit ODR (estimates within {apart:.0e})",
            processor_each(lambda: odr_fit(model, observations, free), least=1, repeats=3),
        ),
    ]


def beside_scipy() -> list[Row]:
    """The fit of 42 parameters, and scipy's least_squares on the same residuals."""
    model, data = new_model("delta54", vr.TABLE_5_12), measured(0)
    observations, free = observe(model, data), ~model.fixed
    with single_threaded():
        ours = estimate(model, observations, free, weighted=False).values[free]
        apart = (scipy_fit(model, observations, free) - ours) / model.table.tolerance[free]
        assert np.abs(apart).max() < 5e-3  # as near as finite differences come
        return [
            Row(
                "weighted fit, 42 parameters, 94 poses, with sigmas and rank",
                processor_each(lambda: estimate(model, observations, free), least=10),
            ),
            Row(
                "the same, 74 poses",
                processor_each(
                    lambda: estimate(model, observations.select(np.arange(74)), free), least=10
                ),
            ),
            Row(
                "unweighted fit (eq. 5.6)",
                processor_each(
                    lambda: estimate(model, observations, free, weighted=False), least=10
                ),
            ),
            Row(
                "scipy least_squares, finite differences",
                processor_each(lambda: scipy_fit(model, observations, free), least=1, repeats=3),
            ),
            Row(
                "fit() as a whole: errors at held-out poses of 4 folds, noise floor",
                processor_each(lambda: fit(model, data), least=3, repeats=3),
            ),
        ]


def main() -> None:
    show("Identification", beside_scipy())
    with single_threaded():
        chain = beside_odr()
    show("Beside orthogonal distance regression", chain)


if __name__ == "__main__":
    main()
