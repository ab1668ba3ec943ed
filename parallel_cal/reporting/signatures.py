"""The pattern of a candidate over the measured residuals, in sigmas."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from parallel_cal.base.confidence import format_percent
from parallel_cal.diagnosis.patterns import compute_mean_profile
from parallel_cal.diagnosis.signature import Panel, Signature
from parallel_cal.diagnosis.thresholds import LEVELS
from parallel_cal.model.mechanism import Mechanism
from parallel_cal.reporting.colours import BAND, MEASURED, PATTERN, QUIET
from parallel_cal.reporting.contents import unit_along
from parallel_cal.reporting.figures import (
    Spec,
    round_values,
    round_with_gaps,
    select_points,
    side_by_side,
)
from parallel_cal.reporting.joint_panels import MAX_POINTS_PER_JOINT
from parallel_cal.reporting.readable import (
    number,
    value_unit,
    with_unit,
)


def figure(found: Signature, mechanism: Mechanism, shown: np.ndarray | None = None) -> Spec:
    """Draw the pattern of a candidate over the measured residuals: at samples whose numbers are
    `shown`, by default at samples of all.

    There is one panel for each joint that the effect acts on, otherwise for the components that
    depend most on a quantity. A panel has the residuals (grey points), their rolling mean with
    the 99 % band, and the rolling mean of the pattern.
    """
    panels = [list(_traces(panel, mechanism, found.effect, shown)) for panel in found.panels]
    axes = [
        (_across(panel, mechanism).replace(": ", "\n"), f"{panel.component} residual [σ]")
        for panel in found.panels
    ]
    sizes = [float(np.quantile(abs(panel.residual), 0.98)) for panel in found.panels]
    size = max([2.0, *sizes])
    return side_by_side(panels, axes, [-size, size])


def describe_signature(found: Signature, mechanism: Mechanism) -> str:
    """Describe the figure for screen readers."""
    panels = (f"{p.component} against {_across(p, mechanism)}" for p in found.panels)
    return f"{found.effect}: residual of {', '.join(panels)}, in sigmas, with its pattern"


def describe_pattern(found: Signature, probability: float | None, mechanism: Mechanism) -> str:
    """Describe how probable an effect is, and how large its pattern in each panel."""
    amplitudes = ", ".join(f"{p.component} {_amplitude(p, mechanism)}" for p in found.panels)
    known = "" if probability is None else f"{format_percent(probability)} probable. "
    return f"{known}Amplitude of the pattern: {amplitudes}."


def _amplitude(panel: Panel, mechanism: Mechanism) -> str:
    """Format half of the peak-to-peak value of the dashed line: `12.3 µm (2.1 σ)`."""
    half = np.ptp(compute_mean_profile("", panel.at, panel.pattern[:, None]).mean) / 2
    unit = unit_along(mechanism, panel.component)
    size = f"{number(half, digits=2)} σ"
    return f"{with_unit(half * panel.sigma, unit)} ({size})" if unit else size


def _across(panel: Panel, mechanism: Mechanism) -> str:
    unit, factor = value_unit(unit_along(mechanism, panel.abscissa))
    if panel.abscissa.startswith("direction."):
        joint = panel.abscissa.partition(".")[2]
        return f"approach of {joint}: falling −1, rising +1"
    within = f" mod {number(panel.period, factor)} {unit}" if panel.period else ""
    return f"{panel.abscissa}{within}" + (f" [{unit}]" if unit else "")


def _traces(
    panel: Panel, mechanism: Mechanism, effect: str, shown: np.ndarray | None
) -> Iterator[Spec]:
    """Draw the points, the band and the two means."""
    factor = value_unit(unit_along(mechanism, panel.abscissa))[1]
    at, both = panel.at, np.column_stack([panel.residual, panel.pattern])
    means = compute_mean_profile(panel.abscissa, at, both)
    few = len(np.unique(at)) <= LEVELS
    step = float(np.min(np.diff(means.at), initial=np.inf)) if few and len(means.at) > 1 else 0.0
    kept, name = select_points(panel.sample, shown, MAX_POINTS_PER_JOINT)
    spread = 0.2 * step * np.random.default_rng(0).uniform(-1, 1, len(kept))
    yield {
        "type": "scatter",
        "mode": "markers",
        "name": name,
        "hoverinfo": "text",
        "x": round_values((at[kept] + spread) * factor),
        "y": round_values(panel.residual[kept]),
        "marker": {"size": 4, "color": QUIET, "opacity": 0.45},
        "text": [f"sample {n}" for n in panel.sample[kept]],
        "customdata": panel.sample[kept].tolist(),
    }
    x, wide = means.at * factor, 0.3 * step * factor
    if few:
        # A rectangle about each (x, 0), with gaps between them.
        none, half = np.full(len(x), np.nan), means.band
        corners = [x - wide, x + wide, x + wide, x - wide, x - wide, none]
        across = np.column_stack(corners).ravel()
        up = np.column_stack([half, half, -half, -half, half, none]).ravel()
    else:
        across, up = np.append(x, x[::-1]), np.append(means.band, -means.band[::-1])
    yield {
        "type": "scatter",
        "mode": "lines",
        "name": "99 % band",
        "x": round_with_gaps(across),
        "y": round_with_gaps(up),
        "fill": "toself",
        "fillcolor": BAND,
        "line": {"width": 0},
        "hoverinfo": "skip",
    }
    blue, orange = {"color": MEASURED, "width": 2}, {"color": PATTERN, "width": 3, "dash": "dash"}
    for name, mean, look in (
        ("measured, mean", means.mean[:, 0], blue),
        (f"pattern of {effect}", means.mean[:, 1], orange),
    ):
        across, up = x, mean
        if few:  # too few values to roll: a stroke at each, gaps between them
            across = np.column_stack([x - wide, x + wide, np.full(len(x), np.nan)]).ravel()
            up = np.repeat(mean, 3)
        yield {
            "type": "scatter",
            "mode": "lines",
            "name": name,
            "x": round_with_gaps(across),
            "y": round_with_gaps(up),
            "line": look,
            "hovertemplate": "%{y:.2f} σ",
        }
