"""The form that says which column of a table is which joint or coordinate, and in which unit.

What the header states is folded. Only the fields of which something is doubtful are open.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

from nicegui import ui

from parallel_cal.base.units import ANGLES, LENGTHS, PIXEL

NONE = "none"
IN_HEADER = "as in the header"
QUATERNION, ANGLE_KIND, VECTOR = "quaternion x y z w", "three angles", "rotation vector"
# The names of the columns of an orientation.
ORIENTATIONS = {
    NONE: (),
    QUATERNION: ("qx", "qy", "qz", "qw"),
    ANGLE_KIND: ("first angle", "second angle", "third angle"),
    VECTOR: ("x of the vector", "y of the vector", "z of the vector"),
}
# The keys of a column map.
ORIENTATION_KEYS = {
    QUATERNION: "orientation",
    ANGLE_KIND: "angles",
    VECTOR: "rotation_vector",
}
AXES = {
    "xyz": "about fixed x, y, z",
    "zyx": "about fixed z, y, x",
    "XYZ": "about moving x, y, z",
    "ZYX": "about moving z, y, x",
    "ZXZ": "about moving z, x, z",
    "ZYZ": "about moving z, y, z",
}
UNITS = {"time": "s", "temperature": "degC", "payload": "kg"}
# The units in which people enter noise, and their factors to SI.
NOISE_UNITS = {"m": ("µm", 1e-6), "rad": ("mrad", 1e-3), "m or rad": ("m or rad", 1.0)}


class ColumnForm:
    """The form of a column map; `document` is the map as in a file."""

    def __init__(self, found: Mapping[str, Any]):
        """`found` is the preview of the table."""
        self._header, self._with_unit = found["header"], set(found["with_unit"])
        self._assumed_unit, self._about_touches = found["assumed_unit"], found["about_touches"]
        guessed: dict[str, str | None] = found["columns"]
        known = found["remembered"] is not None  # the last table had these columns
        self._doubtful = ui.column().classes("w-full gap-2")
        with ui.expansion().classes("w-full").props("dense id=understood") as self._folded:
            self._show_rows(found)
        self._show_common_units(found["joints"], guessed, known)
        self._joints = {
            name: self._pick_joint(name, unit, guessed[name], known)
            for name, unit in found["joints"].items()
        }
        place = [guessed[axis] for axis in "xyz"]
        turned = all(guessed[name] for name in ORIENTATIONS[QUATERNION])
        other = any(found["readings"].values()) or turned
        unclear = not self._are_clear(place) if any(place) else not other
        with self._row("position", unclear and not known):
            self._position = [self._pick(axis, guessed[axis]) for axis in "xyz"]
            self._position_unit = _pick_unit("unit of x, y, z", LENGTHS)
        with self._row("orientation", all(found["angles"]) and not (turned or known)):
            guesses = {QUATERNION: [guessed[name] for name in ORIENTATIONS[QUATERNION]]}
            guesses |= dict.fromkeys((ANGLE_KIND, VECTOR), found["angles"])
            kind = QUATERNION if turned else NONE
            self._orientation = _OrientationFields(self._pick, guesses, kind)
        given: dict[str, str | None] = found["conditions"]
        sides = [f"direction.{joint}" for joint in found["joints"]]
        with self._row("sides"):
            self._conditions = {name: self._pick(name, given.get(name)) for name in sides}
            for one in self._conditions.values():
                one.tooltip("1 if the reading of the joint rose before the stop, -1 if it fell")
        with self._row("conditions"):
            others = [name for name in given if name not in sides]
            self._conditions |= {
                name: self._pick(f"{name} [{UNITS[name]}]" if name in UNITS else name, given[name])
                for name in others
            }
            self._group = self._pick("number of the pose", None)
            self._name = self._pick("name of the sample", found["name"])
            self._in_order = ui.checkbox("rows in the order of the visits", value=True)
            self._in_order.tooltip(
                "Without columns of the sides, the sides from which the joints came then follow "
                "from the order of the rows."
            )
        with self._row("noise, 1 sigma"):
            moves = set(found["joints"].values())
            units = {"joint": moves.pop() if len(moves) == 1 else "m or rad"}
            units |= {"position": "m", "orientation": "rad"}
            self._noise = _NoiseFields(units)
        self._readings: dict[str, tuple[Any, Any]] = {}
        if found["readings"]:
            doubts = [c for c in found["readings"].values() if not self._are_clear([c])]
            with self._row("sensor readings", bool(doubts) and not known):
                for name, column in found["readings"].items():
                    unit = _pick_unit(f"unit of {name}", (*LENGTHS, *ANGLES, PIXEL))
                    self._readings[name] = self._pick(name, column), unit
        ui.label().classes("text-sm").props("id=unused").bind_text_from(self, "unused")
        self._folded.bind_text_from(self, "understood")
        if known:
            self._fill(found["remembered"])

    @property
    def understood(self) -> str:
        """How many of the columns the map names, in words."""
        names = [word for word in self._header if word]
        said = f"{len(names) - len(self._list_unused())} of {len(names)} columns understood"
        return f"{said}: see and change them"

    @property
    def unused(self) -> str:
        """The columns that the map does not name, in words."""
        left = self._list_unused()
        return f"not used: {', '.join(left)}" if left else ""

    def _list_unused(self) -> list[str]:
        chosen = [column for column, _, _ in self._joints.values()]
        chosen += [*self._position, *self._orientation.columns, *self._conditions.values()]
        chosen += [column for column, _ in self._readings.values()]
        used = {one.value for one in (*chosen, self._group, self._name)}
        return [word for word in self._header if word and word not in used]

    def _are_clear(self, columns: Sequence[str | None]) -> bool:
        """Whether all columns were found, and state their units."""
        return all(word in self._with_unit for word in columns)

    def find_problem(self) -> str:
        """Say what needs a column or a unit and has none, or which two quantities have the same
        column; empty if none. A position is complete, or not measured."""
        asked = {name: column for name, (column, _, _) in self._joints.items()}
        if any(one.value for one in self._position):
            asked |= dict(zip("xyz", self._position, strict=True))
        kind = self._orientation.kind
        each = zip(ORIENTATIONS[kind], self._orientation.columns, strict=True)
        asked |= {f"{kind} ({name})": column for name, column in each}
        if missing := [name for name, column in asked.items() if not column.value]:
            words = f"choose a column for {', '.join(missing)}"
            if set(missing) == set(self._joints) and all(one.value for one in self._position):
                words += f". {self._about_touches}"
            return words
        units = [(f"unit of {name}", one, unit) for name, (one, unit, _) in self._joints.items()]
        if not self._assumed_unit:
            units += [("unit of x, y, z", one, self._position_unit) for one in self._position]
        unitless = [
            label
            for label, column, unit in units
            if column.value and column.value not in self._with_unit and unit.value == IN_HEADER
        ]
        if unitless:
            return f"the header states no unit: choose {', '.join(dict.fromkeys(unitless))}"
        owners: dict[str, list[str]] = {}
        for name, column in asked.items():
            owners.setdefault(column.value, []).append(name)
        shared = {column: " and ".join(names) for column, names in owners.items() if names[1:]}
        return "; ".join(f"{column} is chosen for {names}" for column, names in shared.items())

    def document(self) -> dict[str, Any]:
        """Return the column map, which names only quantities that have a column."""
        found: dict[str, Any] = {
            "joints": {
                name: _without_empty(
                    {
                        "column": column.value,
                        "unit": _stated(unit.value),
                        "per_rev": (travel.value or "").strip() if travel else "",
                    }
                )
                for name, (column, unit, travel) in self._joints.items()
            }
        }
        if any(one.value for one in self._position):
            found["position"] = {"columns": [one.value for one in self._position]}
            found["position"] |= _without_empty({"unit": _stated(self._position_unit.value)})
        found |= self._orientation.document()
        readings = {
            name: {"column": column.value} | _without_empty({"unit": _stated(unit.value)})
            for name, (column, unit) in self._readings.items()
            if column.value
        }
        if readings:
            found["readings"] = readings
        found["conditions"] = {k: c.value for k, c in self._conditions.items() if c.value}
        if self._group.value:
            found["group"] = self._group.value
        if self._name.value:
            found["name"] = self._name.value
        found["visits"] = "in order" if self._in_order.value else "unordered"
        found["noise"] = self._noise.document()
        return found

    def _fill(self, document: Mapping[str, Any]) -> None:
        """Choose as for the last table: the inverse of `document`."""
        for name, (column, unit, travel) in self._joints.items():
            stated = document["joints"][name]
            column.value, unit.value = stated["column"], stated.get("unit", IN_HEADER)
            if travel:
                travel.value = stated.get("per_rev", "")
        position = document.get("position", {"columns": [None] * 3})
        _choose(self._position, position["columns"])
        self._position_unit.value = position.get("unit", IN_HEADER)
        self._orientation.fill(document)
        for name, (column, unit) in self._readings.items():
            stated = document.get("readings", {}).get(name, {})
            column.value, unit.value = stated.get("column"), stated.get("unit", IN_HEADER)
        for name, column in self._conditions.items():
            column.value = document["conditions"].get(name)
        self._group.value, self._name.value = document.get("group"), document.get("name")
        self._in_order.value = document["visits"] == "in order"
        self._noise.fill(document["noise"])

    def _show_rows(self, found: Mapping[str, Any]) -> None:
        ui.label(f"{found['count']} rows; the first ones:").classes("text-sm")
        columns = [
            {"name": str(k), "label": word, "field": str(k), "align": "left"}
            for k, word in enumerate(self._header)
        ]
        rows = [{str(k): cell for k, cell in enumerate(row)} for row in found["rows"]]
        shown = ui.table(columns=columns, rows=rows)
        shown.classes("w-full one-line-rows wide-table").props("dense flat tabindex=0 role=region")
        shown.props('aria-label="first rows of the table"')

    def _show_common_units(
        self, joints: Mapping[str, str], guessed: Mapping[str, str | None], known: bool
    ) -> None:
        """Let one choice be the unit of all joints that slide, and one of all that turn; a joint
        may have another one afterwards."""
        for si, kind in (("m", "slide"), ("rad", "turn")):
            names = [name for name, unit in joints.items() if unit == si]
            if len(names) < 2:
                continue
            which = "all joints" if len(names) == len(joints) else f"all joints that {kind}"
            clear = known or all(self._are_clear([guessed[name]]) for name in names)
            with self._row(which, not clear):
                fields = _pick_motion(which, f"travel per turn of {which}", si)
                for part, field in enumerate(fields, 1):
                    if field is not None:
                        field.on_value_change(partial(self._share, names, part))

    def _share(self, names: Sequence[str], part: int, event: Any) -> None:
        """Give joints the same unit (1) or travel per turn (2)."""
        for name in names:
            self._joints[name][part].value = event.value

    def _pick_joint(
        self, name: str, unit: str, guess: str | None, known: bool
    ) -> tuple[Any, Any, Any]:
        """Pick the column of a joint, its unit, and the travel per turn of a joint that slides."""
        with self._row(name, not (known or self._are_clear([guess]))):
            column = self._pick(f"column of {name}", guess)
            chosen, travel = _pick_motion(name, "travel per turn", unit)
        return column, chosen, travel

    def _row(self, title: str, is_doubtful: bool = False) -> Any:
        """Return a row behind a title, folded if it is not doubtful; what does not fit into a line
        continues under its start."""
        with (
            self._doubtful if is_doubtful else self._folded,
            ui.row().classes("items-center gap-x-3 w-full no-wrap"),
        ):
            ui.label(title).classes("w-28 shrink-0 text-sm font-bold")
            return ui.row().classes("items-center gap-x-3 gap-y-0 grow")

    def _pick(self, label: str, guess: str | None) -> Any:
        return ui.select(self._header, value=guess, label=label, clearable=True).classes("w-48")


class _OrientationFields:
    """The kind of the orientation, and the columns, axes and unit that a kind needs."""

    def __init__(
        self,
        pick: Callable[[str, str | None], Any],
        guesses: Mapping[str, Sequence[str | None]],
        kind: str,
    ):
        """`pick` makes the field of a column, with the guess of each kind."""
        self._kind = ui.select(list(ORIENTATIONS), value=kind, label="orientation").classes("w-48")
        self._columns = {
            kind: list(map(pick, ORIENTATIONS[kind], guess)) for kind, guess in guesses.items()
        }
        for kind, columns in self._columns.items():
            for column in columns:
                column.bind_visibility_from(self._kind, "value", value=kind)
        self._axes = ui.select(AXES, value="xyz", label="rotations").classes("w-48")
        self._unit = _pick_unit("unit of the angles", ANGLES)
        self._axes.bind_visibility_from(self._kind, "value", value=ANGLE_KIND)
        self._unit.bind_visibility_from(
            self._kind, "value", lambda kind: kind in (ANGLE_KIND, VECTOR)
        )

    @property
    def kind(self) -> str:
        return str(self._kind.value)

    @property
    def columns(self) -> list[Any]:
        """The fields of the chosen kind."""
        return self._columns.get(self.kind, [])

    def document(self) -> dict[str, Any]:
        """Return its part of the column map."""
        columns = [one.value for one in self.columns]
        if self.kind == NONE:
            return {}
        if self.kind == QUATERNION:
            return {ORIENTATION_KEYS[QUATERNION]: columns}
        axes = {"axes": self._axes.value} if self.kind == ANGLE_KIND else {}
        unit = _without_empty({"unit": _stated(self._unit.value)})
        return {ORIENTATION_KEYS[self.kind]: {"columns": columns, **axes, **unit}}

    def fill(self, document: Mapping[str, Any]) -> None:
        """Choose what a column map states."""
        self._kind.value = NONE
        for kind, key in ORIENTATION_KEYS.items():
            if key in document:
                stated = document[key]
                self._kind.value = kind
                _choose(self._columns[kind], stated if kind == QUATERNION else stated["columns"])
                if kind != QUATERNION:
                    self._unit.value = stated.get("unit", IN_HEADER)
                    self._axes.value = stated.get("axes", self._axes.value)


class _NoiseFields:
    """The standard deviations of joints, position and orientation, in the units of people."""

    def __init__(self, units: Mapping[str, str]):
        """`units` are the SI units of these."""
        self._entries = dict[str, tuple[Any, float]]()
        for name, si in units.items():
            unit, factor = NOISE_UNITS[si]
            entry = ui.number(f"{name} [{unit}]", min=0, format="%.3g").classes("w-40")
            self._entries[name] = (entry, factor)

    def document(self) -> dict[str, float]:
        """Return what is stated, in SI units."""
        stated = {k: (entry.value, factor) for k, (entry, factor) in self._entries.items()}
        # Twelve digits: 5 um are 5e-06 m, not 4.9999999999999996e-06.
        return {k: float(f"{v * factor:.12g}") for k, (v, factor) in stated.items() if v}

    def fill(self, sigmas: Mapping[str, float]) -> None:
        """Show these standard deviations (SI), nothing for others."""
        for name, (entry, factor) in self._entries.items():
            sigma = sigmas.get(name)
            entry.value = None if sigma is None else sigma / factor


def _pick_unit(label: str, units: Sequence[str] | Mapping[str, float]) -> Any:
    return ui.select([IN_HEADER, *units], value=IN_HEADER, label=label).classes("w-36")


def _pick_motion(which: str, travel_label: str, si: str) -> tuple[Any, Any]:
    """Pick the unit of what moves in m or rad, and, in m, the travel per turn (else None)."""
    unit = _pick_unit(f"unit of {which}", LENGTHS | ANGLES if si == "m" else ANGLES | LENGTHS)
    if si != "m":
        return unit, None
    travel = ui.input(travel_label, placeholder="71.2 mm").classes("w-36")
    travel.tooltip("only if the column contains the angle of a motor")
    return unit, travel


def _choose(fields: Sequence[Any], values: Sequence[str | None]) -> None:
    for field, value in zip(fields, values, strict=True):
        field.value = value


def _stated(unit: str) -> str:
    return "" if unit == IN_HEADER else unit


def _without_empty(values: Mapping[str, str]) -> dict[str, str]:
    return {key: value for key, value in values.items() if value}
