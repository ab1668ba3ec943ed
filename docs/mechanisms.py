"""Draw docs/mechanisms/*.svg and write docs/mechanisms.md: `python docs/mechanisms.py`.

`Mechanism.drawing` draws each mechanism in its home configuration, with the names of parameters.
"""

from __future__ import annotations

import inspect
from html import escape
from pathlib import Path

import numpy as np

from parallel_cal.model.model import Model, new_model
from parallel_cal.model.shelf import list_plugins, load_mechanism
from parallel_cal.reporting.drawings import DrawnLine, flat, lines, select_labelled

DOCS = Path(__file__).parent
LINKS = ({"joint": "R", "axes": "parallel", "a": 0.3}, {"joint": "R", "a": 0.2})
MOTORS = (("left", 0.04, 0.25), ("right", -0.04, 0.2))  # side, place across and height, m
ANKLE = {  # a foot on a universal joint, moved by two motors with cranks and rods
    "base": "shank",
    "platform": "foot",
    "joints": [
        {
            "name": "ankle",
            "type": "universal",
            "parent": "shank",
            "child": "foot",
            "axes": [[0, 1, 0], [1, 0, 0]],
        },
        *(
            {
                "name": side,
                "type": "revolute",
                "parent": "shank",
                "child": f"{side}_crank",
                "origin": [0, y, z],
                "axis": [0, 1, 0],
                "driven": True,
            }
            for side, y, z in MOTORS
        ),
    ],
    "loops": [
        {
            "name": f"{side}_rod",
            "type": "distance",
            "a": {"body": f"{side}_crank", "point": [-0.05, 0, 0]},
            "b": {"body": "foot", "point": [-0.05, y, 0]},
        }
        for side, y, _ in MOTORS
    ],
}
# An arm of two links, and an ankle, for the pictures
OPTIONS = {"serial": {"links": LINKS}, "chain": ANKLE}
SHOWN = {
    "serial": " for the arm with two links in the drawing",
    "chain": " for the ankle with two rods in the drawing",
}
WIDTH, HEIGHT, EDGE = 460, 360, 46
AZIMUTH, ELEVATION = np.radians([-50.0, 18.0])
STYLE = """
text { font: 12px sans-serif; fill: #24292f; paint-order: stroke; stroke: #fff; stroke-width: 3px }
polyline { fill: none; stroke-linecap: round; stroke-linejoin: round }
.base { stroke: #8a94a3; stroke-width: 2 } .axis { stroke: #8a94a3; stroke-dasharray: 5 3 }
.driven { stroke: #0072b2; stroke-width: 4 } .rod { stroke: #009e73; stroke-width: 2.5 }
.platform { stroke: #cc79a7; stroke-width: 3.5 }
@media (prefers-color-scheme: dark) { text { fill: #e6edf3; stroke: #0d1117 } }"""
HEAD = """# Mechanisms

A mechanism is the idealised robot of a model: its joints, its geometric parameters and its
equations. `parallel-cal new NAME` writes a model file for a mechanism of this page.
`parallel-cal mechanisms NAME` lists all its parameters with their tolerances.

Each drawing shows the mechanism in its home configuration, computed from the equations. The labels
are names of parameters. If chains are alike, each name is shown once. {B} is the base frame.
`make gallery` writes this page.

Some mechanisms state their equations. In these, r and R are the position and the rotation matrix of
the platform frame {P} in {B}, and q is the reading of the joint. Rx, Ry and Rz turn about x, y and
z by the right-hand rule. Other symbols are parameters of the chain or leg, without its name: `da`
stands for `chain1.da`, `chain2.da` and `chain3.da`.

| colour | part |
|---|---|
| blue | links that a motor moves |
| green | passive links |
| rose | platform |
| grey | base and axes |
"""


def view(parts: list[DrawnLine]) -> np.ndarray:
    """Rows (2, 3) that turn {B} into the picture's right and up."""
    if flat(parts):
        return np.eye(3)[:2]
    (s, c), (se, ce) = ((np.sin(a), np.cos(a)) for a in (AZIMUTH, ELEVATION))
    return np.array([[-s, c, 0.0], [-c * se, -s * se, ce]])


def picture(model: Model) -> str:
    """A model's geometry at home, as SVG."""
    parts = lines(model)
    turn = view(parts)
    places = np.vstack([part.points for part in parts]) @ turn.T
    low, span = places.min(axis=0), np.ptp(places, axis=0)
    scale = min((WIDTH - 2 * EDGE) / max(span[0], 1e-9), (HEIGHT - 2 * EDGE) / max(span[1], 1e-9))
    corner = (np.array([WIDTH, HEIGHT]) - scale * span) / 2

    def on_paper(points: np.ndarray) -> np.ndarray:
        x, y = (corner + scale * (points @ turn.T - low)).T
        return np.column_stack([x, HEIGHT - y])

    drawn = [
        f'<polyline class="{part.kind}" points="'
        + " ".join(f"{x:.1f},{y:.1f}" for x, y in on_paper(part.points))
        + '"/>'
        for part in parts
    ]
    taken: list[tuple[float, float]] = []
    for part in select_labelled(parts):
        x, y = on_paper(part.middle[None])[0]
        half = 3.1 * len(part.label)
        x = float(np.clip(x, half + 4, WIDTH - half - 4))
        while any(abs(y - other) < 14 for _, other in taken):
            y += 2.0
        taken.append((x, y))
        drawn.append(
            f'<text x="{x:.0f}" y="{y:.0f}" text-anchor="middle">{escape(part.label)}</text>'
        )
    head = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}">'
    return f"{head}\n<style>{STYLE}\n</style>\n" + "\n".join(drawn) + "\n</svg>\n"


def page() -> str:
    """Return the page: docstring, number of parameters and drawing of each mechanism."""
    parts = [HEAD]
    for name in list_plugins("mechanisms"):
        mechanism = load_mechanism(name, **OPTIONS.get(name, {}))
        count = f"{len(mechanism.parameters)} parameters{SHOWN.get(name, '')}."
        words = f"{inspect.getdoc(type(mechanism))}\n\n{count}"
        parts.append(f"## {name}\n\n{words}\n\n![{name}](mechanisms/{name}.svg)\n")
    return "\n".join(parts)


def main() -> None:
    (DOCS / "mechanisms").mkdir(exist_ok=True)
    for name in list_plugins("mechanisms"):
        model = new_model(load_mechanism(name, **OPTIONS.get(name, {})))
        (DOCS / "mechanisms" / f"{name}.svg").write_text(picture(model), encoding="utf-8")
    (DOCS / "mechanisms.md").write_text(page(), encoding="utf-8")


if __name__ == "__main__":
    main()
