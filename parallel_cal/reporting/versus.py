"""Two models beside each other on the same data, as they stand."""

from __future__ import annotations

from typing import Any

from parallel_cal.diagnosis.comparison import Comparison
from parallel_cal.model.file.modelfile import model_hash
from parallel_cal.model.model import Model
from parallel_cal.reporting.contents import places


def versus(one: Comparison, other: Comparison) -> dict[str, Any]:
    """Errors and residuals of both, and the parameters in which they differ; all values SI."""
    return {
        "sides": [_side(one), _side(other)],
        "parameters": _differences(one.model, other.model),
    }


def _side(one: Comparison) -> dict[str, Any]:
    return {
        "mechanism": one.model.mechanism.name,
        "effects": [effect.name for effect in one.model.effects],
        "model_sha256": model_hash(one.model),
        "errors": one.errors.document(),
        "noise": one.noise.document(),
        "chi2_per_dof": one.scene.chi2_per_dof,
        "place": places(one.scene, one.field.kind).tolist(),
        "residual": one.field.vectors.tolist(),
    }


def _differences(one: Model, other: Model) -> list[dict[str, Any]]:
    """Rows of the parameters that differ or that one lacks, largest difference first."""
    names = dict.fromkeys([*one.table.names, *other.table.names])
    rows = [_difference(name, one, other) for name in names]
    changed = [row for row in rows if row["difference_tolerances"] != 0]
    return sorted(changed, key=lambda row: -abs(row["difference_tolerances"] or 0.0))


def _difference(name: str, one: Model, other: Model) -> dict[str, Any]:
    """One parameter of both; None where a model lacks it."""
    values = [m.value(name) if name in m.table.names else None for m in (one, other)]
    table = (one if values[0] is not None else other).table
    p = table[table.index_of(name)]
    known = None not in values
    apart = (values[1] - values[0]) / p.tolerance if known else None  # type: ignore[operator]
    return {"name": name, "unit": p.unit, "values": values, "difference_tolerances": apart}
