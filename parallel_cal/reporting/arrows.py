"""Residual arrows in space, coloured by direction, all on one stated scale."""

from __future__ import annotations

import colorsys
from collections.abc import Sequence

import numpy as np

from parallel_cal.reporting.figures import Spec

TYPICAL_ARROW_RATIO = 0.16  # length of a typical large arrow, as a share of the workspace
HEAD, WIDTH = 0.3, 0.35  # length of a head per arrow, width of a head per head length


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
    places: np.ndarray, field: np.ndarray, scale: float, words: Sequence[str], factor: float = 1.0
) -> list[Spec]:
    """Draw arrows (N, 3) at places (N, 3) with hover texts; `factor` converts SI to the axes'
    unit."""
    starts, ends = places * factor, (places + scale * field) * factor
    colours = [colour(v) for v in field]
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


def colour(direction: np.ndarray) -> str:
    """Return a hue by the direction in the x-y plane, red along +x; light up, dark down."""
    x, y, z = direction
    length = float(np.linalg.norm(direction))
    hue = float(np.arctan2(y, x)) / (2 * np.pi) % 1.0
    lightness = 0.5 + 0.22 * (float(z) / length if length else 0.0)
    r, g, b = colorsys.hls_to_rgb(hue, lightness, 0.75)
    return f"rgb({255 * r:.0f},{255 * g:.0f},{255 * b:.0f})"
