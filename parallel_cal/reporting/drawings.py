"""The drawing of a mechanism at any configuration, with the names of its parameters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from html import escape
from types import MappingProxyType

import casadi as ca
import numpy as np

from parallel_cal.model.model import Model
from parallel_cal.reporting.axes import name_axis, space
from parallel_cal.reporting.colours import MEASURED, QUIET, WARNING
from parallel_cal.reporting.contents import DescribedParameter
from parallel_cal.reporting.figures import (
    MAX_MOVED_TOLERANCES,
    Spec,
    describe_parameter,
    round_values,
    round_with_gaps,
)

# The palette of Okabe and Ito: driven parts, rods, platform.
COLOURS = {
    "base": QUIET,
    "axis": QUIET,
    "driven": MEASURED,
    "rod": "#009e73",
    "platform": "#cc79a7",
}
# Where a label may stand, in Plotly's words, and where the lower left corner of its box then is,
# in widths and heights of the box from the labelled point.
LABEL_POSITIONS = {
    "top center": (-0.5, 0.0),
    "bottom center": (-0.5, -1.0),
    "middle right": (0.0, -0.5),
    "middle left": (-1.0, -0.5),
    "top right": (0.0, 0.0),
    "top left": (-1.0, 0.0),
    "bottom right": (0.0, -1.0),
    "bottom left": (-1.0, -1.0),
}
# Width of a letter and height of a line, in parts of the height of the figure.
LABEL_SIZE = np.array([6.5, 16.0]) / 460
LABEL_ROUNDS = 3  # in which each label moves away from the others
# Plotly's camera.
FIELD_OF_VIEW = np.pi / 4
ORIGIN, UPWARDS = {"x": 0, "y": 0, "z": 0}, {"x": 0, "y": 0, "z": 1}
WIDTHS = {"base": 4, "axis": 2, "driven": 8, "rod": 5, "platform": 7}


@dataclass(frozen=True)
class DrawnLine:
    """A line of a mechanism: `points` (m, 3) m in {B}, and the parameters that it shows."""

    kind: str
    points: np.ndarray
    parameters: tuple[str, ...]

    @property
    def middle(self) -> np.ndarray:
        """The point half way along the line."""
        steps = np.linalg.norm(np.diff(self.points, axis=0), axis=1)
        way = np.concatenate([[0.0], np.cumsum(steps)])
        return np.array([np.interp(way[-1] / 2, way, column) for column in self.points.T])

    @property
    def label(self) -> str:
        """Format `chain1: Lb dLb`, or only the names if the line stands for all chains."""
        parts = [name.rpartition(".") for name in self.parameters]
        owners = list(dict.fromkeys(owner for owner, _, _ in parts))
        short = " ".join(dict.fromkeys(name for _, _, name in parts))
        return f"{owners[0]}: {short}" if len(owners) == 1 and owners[0] else short


def lines(model: Model, x: np.ndarray | None = None) -> list[DrawnLine]:
    """Make the lines of a model's geometry at a configuration (nq + 12,), by default home."""
    s, names = model.structure, model.mechanism.parameters.names
    x = model.mechanism.home.configuration if x is None else x
    parts = s.drawing()
    if not parts:
        return []
    columns = [ca.horzcat(*[ca.SX(point) for point in part.points]) for part in parts]
    evaluate = ca.Function("drawing", [s.configuration, s.v], columns)
    points = evaluate.call([ca.DM(x), ca.DM(model.values)])
    return [
        DrawnLine(
            part.kind,
            np.array(at).T,
            tuple(name for name in names if any(fnmatchcase(name, one) for one in part.shows)),
        )
        for part, at in zip(parts, points, strict=True)
    ]


def drawing(
    model: Model, x: np.ndarray | None = None, found: Mapping[str, DescribedParameter] | None = None
) -> Spec | None:
    """Draw the mechanism in space, with one label for each kind of parameter.

    Hovering over a line shows all its parameters. If `found` is given, lines whose parameters
    moved far are marked. The result is None if the mechanism draws nothing.
    """
    parts = lines(model, x)
    if not parts:
        return None
    groups: dict[tuple[str, bool], list[DrawnLine]] = {}
    for part in parts:
        own = [found[name] for name in part.parameters if name in found] if found else []
        far = any(abs(p.moved_tolerances) > MAX_MOVED_TOLERANCES for p in own if not p.fixed)
        groups.setdefault((part.kind, far), []).append(part)
    traces = [trace_lines(kind, own, far, found or {}) for (kind, far), own in groups.items()]
    named = select_labelled(parts)
    at = 1e3 * np.array([part.middle for part in named]).reshape(-1, 3)
    texts = [escape(part.label) for part in named]
    words: Spec = {
        "type": "scatter3d",
        "mode": "text",
        "name": "parameters",
        "hoverinfo": "skip",
        "x": round_values(at[:, 0]),
        "y": round_values(at[:, 1]),
        "z": round_values(at[:, 2]),
        "text": texts,
        "textfont": {"size": 11},
    }
    points = 1e3 * np.vstack([part.points for part in parts])
    middle, half = (points.min(0) + points.max(0)) / 2, 0.55 * np.ptp(points, axis=0).max()
    axes: Spec = {
        f"{a}axis": {"title": {"text": name_axis(a)}, "range": [float(m - half), float(m + half)]}
        for a, m in zip("xyz", middle, strict=True)
    }
    camera = space("position")["scene"]["camera"]
    if flat(parts):
        axes["zaxis"]["visible"] = False
        camera = {"eye": {"x": 0, "y": 0, "z": 1.6}, "up": {"x": 0, "y": 1, "z": 0}}
    words["textposition"] = _place_labels((at - middle) / (2 * half), texts, camera)
    layout = {
        "height": 460,
        "showlegend": True,
        "legend": {"orientation": "h", "y": 0, "x": 0},
        "margin": {"l": 0, "r": 0, "t": 0, "b": 0},
        "scene": axes | {"aspectmode": "cube", "camera": camera},
    }
    return {"data": [*traces, words | {"showlegend": False}], "layout": layout}


def _place_labels(at: np.ndarray, texts: Sequence[str], camera: Spec) -> list[str]:
    """Choose for each label where it covers the others least, as `camera` first shows them.

    The labels are at (n, 3) in the cube of the axes, whose side is 1.
    """
    eye = np.array([camera["eye"][axis] for axis in "xyz"])
    centre = np.array([camera.get("center", ORIGIN)[axis] for axis in "xyz"])
    up = np.array([camera.get("up", UPWARDS)[axis] for axis in "xyz"])
    ahead = (centre - eye) / np.linalg.norm(centre - eye)
    right = np.cross(ahead, up) / np.linalg.norm(np.cross(ahead, up))
    seen = (at - eye) @ np.column_stack([right, np.cross(right, ahead), ahead])
    places = seen[:, :2] / seen[:, 2:] / (2 * np.tan(FIELD_OF_VIEW / 2))
    boxes, chosen = np.full((len(texts), 2, 2), np.inf), [""] * len(texts)
    for k in [*range(len(texts))] * LABEL_ROUNDS:
        size = LABEL_SIZE * [len(texts[k]), 1]
        low = places[k] + size * np.array([*LABEL_POSITIONS.values()])
        possible = np.stack([low, low + size], axis=1)
        others = np.delete(boxes, k, axis=0)
        shared = np.minimum(possible[:, None, 1], others[:, 1]) - np.maximum(
            possible[:, None, 0], others[:, 0]
        )
        best = int(np.argmin(shared.clip(0).prod(axis=2).sum(axis=1)))
        boxes[k], chosen[k] = possible[best], [*LABEL_POSITIONS][best]
    return chosen


def flat(parts: list[DrawnLine]) -> bool:
    """Return whether all lines lie at one height."""
    return bool(np.ptp(np.vstack([part.points for part in parts])[:, 2]) < 1e-6)


def select_labelled(parts: list[DrawnLine]) -> list[DrawnLine]:
    """Choose one of the lines with equal parameter names: the one furthest from those before."""
    alike: dict[tuple[str, ...], list[DrawnLine]] = {}
    for part in parts:
        if part.parameters:
            key = tuple(name.rpartition(".")[2] for name in part.parameters)
            alike.setdefault(key, []).append(part)
    chosen: list[DrawnLine] = []
    for own in alike.values():
        distances = [
            min((float(np.linalg.norm(part.middle - o.middle)) for o in chosen), default=0.0)
            for part in own
        ]
        chosen.append(own[int(np.argmax(distances))])
    return chosen


def trace_lines(
    kind: str,
    parts: Sequence[DrawnLine],
    far: bool = False,
    found: Mapping[str, DescribedParameter] = MappingProxyType({}),
) -> Spec:
    """Make one trace of lines of a kind; hovering shows their parameters, with the values `found`.
    Lines whose parameters moved `far` have the colour of a warning."""
    points, words = [], []
    for part in parts:
        told = [describe_parameter(found[n]) if n in found else escape(n) for n in part.parameters]
        points.append(np.vstack([part.points, np.full(3, np.nan)]))
        words += ["<br>".join(told) or kind] * (len(part.points) + 1)
    at = 1e3 * np.vstack(points)
    return {
        "type": "scatter3d",
        "mode": "lines",
        "name": f"{kind}, moved over {MAX_MOVED_TOLERANCES:g} tolerances" if far else kind,
        "x": round_with_gaps(at[:, 0]),
        "y": round_with_gaps(at[:, 1]),
        "z": round_with_gaps(at[:, 2]),
        "line": {"width": WIDTHS[kind], "color": WARNING if far else COLOURS[kind]},
        "text": words,
        "hoverinfo": "text",
    }
