"""Residual arrows in space, coloured by size, all on one stated scale and one ramp of colours."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from parallel_cal.base.units import ERROR_SI_UNITS
from parallel_cal.reporting.axes import list_round_ticks
from parallel_cal.reporting.figures import Spec
from parallel_cal.reporting.readable import error_unit

TYPICAL_ARROW_RATIO = 0.16  # length of a typical large arrow, as a share of the workspace
HEAD, WIDTH = 0.3, 0.35  # length of a head per arrow, width of a head per head length
# From small to large: legible on a light and on a dark ground, and for colour-blind readers.
RAMP_COLOURS = ((127, 159, 198), (230, 159, 0), (193, 39, 45))
MIN_RAMP_RATIO = 2.0  # of its ends: sizes that hardly differ have nearly one colour


@dataclass(frozen=True)
class Ramp:
    """The colours of sizes from `low` to `high` (SI), by their logarithm."""

    low: float
    high: float

    @classmethod
    def over(cls, fields: Sequence[np.ndarray]) -> Ramp:
        """Make one ramp for several fields of vectors (N, 3)."""
        sizes = np.concatenate([np.empty(0), *(np.linalg.norm(f, axis=1) for f in fields)])
        sizes = sizes[sizes > 0]
        if not sizes.size:
            return cls(1.0, MIN_RAMP_RATIO)
        low, high = np.quantile(sizes, (0.1, 0.98))
        return cls(float(low), float(max(high, MIN_RAMP_RATIO * low)))

    def colour(self, size: float) -> str:
        """Return the colour of a size; beyond the ends, that of the end."""
        share = np.log(max(size, self.low) / self.low) / np.log(self.high / self.low)
        at = np.linspace(0.0, 1.0, len(RAMP_COLOURS))
        r, g, b = (np.interp(share, at, levels) for levels in zip(*RAMP_COLOURS, strict=True))
        return f"rgb({r:.0f},{g:.0f},{b:.0f})"

    def bar(self, kind: str) -> Spec:
        """Make an invisible trace whose colour bar explains the colours, at the top left."""
        unit, factor = error_unit(ERROR_SI_UNITS[kind])
        ends = [factor * self.low, factor * self.high]
        ticks = list_round_ticks(*ends)
        steps = np.linspace(0.0, 1.0, len(RAMP_COLOURS))
        return {
            "type": "scatter3d",
            "mode": "markers",
            "x": [None],
            "y": [None],
            "z": [None],
            "showlegend": False,
            "hoverinfo": "skip",
            "marker": {
                "color": [float(np.log10(ends[0]))],
                "cmin": float(np.log10(ends[0])),
                "cmax": float(np.log10(ends[1])),
                "colorscale": [
                    [float(at), f"rgb{colour}"]
                    for at, colour in zip(steps, RAMP_COLOURS, strict=True)
                ],
                "showscale": True,
                "colorbar": {
                    # Above the picture: beside it, it would cover an axis of a narrow window.
                    "orientation": "h",
                    "thickness": 8,
                    "len": 0.4,
                    "x": 0.0,
                    "xanchor": "left",
                    "y": 1.0,
                    "yanchor": "top",
                    "outlinewidth": 0,
                    "tickvals": [float(np.log10(tick)) for tick in ticks],
                    "ticktext": [f"{tick:g}" for tick in ticks],
                    "title": {"text": f"error [{unit}]", "side": "top"},
                },
            },
        }


def scale_of(places: np.ndarray, fields: Sequence[np.ndarray]) -> float:
    """Choose a round magnification (1, 2 or 5 times a power of ten) for several fields."""
    span = float(np.linalg.norm(np.ptp(places, axis=0)))
    size = max(float(np.quantile(np.linalg.norm(f, axis=1), 0.9)) for f in fields)
    if not size or not span:
        return 1.0
    return round_below(TYPICAL_ARROW_RATIO * span / size)


def typical(field: np.ndarray) -> float:
    """Return a round size near the 90 % quantile of the vectors (N, 3)."""
    return round_below(float(np.quantile(np.linalg.norm(field, axis=1), 0.9)))


def round_below(value: float) -> float:
    """Return the largest 1, 2 or 5 times a power of ten up to a value; 1 if it is not positive."""
    if not value > 0:
        return 1.0
    power = 10.0 ** np.floor(np.log10(value))
    return float(max(step * power for step in (1, 2, 5) if step * power <= value))


def arrows(
    places: np.ndarray,
    field: np.ndarray,
    scale: float,
    words: Sequence[str],
    factor: float = 1.0,
    ramp: Ramp | None = None,
) -> list[Spec]:
    """Draw arrows (N, 3) at places (N, 3) with hover texts; `factor` converts SI to the axes'
    unit. The `ramp` of their colours is by default their own."""
    starts, ends = places * factor, (places + scale * field) * factor
    ramp = ramp or Ramp.over([field])
    colours = [ramp.colour(size) for size in np.linalg.norm(field, axis=1)]
    shafts = np.stack([starts, ends, np.full_like(starts, np.nan)], axis=1).reshape(-1, 3)
    lines = {
        "type": "scatter3d",
        "mode": "lines",
        **_coordinates(shafts),
        "line": {"width": 5, "color": [c for c in colours for _ in range(3)]},
        "hoverinfo": "skip",
    }
    spots = {
        "type": "scatter3d",
        "mode": "markers",
        **_coordinates(starts),
        "marker": {"size": 3, "color": colours},
        "text": list(words),
        "hoverinfo": "text",
    }
    return [
        trace | {"showlegend": False} for trace in (lines, _heads(starts, ends, colours), spots)
    ]


def _coordinates(points: np.ndarray) -> Spec:
    rounded = np.round(points, 4)
    return {
        axis: [None if np.isnan(v) else float(v) for v in rounded[:, k]]
        for k, axis in enumerate("xyz")
    }


def _heads(starts: np.ndarray, ends: np.ndarray, colours: list[str]) -> Spec:
    """Draw a pyramid of three sides at the end of every arrow."""
    along = HEAD * (ends - starts)
    size = np.linalg.norm(along, axis=1, keepdims=True)
    upright = np.abs(along[:, :1]) < np.abs(along[:, 2:])
    u = _unit(np.cross(along, np.where(upright, [[1.0, 0.0, 0.0]], [[0.0, 0.0, 1.0]])))
    v = _unit(np.cross(along, u))
    thirds = np.arange(3) * 2 * np.pi / 3
    corners = [ends - along + WIDTH * size * (np.cos(t) * u + np.sin(t) * v) for t in thirds]
    vertices = np.stack([ends, *corners], axis=1).reshape(-1, 3)
    first = 4 * np.arange(len(ends))[:, None]
    i, j, k = (
        (first + np.array(corner)).ravel().tolist()
        for corner in ([0, 0, 0, 1], [1, 2, 3, 2], [2, 3, 1, 3])
    )
    return {
        "type": "mesh3d",
        **_coordinates(vertices),
        "i": i,
        "j": j,
        "k": k,
        "facecolor": [c for c in colours for _ in range(4)],
        "hoverinfo": "skip",
        "lighting": {"ambient": 0.9, "diffuse": 0.2},
    }


def _unit(vectors: np.ndarray) -> np.ndarray:
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12))
