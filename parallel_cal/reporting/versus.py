"""Two models compared on the same data without a fit; all values SI."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from parallel_cal.diagnosis.comparison import Comparison
from parallel_cal.identification.prediction_errors import Summary
from parallel_cal.model.file.modelfile import model_hash
from parallel_cal.model.model import Model
from parallel_cal.reporting.contents import places, vectors_in_base


@dataclass(frozen=True)
class Side:
    """One of the two models: its errors, and its residuals (N, 3) at their places (N, 3)."""

    mechanism: str
    effects: list[str]
    model_sha256: str
    errors: Summary
    noise: Summary
    chi2_per_dof: float
    place: np.ndarray
    residual: np.ndarray

    @classmethod
    def of(cls, one: Comparison) -> Side:
        return cls(
            mechanism=one.model.mechanism.name,
            effects=[effect.name for effect in one.model.effects],
            model_sha256=model_hash(one.model),
            errors=one.errors.summary,
            noise=one.noise,
            chi2_per_dof=one.scene.chi2_per_dof,
            place=places(one.scene, one.field.kind),
            residual=vectors_in_base(one.scene, one.field),
        )


@dataclass(frozen=True)
class Difference:
    """A parameter of both models; its value is None if a model lacks it."""

    name: str
    unit: str
    values: list[float | None]
    difference_tolerances: float | None

    @classmethod
    def of(cls, name: str, one: Model, other: Model) -> Difference:
        values = [m.value(name) if name in m.table.names else None for m in (one, other)]
        model = one if values[0] is not None else other
        i = model.table.index_of(name)
        apart = None
        if values[0] is not None and values[1] is not None:
            apart = float((values[1] - values[0]) / model.usual_tolerance[i])
        return cls(name, model.table[i].unit, values, apart)


@dataclass(frozen=True)
class Versus:
    """Errors and residuals of both models, and the parameters that differ."""

    sides: tuple[Side, Side]
    parameters: list[Difference]

    @classmethod
    def of(cls, one: Comparison, other: Comparison) -> Versus:
        """Compare two models; parameters are sorted by their difference, the largest first."""
        names = dict.fromkeys([*one.model.table.names, *other.model.table.names])
        rows = [Difference.of(name, one.model, other.model) for name in names]
        changed = [row for row in rows if row.difference_tolerances != 0]
        changed.sort(key=lambda row: -abs(row.difference_tolerances or 0.0))
        return cls((Side.of(one), Side.of(other)), changed)
