"""The figures in space: residuals, two models side by side, the smooth map."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from parallel_cal.reporting.arrows import arrows, scale_of
from parallel_cal.reporting.figures import Spec, thinned
from parallel_cal.reporting.readable import with_unit

ARROWS = 300  # more hide each other
SI = {"position": "m", "orientation": "rad"}


def residual_arrows(found: Mapping[str, Any]) -> tuple[Spec, float] | None:
    """(figure, magnification) of what the fit leaves, as it is (traces with `meta` 0) and hidden
    with the effects found (1); None where no pose was measured."""
    if found["kind"] is None:
        return None
    fields = [np.array(found[key]) for key in ("now", "found") if found[key]]
    places = np.array(found["place"])
    scale = scale_of(places, fields)
    groups = [_drawn(places, f, scale, found["kind"], found["sample"]) for f in fields]
    traces = [
        trace | {"visible": k == 0, "meta": k} for k, group in enumerate(groups) for trace in group
    ]
    return {"data": traces, "layout": space(found["kind"])}, scale


def side(one: Mapping[str, Any], found: Mapping[str, Any]) -> tuple[Spec, float] | None:
    """The same of one of two models as it stands."""
    if found["kind"] is None:
        return None
    places, field = np.array(one["place"]), np.array(one["residual"])
    scale = scale_of(places, [field])
    drawn = _drawn(places, field, scale, found["kind"], found["sample"])
    return {"data": drawn, "layout": space(found["kind"]) | {"height": 380}}, scale


def smooth_map(found: Mapping[str, Any]) -> tuple[Spec, float] | None:
    """(figure, magnification) of the smooth picture of what is left; None where there is none, or
    where it lies in more joints than a picture has dimensions."""
    places, field = np.array(found["places"]), np.array(found["field"])
    if not found["size"] or places.shape[1:] != (3,):
        return None
    scale = scale_of(places, [field])
    drawn = _drawn(places, field, scale, found["kind"], range(len(field)))
    layout = space(found["kind"])
    if found["kind"] == "orientation":
        layout["scene"] |= {f"{a}axis": {"title": {"text": f"joint {k}"}} for k, a in
                            enumerate("xyz", 1)}  # fmt: skip
    return {"data": drawn, "layout": layout}, scale


def _drawn(
    places: np.ndarray, field: np.ndarray, scale: float, kind: str, numbers: Sequence[int]
) -> list[Spec]:
    """Arrows with their sizes as hover words, of long recordings some; positions in mm."""
    kept = thinned(len(places), ARROWS)
    places, field, numbers = places[kept], field[kept], [numbers[i] for i in kept]
    sizes = np.linalg.norm(field, axis=1)
    words = [f"{n}: {with_unit(size, SI[kind])}" for n, size in zip(numbers, sizes, strict=True)]
    return arrows(places, field, scale, words, 1e3 if kind == "position" else 1.0)


def space(kind: str) -> Spec:
    """Axes of equal scale: positions in mm; directions on the unit sphere have no unit."""
    unit = " [mm]" if kind == "position" else ""
    axes = {f"{a}axis": {"title": {"text": f"{a}{unit}"}} for a in "xyz"}
    camera = {"eye": {"x": 1.4, "y": -1.4, "z": 0.7}, "center": {"x": 0, "y": 0, "z": -0.13}}
    return {
        "scene": {**axes, "aspectmode": "data", "camera": camera},
        "margin": {"l": 0, "r": 0, "t": 0, "b": 0},
        "height": 500,
    }
