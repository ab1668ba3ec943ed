"""The first picture of the page: the robot to scale, the device, and the errors as arrows."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from parallel_cal.identification.registration import SENSOR, frames_of
from parallel_cal.model.model import Model
from parallel_cal.model.words import join_words
from parallel_cal.reporting.arrows import Ramp, round_below, scale_of, typical
from parallel_cal.reporting.axes import name_axis, space
from parallel_cal.reporting.colours import MEASURED, QUIET
from parallel_cal.reporting.contents import DescribedParameter
from parallel_cal.reporting.drawings import DrawnLine, flat, lines, trace_lines
from parallel_cal.reporting.figures import Spec
from parallel_cal.reporting.names import title_of
from parallel_cal.reporting.readable import error_unit, number
from parallel_cal.reporting.spaces import draw_arrows

# The axes hold arrows at most this many times as long as on their own scale; they cut longer ones.
MAX_ARROW_RATIO = 4.0
MIN_GLOWING_SIGMAS = 2.0  # of a size that makes a part glow
DEVICE_NEAR = 2.2  # half extents of the robot within which the device is drawn at its place
GLOW_WIDTH, GLOW_COLOUR = 16, "#f08c2e"
LABEL = {"bgcolor": "rgba(160,160,160,0.6)", "font": {"size": 12}}
ARROW_RATIO = 0.12  # least length of a typical large arrow, as a share of the robot
LOWER = -0.2  # than other figures in space is the middle, so that no label at the bottom is cut
SCENE_TOP = 0.92  # of the picture; the colour bar is above
NO_PLACES, NO_NUMBERS = np.empty((0, 3)), np.empty(0, int)
NUMBERED = re.compile(r"([a-z_]*[a-z])(\d+)")


@dataclass(frozen=True)
class Stage:
    """Errors (N, 3) of the position (m, in {B}) by one model; NaN where a sample is not judged."""

    name: str
    field: np.ndarray
    error: str = ""  # its rms with its unit


@dataclass(frozen=True)
class ErringPart:
    """What an effect does to one part of the machine: its size in SI."""

    effect: str
    owner: str
    size: float
    unit: str

    @property
    def text(self) -> str:
        """`leg 2: 24.3 µm`."""
        unit, factor = error_unit(self.unit)
        name = NUMBERED.fullmatch(self.owner)
        owner = f"{name[1]} {name[2]}" if name else self.owner
        return f"{owner}: {number(self.size, factor)} {unit}"


def find_erring_parts(
    effects: Sequence[str], parameters: Mapping[str, DescribedParameter]
) -> list[ErringPart]:
    """List the parts in which effects act, with their sizes: those that stand out of their sigma.

    The size of several lengths or angles of one part, such as a sine and a cosine, is the root of
    their squares. Parameters in other units (a share, a compliance) have no size.
    """
    found = []
    for effect in effects:
        by_owner: dict[str, list[DescribedParameter]] = {}
        for name, one in parameters.items():
            head, _, rest = name.partition(".")
            if head == effect and not one.fixed and one.unit in ("m", "rad"):
                by_owner.setdefault(rest.partition(".")[0], []).append(one)
        for owner, own in by_owner.items():
            stands_out = any(p.sigma and abs(p.value) > MIN_GLOWING_SIGMAS * p.sigma for p in own)
            if stands_out and len({p.unit for p in own}) == 1:
                size = float(np.linalg.norm([p.value for p in own]))
                found.append(ErringPart(effect, owner, size, own[0].unit))
    return found


def describe_erring_parts(parts: Sequence[ErringPart], joints: Sequence[str]) -> str:
    """Describe the parts of each effect: `Backlash in all 6 legs: 24.0 to 53.0 µm.`"""
    sentences = []
    for effect in dict.fromkeys(part.effect for part in parts):
        own = [part for part in parts if part.effect == effect]
        names = [NUMBERED.fullmatch(part.owner) for part in own]
        where = join_words(part.owner for part in own)
        if [part.owner for part in own] == list(joints) and len(own) > 1:
            family = names[0][1] if names[0] else "joint"
            where = f"all {len(own)} {family}s"
        elif all(names):
            where = join_words(f"{name[1]} {name[2]}" for name in names if name)
        unit, factor = error_unit(own[0].unit)
        ends = [number(one(part.size for part in own), factor) for one in (min, max)]
        size = " to ".join(dict.fromkeys(ends))
        title = title_of(effect)
        sentences.append(f"{title[0].upper()}{title[1:]} in {where}: {size} {unit}.")
    return " ".join(sentences)


def _trace_robot(parts: Sequence[DrawnLine], glow: Sequence[DrawnLine]) -> list[Spec]:
    """Traces of the parts of a robot by kind; those that err glow."""
    robot = [
        trace_lines(kind, plain)
        for kind in dict.fromkeys(part.kind for part in parts)
        if (
            plain := [
                part for part in parts if part.kind == kind and not any(part is one for one in glow)
            ]
        )
    ]
    if glow:
        line = {"width": GLOW_WIDTH, "color": GLOW_COLOUR}
        robot.append(trace_lines("driven", glow) | {"name": "errs", "line": line})
    return robot


def draw_machine(
    model: Model,
    places: np.ndarray = NO_PLACES,
    stages: Sequence[Stage] = (),
    numbers: np.ndarray = NO_NUMBERS,
    erring: Sequence[ErringPart] = (),
) -> Spec | None:
    """Draw the robot at home, the device, and for each stage the errors at places (N, 3) in {B}.

    The result has the `layout`, the traces `robot` that all stages share, the magnifications
    `scales`, and the `stages`, each with its name, rms `error`, and traces by magnification. The
    first magnification shows the errors of the first stage, the second one, if any, enlarges those
    that became small. Each holds for all stages, so that the arrows shrink as the errors do; so
    does one ramp of colours. The parts that err glow. None if the mechanism draws nothing.
    """
    parts = lines(model)
    if not parts:
        return None
    shown = [_choose_samples(places, stage) for stage in stages]
    robot_size = float(np.ptp(np.vstack([part.points for part in parts]), axis=0).max())
    own = [
        max(scale_of(at, [field]), round_below(ARROW_RATIO * robot_size / typical(field)))
        for _, at, field in shown
    ]
    scales = sorted({own[0], max(own)}) if own else []
    ends = [
        at + scale * field
        for (_, at, field), best in zip(shown, own, strict=True)
        for scale in scales
        if scale <= MAX_ARROW_RATIO * best
    ]
    points = 1e3 * np.vstack([*[part.points for part in parts], places, *ends])
    low, high = points.min(axis=0), points.max(axis=0)
    device = _draw_device(model, low, high)
    ramp = Ramp.over([field for _, _, field in shown])
    drawn = [
        {
            "name": stage.name,
            "error": stage.error,
            "traces": [
                [
                    trace
                    for trace in draw_arrows(at, field, scale, "position", numbers[which], ramp)
                    # The axes cut lines, but not heads.
                    if scale <= MAX_ARROW_RATIO * best or trace["type"] != "mesh3d"
                ]
                for scale in scales
            ],
        }
        for stage, (which, at, field), best in zip(stages, shown, own, strict=True)
    ]
    glowing = [
        (one, found) for one in erring if (found := _find_lines(parts, one.owner, model.joints))
    ]
    robot = _trace_robot(parts, [part for _, found in glowing for part in found])
    bar = [ramp.bar("position")] if drawn else []
    return {
        "robot": [trace | {"showlegend": False} for trace in (*robot, *device, *bar)],
        "scales": scales,
        "stages": drawn,
        "layout": _layout(parts, low, high, device, glowing),
    }


def draw_poses(model: Model, measured: np.ndarray, predicted: np.ndarray) -> Spec | None:
    """Draw the robot at home with measured positions (N, 3), as they stand in the table, and the
    positions (M, 3) of the model at the same joint readings. None if the mechanism draws nothing.
    """
    parts = lines(model)
    if not parts:
        return None
    clouds = (("by the model", predicted, QUIET), ("measured", measured, MEASURED))
    points = 1e3 * np.vstack([*[part.points for part in parts], measured, predicted])
    traces = [
        trace_lines(kind, [p for p in parts if p.kind == kind])
        for kind in dict.fromkeys(p.kind for p in parts)
    ]
    shown = [trace | {"showlegend": False} for trace in traces]
    for name, places, colour in clouds:
        if len(places):
            coordinates = {a: np.round(1e3 * places[:, k], 3) for k, a in enumerate("xyz")}
            marker = {"size": 5 if name == "measured" else 3, "color": colour}
            shown.append(
                {"type": "scatter3d", "mode": "markers", "name": name, "marker": marker}
                | coordinates
            )
    layout = _layout(parts, points.min(axis=0), points.max(axis=0), (), ())
    legend = {"orientation": "h", "x": 0, "y": 1, "yanchor": "top"}
    return {"data": shown, "layout": layout | {"height": 300, "showlegend": True, "legend": legend}}


def _choose_samples(places: np.ndarray, stage: Stage) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The samples (indices) that a stage judges, their places and their errors."""
    which = np.flatnonzero(np.isfinite(stage.field).all(axis=1))
    return which, places[which], stage.field[which]


def _draw_device(model: Model, low: np.ndarray, high: np.ndarray) -> list[Spec]:
    """Draw where the device was registered; at the edge of the picture if it is far away."""
    if not any(sensor.name == SENSOR for sensor in model.sensors):
        return []
    at, middle = 1e3 * frames_of(model).f, (low + high) / 2
    away, half = at - middle, (high - low) / 2
    ratio = float(np.max(np.abs(away) / np.maximum(half, 1e-6)))
    words = "device"
    if ratio > DEVICE_NEAR:
        words = f"device, {np.linalg.norm(away) / 1e3:.2g} m away"
        at = middle + away / ratio
    trace = {
        "type": "scatter3d",
        "mode": "markers+text",
        "name": "device",
        **{axis: [round(float(v), 3)] for axis, v in zip("xyz", at, strict=True)},
        "text": [words],
        "textposition": "top center",
        "marker": {"symbol": "diamond", "size": 7, "color": QUIET},
        "hoverinfo": "text",
    }
    return [trace]


def _find_lines(parts: Sequence[DrawnLine], owner: str, joints: Sequence[str]) -> list[DrawnLine]:
    """Find the lines of an effect's owner: what a joint drives, or what its parameters describe."""
    if owner not in joints:
        return [part for part in parts if {n.partition(".")[0] for n in part.parameters} == {owner}]
    driven = [part for part in parts if part.kind == "driven"]
    driven = driven or [part for part in parts if part.kind == "rod"]
    k = list(joints).index(owner)
    if len(driven) == len(joints):
        return [driven[k]]
    number_of_joint = str(k + 1)
    return [
        part
        for part in driven
        if any(
            (match := NUMBERED.match(name.partition(".")[0])) and match[2] == number_of_joint
            for name in part.parameters
        )
    ]


def _layout(
    parts: list[DrawnLine],
    low: np.ndarray,
    high: np.ndarray,
    device: Sequence[Spec],
    glowing: Sequence[tuple[ErringPart, list[DrawnLine]]],
) -> Spec:
    """Make axes of equal scale around the robot, its errors, and the device; name the sizes of the
    parts that err."""
    for trace in device:
        at = np.array([trace[axis][0] for axis in "xyz"])
        low, high = np.minimum(low, at), np.maximum(high, at)
    margin = 0.04 * float((high - low).max())
    axes: Spec = {
        f"{axis}axis": {
            "title": {"text": name_axis(axis), "font": {"size": 11}},
            "range": [float(low[k] - margin), float(high[k] + margin)],
            "nticks": 5,
            "tickfont": {"size": 10},
        }
        for k, axis in enumerate("xyz")
    }
    camera = space("position")["scene"]["camera"]
    if flat(parts):
        axes["zaxis"]["visible"] = False
        camera = {"eye": {"x": 0, "y": 0, "z": 1.6}, "up": {"x": 0, "y": 1, "z": 0}}
    else:
        camera = camera | {"center": {"x": 0, "y": 0, "z": LOWER}}
    labels = [
        dict(zip("xyz", (1e3 * found[0].middle).round(3).tolist(), strict=True))
        | {"text": one.text, "showarrow": False, **LABEL}
        for one, found in glowing
    ]
    return {
        "showlegend": False,
        "margin": {"l": 0, "r": 0, "t": 0, "b": 0},
        # The camera stays while the slider is moved, and while steps are made.
        "scene": axes
        | {"aspectmode": "data", "camera": camera, "annotations": labels}
        | {"domain": {"x": [0, 1], "y": [0, SCENE_TOP]}}
        | {"uirevision": "machine"},
    }
