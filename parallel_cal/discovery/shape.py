"""The shape of an error along its driver, without a formula, and the law over it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from parallel_cal.diagnosis.thresholds import MIN_COLUMN_REMAINDER, SAMPLES_PER_NUMBER
from parallel_cal.discovery import basis
from parallel_cal.discovery.formula import Formula
from parallel_cal.discovery.thresholds import SPLINES
from parallel_cal.posterior.scene import Scene

# Of the law: what its best splines miss of it. A picture does not show less than the first share;
# a step, which no splines follow, misses more; waves shorter than any splines miss nearly all.
FINE_SHARE, MAX_MISSED_SHARE = 0.05, 0.5


@dataclass(frozen=True)
class Shape:
    """The error (k,) of the first member along its driver (k,), as splines describe it, its sigma,
    and the law there; without the part that geometry could imitate."""

    driver: str
    driver_unit: str
    unit: str
    along: np.ndarray
    error: np.ndarray
    sigma: np.ndarray
    law: np.ndarray


def find_shape(scene: Scene, formula: Formula) -> Shape | None:
    """Fit splines along the driver of a law, as many as can bend as the law does.

    None for a law of two drivers, and for one whose waves are too short for splines that the
    samples determine: such a curve would contradict the law. Where geometry can imitate a part of
    the error, the data do not determine it: the splines' part is taken from the law.
    """
    hypothesis = formula.hypothesis
    if len(hypothesis.drivers) != 1:
        return None
    own, site = hypothesis.drivers[0], hypothesis.site
    members = range(1) if site.each else range(len(site.members))
    values = [
        sum(
            c[0] * t.value([own[m].values])
            for c, t in zip(formula.coefficients, formula.terms, strict=True)
        )
        for m in members
    ]
    law = np.concatenate(values)
    count, most = SPLINES, max(len(law) // SAMPLES_PER_NUMBER, SPLINES)
    while True:
        W = basis.splines(own, count).transpose(0, 2, 1)
        used = np.any(W != 0, axis=(0, 1))
        stacked = np.concatenate([W[m][:, used] for m in members])
        start = np.linalg.lstsq(stacked, law, rcond=None)[0]
        gap, size = np.linalg.norm(law - stacked @ start), np.linalg.norm(law)
        missed = float(gap / size) if size else 0.0
        if missed <= FINE_SHARE or count == most:
            break
        count = min(2 * count, most)
    if missed > MAX_MISSED_SHARE:
        return None
    B = sum(site.members[m].columns[:, :, None] * W[m][:, None, used] for m in members)
    B = np.asarray(B).reshape(len(scene.residual), -1)
    left = scene.project_off_geometry(B)
    r = scene.residual + scene.project_off_geometry(formula.columns) @ formula.coefficients.ravel()
    squares, V = np.linalg.eigh(left.T @ left)
    visible = squares > MIN_COLUMN_REMAINDER**2 * max(float(np.max(np.sum(B**2, axis=0))), 1e-300)
    inverse = V[:, visible] / squares[visible] @ V[:, visible].T
    change = -inverse @ (left.T @ r)
    rest = float(np.sum((r + left @ change) ** 2)) / max(scene.dof - int(visible.sum()), 1)
    order = np.argsort(own[0].values)
    rows = W[0][order][:, used]
    variance = np.einsum("ni,ij,nj->n", rows, inverse * rest, rows)
    return Shape(
        own[0].name,
        own[0].unit,
        site.unit,
        own[0].values[order] + own[0].zero,
        rows @ (start + change),
        np.sqrt(np.maximum(variance, 0.0)),
        np.asarray(values[0])[order],
    )
