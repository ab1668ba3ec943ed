"""How far the predictions of two models differ over the workspace."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from parallel_cal.base.documents import to_json_value
from parallel_cal.identification.position_uncertainty import PositionDifference
from parallel_cal.model.model import Model
from parallel_cal.reporting import maps
from parallel_cal.reporting.readable import with_unit

SAME_POSITION_M = 1e-9  # m; smaller differences are rounding errors


def draw_difference(
    first: Model,
    second: Model,
    one: str,
    other: str,
    recorded: Mapping[str, np.ndarray] | None = None,
) -> dict[str, Any]:
    """Draw where the second model places the platform minus where the first does, with the 1-sigma
    uncertainty of each; a sentence only if there is no map or no difference. Places get the
    `recorded` conditions of samples, columns (N,) by name."""
    title = f"predictions of {other} minus those of {one}"
    found = PositionDifference.of(first, second, recorded)
    if found is None:
        return {"words": f"{title}: no map, because the models reach no common plane of positions"}
    sizes = np.linalg.norm(found.difference, axis=1)
    placed = (
        f"the two fits place the base {with_unit(found.frames_apart, 'm')} apart in the frame of "
        "the device"
        if found.frames_apart > SAME_POSITION_M
        else ""
    )
    if sizes.max() < SAME_POSITION_M:
        same = f"{one} and {other} predict the same positions"
        return {"words": f"{same}; {placed}" if placed else same}
    figure, scale = maps.residuals(
        found.places, [found.difference], "position", np.arange(len(found.places))
    )
    for trace in figure["data"]:
        trace.pop("customdata", None)  # these are no samples that could be marked
        trace["showlegend"] = False
    sigmas = [
        f"1 sigma of {name} {'unknown' if sigma is None else with_unit(sigma, 'm')}"
        for name, sigma in zip((one, other), found.sigmas, strict=True)
    ]
    rms = with_unit(float(np.sqrt(np.mean(sizes**2))), "m")
    words = (
        f"{title}, as the measuring device sees them, magnified {scale:g} times: {rms} rms over "
        f"the workspace, at most {with_unit(float(sizes.max()), 'm')}; {', '.join(sigmas)}"
    )
    words += "".join(f"; {part}" for part in (placed, found.validity) if part)
    return {"words": words, "figure": to_json_value(figure)}
