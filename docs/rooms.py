"""Draws docs/rooms.svg, the rooms and what they import: `python docs/rooms.py`.

The graph is that of test/project/test_architecture.py, the words are each room's own first line. An
arrow that follows from others is left out.
"""

from __future__ import annotations

import ast
import sys
from html import escape
from pathlib import Path

REPOSITORY = Path(__file__).parents[1]
sys.path.insert(0, str(REPOSITORY / "test" / "project"))
from test_architecture import PACKAGE, ROOMS, graph, room

PICTURE = REPOSITORY / "docs" / "rooms.svg"
HEIGHT, WIDTH, LEFT, BOX = 34, 790, 100, 116  # of a row, of all; where boxes begin, their width
STYLE = """
text { font: 14px sans-serif; fill: #24292f }
.name { font-weight: bold; text-anchor: middle }
rect { fill: #ddf4ff; stroke: #0969da }
path { fill: none; stroke: #57606a; stroke-width: 1.5 }
.head { fill: #57606a; stroke: none }
@media (prefers-color-scheme: dark) {
  text { fill: #e6edf3 }
  rect { fill: #0c2d4d; stroke: #4493f8 }
  path { stroke: #9198a1 }
  .head { fill: #9198a1 }
}"""


def imported() -> dict[str, set[str]]:
    """The other rooms that each room imports."""
    rooms: dict[str, set[str]] = {name: set() for name in ROOMS}
    for file, others in graph().items():
        if room(file) in rooms:
            rooms[room(file)] |= {room(other) for other in others} - {room(file)}
    return rooms


def without_implied(rooms: dict[str, set[str]]) -> list[tuple[str, str]]:
    """The arrows that do not follow from a way over other rooms."""
    reached: dict[str, set[str]] = {}
    for name in ROOMS:  # each imports only from those before it
        reached[name] = rooms[name].union(*(reached[other] for other in rooms[name]))
    return [
        (name, other)
        for name in ROOMS
        for other in sorted(rooms[name], key=ROOMS.index)
        if not any(other in reached[between] for between in rooms[name])
    ]


def words(name: str) -> str:
    """A room's first line."""
    text = (PACKAGE / name / "__init__.py").read_text(encoding="utf-8")
    return (ast.get_docstring(ast.parse(text)) or "").splitlines()[0].rstrip(".").replace("`", "")


def picture() -> str:
    """The rooms from what people see down to what everything stands on, as SVG."""
    top = {name: HEIGHT * i + 8 for i, name in enumerate(reversed(ROOMS))}
    parts = [_arrow(top[a] + HEIGHT / 2, top[b] + HEIGHT / 2) for a, b in arrows()]
    for name, y in top.items():
        parts += [
            f'<rect x="{LEFT}" y="{y + 4}" width="{BOX}" height="{HEIGHT - 8}" rx="5"/>',
            f'<text class="name" x="{LEFT + BOX / 2}" y="{y + HEIGHT / 2 + 5}">{name}</text>',
            f'<text x="{LEFT + BOX + 14}" y="{y + HEIGHT / 2 + 5}">{escape(words(name))}</text>',
        ]
    size = f'viewBox="0 0 {WIDTH} {HEIGHT * len(ROOMS) + 16}"'
    head = f'<svg xmlns="http://www.w3.org/2000/svg" {size}>\n<style>{STYLE}\n</style>\n'
    return head + "\n".join(parts) + "\n</svg>\n"


def arrows() -> list[tuple[str, str]]:
    return without_implied(imported())


def _arrow(start: float, end: float) -> str:
    """From one room down to another, the further the wider."""
    x, y = LEFT - 8, end - 4  # they leave a box below its middle, enter above
    wide = x - 18 - 0.27 * (end - start)
    return (
        f'<path d="M{LEFT} {start + 4} C{wide:.0f} {start + 4} {wide:.0f} {y} {x} {y}"/>'
        f'<path class="head" d="M{LEFT} {y} l-9 -4 v8 z"/>'
    )


if __name__ == "__main__":
    PICTURE.write_text(picture(), encoding="utf-8")
