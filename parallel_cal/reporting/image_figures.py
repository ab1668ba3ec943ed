"""The figures of what cameras saw, each described once for the report and the workbench."""

from __future__ import annotations

import colorsys
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from parallel_cal.identification.fit import FitResult
from parallel_cal.reporting.arrows import round_below
from parallel_cal.reporting.colours import MEASURED, PATTERN, QUIET
from parallel_cal.reporting.figures import (
    LEGEND,
    Spec,
    round_values,
    round_with_gaps,
    select_evenly,
    side_by_side,
)
from parallel_cal.reporting.images import CameraImages, list_images
from parallel_cal.reporting.projection_uncertainty import ProjectionUncertainty
from parallel_cal.reporting.readable import format_fixed

MAX_ARROWS = 4000
MAX_DRAWN_IMAGES = 6
TYPICAL_ARROW = 0.03  # of the image's width: length of a large arrow
LARGE_ARROW = 0.08  # in a panel, which is smaller
MAX_SIGMA_RATIO = 8.0  # of the usual uncertainty, at which the colours of its figure end


@dataclass(frozen=True)
class Picture:
    """A figure, its short name, and what it shows in words."""

    name: str
    words: str
    figure: Spec


def draw_cameras(result: FitResult) -> Iterator[Picture]:
    """Draw what each camera of a fit saw: residuals over the image, the worst images, how often
    each part of the image saw a corner, and the uncertainty of the projection."""
    cameras = list_images(result)
    for one in cameras:
        of = f" of {one.camera.name}" if len(cameras) > 1 else ""
        where = "poses that were held out" if one.held_out else "all poses"
        figure, scale = residual_arrows(one)
        yield Picture(
            f"corners{of}",
            f"{one.camera.name}: measured minus predicted corners at {where}, magnified {scale:g} "
            "times. Arrows without order are noise. Neighbours that point the same way show a "
            "lens, a board or a robot that the model does not describe. Colour is direction: red "
            "right, yellow-green down, cyan left, violet up.",
            figure,
        )
        figure, scale = worst_images(one)
        yield Picture(
            f"worst images{of}",
            f"{one.camera.name}: the images with the largest residuals, the worst first. Points "
            f"are measured corners, crosses predicted ones at {where}; the lines are the "
            f"differences, magnified {scale:g} times.",
            figure,
        )
        known = ProjectionUncertainty.of(result, one.camera, one.corners)
        if known is not None:
            drawn = projection(one, known)
            most = drawn["data"][0]["zmax"]
            yield Picture(
                f"lens{of}",
                f"{one.camera.name}: uncertainty of the projection (1 σ in the worst direction) of "
                f"a point {known.distance:.2g} m away, from the covariance of the lens: "
                f"{format_fixed(known.usual)} px rms where corners were seen. A motion of the "
                "camera that makes a wrong lens good does not count. Points: corners seen. Where "
                "the image shows none, the lens is only extrapolated; the colours end at "
                f"{most:.2g} px.",
                drawn,
            )


def _colour(direction: np.ndarray) -> str:
    """Return a hue by the direction in the image, red to the right."""
    hue = float(np.arctan2(direction[1], direction[0])) / (2 * np.pi) % 1.0
    r, g, b = colorsys.hls_to_rgb(hue, 0.5, 0.75)
    return f"rgb({255 * r:.0f},{255 * g:.0f},{255 * b:.0f})"


def residual_arrows(one: CameraImages) -> tuple[Spec, float]:
    """Draw the residuals as arrows over the image; return the figure and the magnification."""
    kept = select_evenly(len(one.corners), MAX_ARROWS)
    starts, moves = one.corners[kept], one.residuals[kept]
    scale = _magnify(one, TYPICAL_ARROW)
    colours = np.array([_colour(np.nan_to_num(v)) for v in moves])
    hues = np.round(np.arctan2(*np.nan_to_num(moves).T[::-1]) / (2 * np.pi) * 12) % 12
    data: list[Spec] = []
    for hue in np.unique(hues):  # one trace for each of twelve directions keeps the page small
        own = np.flatnonzero(hues == hue)
        data.append(_lines(starts[own], scale * moves[own], str(colours[own[0]])))
    data.append(
        {
            "type": "scatter",
            "mode": "markers",
            "x": round_with_gaps(starts[:, 0]),
            "y": round_with_gaps(starts[:, 1]),
            "marker": {"size": 2.5, "color": colours.tolist()},
            "text": [
                f"sample {n}: {v[0]:.2f} {v[1]:.2f} px"
                for n, v in zip(one.sample[kept].tolist(), moves, strict=True)
            ],
            "customdata": one.sample[kept].tolist(),
            "hoverinfo": "text",
            "showlegend": False,
        }
    )
    return {"data": data, "layout": _over_image(one)}, scale


def worst_images(one: CameraImages) -> tuple[Spec, float]:
    """Draw measured and predicted corners of the images with the largest residuals, the worst
    first; return the figure and the magnification of the lines between them."""
    known = np.isfinite(one.residuals).all(axis=1)
    numbers = np.unique(one.sample[known])
    square = np.sum(one.residuals**2, axis=1)
    rms = np.sqrt([square[known & (one.sample == n)].mean() for n in numbers])
    worst = numbers[np.argsort(-rms)][:MAX_DRAWN_IMAGES]
    scale = _magnify(one, LARGE_ARROW)
    panels, axes = [], []
    for n, size in zip(worst, np.sort(rms)[::-1], strict=False):
        own = known & (one.sample == n)
        corners, residuals = one.corners[own], one.residuals[own]
        predicted = corners - residuals
        lines = _lines(predicted, scale * residuals, PATTERN)
        marks = [
            _marks("measured", corners, {"size": 4, "color": MEASURED}),
            _marks(
                "predicted", predicted, {"size": 6, "color": QUIET, "symbol": "cross-thin-open"}
            ),
        ]
        panels.append([*marks, lines | {"name": f"difference, {scale:g} times"}])
        axes.append((f"sample {n}: {size:.2f} px rms", ""))
    width, height = one.camera.image_size
    figure = side_by_side(panels, axes, [height - 0.5, -0.5])
    for k in range(len(panels)):
        mark = str(k + 1) if k else ""
        across = figure["layout"][f"xaxis{mark}"]
        across |= {"range": [-0.5, width - 0.5], "constrain": "domain", "zeroline": False}
        figure["layout"][f"yaxis{mark}"] |= {
            "scaleanchor": f"x{mark}",
            "constrain": "domain",
            "zeroline": False,
        }
    return figure, scale


def projection(one: CameraImages, known: ProjectionUncertainty) -> Spec:
    """Draw the uncertainty of the projection as colours over the image, with the corners seen."""
    most = min(float(np.nanmax(known.sigma)), MAX_SIGMA_RATIO * known.usual)
    count = known.count.astype(int)
    colours: Spec = {
        "type": "heatmap",
        "x": round_values(known.u),
        "y": round_values(known.v),
        "z": [round_with_gaps(row) for row in known.sigma],
        "zmin": 0.0,
        "zmax": float(f"{most:.3g}"),
        "colorscale": "Cividis",
        "colorbar": {"title": {"text": "1 σ [px]"}, "thickness": 12},
        "text": [[f"{n} corners" if n else "no corner" for n in row] for row in count.tolist()],
        "hovertemplate": "%{z:.2g} px, %{text}<extra></extra>",
    }
    kept = select_evenly(len(one.corners), MAX_ARROWS)
    seen = _marks("corners seen", one.corners[kept], {"size": 2, "color": PATTERN})
    return {"data": [colours, seen | {"hoverinfo": "skip"}], "layout": _over_image(one)}


def _magnify(one: CameraImages, share: float) -> float:
    """Choose a round magnification that makes a large residual this share of the image's width."""
    size = float(np.nanquantile(np.linalg.norm(one.residuals, axis=1), 0.9))
    return round_below(share * one.camera.image_size[0] / size) if size > 0 else 1.0


def _lines(starts: np.ndarray, moves: np.ndarray, colour_: str) -> Spec:
    ends = np.stack([starts, starts + moves, np.full_like(starts, np.nan)], axis=1)
    return {
        "type": "scatter",
        "mode": "lines",
        "x": round_with_gaps(ends[:, :, 0]),
        "y": round_with_gaps(ends[:, :, 1]),
        "line": {"color": colour_, "width": 1},
        "hoverinfo": "skip",
        "showlegend": False,
    }


def _marks(name: str, at: np.ndarray, marker: Spec) -> Spec:
    return {
        "type": "scatter",
        "mode": "markers",
        "name": name,
        "x": round_with_gaps(at[:, 0]),
        "y": round_with_gaps(at[:, 1]),
        "marker": marker,
    }


def _over_image(one: CameraImages) -> Spec:
    """Lay out a figure over the image, with v pointing down."""
    width, height = one.camera.image_size
    return {
        "height": 60 + round(820 * height / width),
        "margin": {"t": 12, "r": 8, "l": 56, "b": 44},
        "showlegend": False,
        "legend": LEGEND,
        "xaxis": {
            "range": [-0.5, width - 0.5],
            "title": {"text": "u [px]", "standoff": 4},
            "constrain": "domain",
            "zeroline": False,
        },
        "yaxis": {
            "range": [height - 0.5, -0.5],
            "title": {"text": "v [px]", "standoff": 4},
            "scaleanchor": "x",
            "constrain": "domain",
            "zeroline": False,
        },
    }
