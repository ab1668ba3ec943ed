"""Small multiples: the residuals against each recorded quantity."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from parallel_cal.diagnosis.patterns import ResidualProfile
from parallel_cal.diagnosis.thresholds import LEVELS
from parallel_cal.reporting.colours import BAND, QUIET
from parallel_cal.reporting.contents import Residuals
from parallel_cal.reporting.figures import Spec, round_values, select_evenly
from parallel_cal.reporting.readable import name_p_value, probability, value_unit

# The palette of Okabe and Ito: distinguishable by the colour-blind, on light and dark grounds.
COMPONENTS = {
    "x": "#0072b2",
    "y": "#d55e00",
    "z": "#009e73",
    "rx": "#56b4e9",
    "ry": "#e69f00",
    "rz": "#cc79a7",
}
# of a panel's residuals, of a rolling mean
MAX_POINTS = 400
MAX_MEAN_POINTS = 150


def multiples(
    along: Sequence[ResidualProfile], found: Residuals, better: Sequence[ResidualProfile] = ()
) -> Iterator[tuple[ResidualProfile, str, Spec]]:
    """Yield (profile, description of its largest mean, figure) of each informative quantity.

    The strongest dependence comes first. `better` are the profiles with the effects found (traces
    with `meta` 1).
    """
    others = {entry.name: entry for entry in better}
    for entry in found.select_informative(along):
        panel = _panel(entry, found, found.noise_units)
        shown = [trace | {"meta": 0} for trace in panel["data"]]
        if entry.name in others and found.noise_units_found is not None:  # hidden, on one scale
            other = _panel(others[entry.name], found, found.noise_units_found)
            shown += [trace | {"meta": 1, "visible": False} for trace in other["data"]]
        yield entry, peak(entry, found.components), panel | {"data": shown}


def peak(entry: ResidualProfile, components: Sequence[str]) -> str:
    """Describe the largest mean: of which component, in sigmas, in multiples of the band of chance,
    and the chance of one as large."""
    means = _select_measured(entry)
    size = np.abs(means) / entry.band[:, None]
    at = np.unravel_index(int(np.argmax(size)), size.shape)
    which, p = components[int(at[1])], name_p_value(probability(entry.p_value))
    return f"mean of {which} up to {abs(means[at]):.1f} σ, {size[at]:.1f} × the band, {p}"


def _select_measured(entry: ResidualProfile) -> np.ndarray:
    """Return the means (m, k) of the components that were measured, as in `noise_units`."""
    return entry.mean[:, np.any(entry.mean != 0, axis=0)]


def _panel(entry: ResidualProfile, found: Residuals, z: np.ndarray) -> Spec:
    """Draw the points, the mean of each component, and the 99 % band about zero."""
    unit, factor = value_unit(found.units[entry.name])
    values, at = found.regressors[entry.name] * factor, entry.at * factor
    band = entry.band
    means = _select_measured(entry)
    few = len(np.unique(values)) <= LEVELS
    step = float(np.min(np.diff(at), initial=np.inf)) if few and len(at) > 1 else 0.0
    draw = _level_traces if few else _rolling_traces
    size = max(float(np.quantile(np.abs(z), 0.98)) if z.size else 0.0, 2.0)
    axis = {"title": {"text": unit, "standoff": 4}, "nticks": 6}
    if few:
        axis |= {"tickvals": at.tolist(), "range": [at[0] - 0.6 * step, at[-1] + 0.6 * step]}
    return {
        "data": [_points(values, z, 0.25 * step), *draw(at, band, means, found.components)],
        "layout": {
            "height": 210,
            "xaxis": axis,
            "yaxis": {"range": [-size, size], "nticks": 5, "title": {"text": "residual [σ]"}},
            "margin": {"t": 6, "r": 8, "l": 46, "b": 40},
        },
    }


def _points(values: np.ndarray, z: np.ndarray, width: float) -> Spec:
    """Draw the residuals: if there are many, a part of them; jittered if they would coincide."""
    kept = select_evenly(len(values), MAX_POINTS // max(z.shape[1], 1))
    x = np.repeat(values[kept], z.shape[1])
    spread = width * np.random.default_rng(0).uniform(-1, 1, len(x))
    return {
        "type": "scatter",
        "mode": "markers",
        "hoverinfo": "skip",
        "x": round_values(x + spread),
        "y": round_values(z[kept].ravel()),
        "marker": {"size": 3, "color": QUIET, "opacity": 0.3},
    }


def _rolling_traces(
    at: np.ndarray, band: np.ndarray, means: np.ndarray, names: Sequence[str]
) -> list[Spec]:
    kept = select_evenly(len(at), MAX_MEAN_POINTS)
    at, band, means = at[kept], band[kept], means[kept]
    grey = {
        "type": "scatter",
        "mode": "lines",
        "hoverinfo": "skip",
        "x": round_values(np.concatenate([at, at[::-1]])),
        "y": round_values(np.concatenate([band, -band[::-1]])),
        "fill": "toself",
        "fillcolor": BAND,
        "line": {"width": 0},
    }
    lines = [
        _mean(name, at, mean) | {"mode": "lines", "line": {"color": colour(name, k), "width": 2}}
        for k, (name, mean) in enumerate(zip(names, means.T, strict=True))
    ]
    return [grey, *lines]


def _level_traces(
    at: np.ndarray, band: np.ndarray, means: np.ndarray, names: Sequence[str]
) -> list[Spec]:
    """Draw a mean with its band for each level and component, side by side."""
    step = float(np.min(np.diff(at), initial=np.inf)) if len(at) > 1 else 1.0
    apart = 0.5 * step * (np.arange(len(names)) / max(len(names) - 1, 1) - 0.5)
    bars = {"array": round_values(band), "color": QUIET, "thickness": 6, "width": 0}
    traces = []
    for k, (name, mean, shift) in enumerate(zip(names, means.T, apart, strict=True)):
        zero = _mean(name, at + shift, np.zeros(len(at))) | {"error_y": bars, "opacity": 0.45}
        point, dot = {"size": 1, "color": QUIET}, {"size": 8, "color": colour(name, k)}
        traces += [
            zero | {"mode": "markers", "marker": point, "hoverinfo": "skip"},
            _mean(name, at + shift, mean) | {"mode": "markers", "marker": dot},
        ]
    return traces


def _mean(name: str, at: np.ndarray, mean: np.ndarray) -> Spec:
    return {
        "type": "scatter",
        "name": name,
        "x": round_values(at),
        "y": round_values(mean),
        "hovertemplate": "%{y:.2f} σ",
    }


def colour(name: str, number: int) -> str:
    """Return the colour of a pose component, or of what a sensor reads by its number."""
    palette = list(COMPONENTS.values())
    return COMPONENTS.get(name) or palette[number % len(palette)]
