"""The column map: the meaning and the unit of each column of a table."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, ValidationError, field_validator, model_validator

from parallel_cal.base.errors import ModelFileError, format_suggestion
from parallel_cal.base.files import read_foreign_text
from parallel_cal.base.units import LENGTHS, UNITS, Angle, Length
from parallel_cal.model.effect import CONDITIONS
from parallel_cal.model.file.schema import NoisePart, Part, sentence
from parallel_cal.model.file.yamltext import parse_yaml
from parallel_cal.recordings.channels import list_channels
from parallel_cal.recordings.robot_conventions import complete_map


def _factor_of_term(given: Any) -> Any:
    """A number in place of a term is its factor."""
    return {"factor": given} if isinstance(given, int | float) else given


class Term(Part):
    """A column that moves a joint: its cells times `factor`, and its unit.

    `factor` also converts encoder counts to revolutions. `per_rev` is the travel of the joint per
    turn of the motor (`71.2 mm`, negative if it moves backwards): the column then contains the
    motor's angle.
    """

    unit: Literal[Angle, Length] | None = None
    factor: float = 1.0
    per_rev: str | None = None

    @field_validator("factor")
    @classmethod
    def _check_factor(cls, factor: float) -> float:
        if factor == 0:
            raise ValueError("expected a number other than 0")
        return factor

    @field_validator("per_rev", "offset", mode="before", check_fields=False)
    @classmethod
    def _check_travel(cls, text: Any) -> Any:
        if text is not None:
            travel(str(text))
        return text

    @property
    def per_radian(self) -> float:
        """Travel of the joint (m or rad) per radian of its column; 1 without `per_rev`."""
        return 1.0 if self.per_rev is None else travel(self.per_rev) / (2 * math.pi)

    def joint_unit(self, unit: str) -> str:
        """Return the SI unit of the joint whose column has this unit."""
        return si_unit(self.per_rev.split()[1] if self.per_rev else unit)


class JointColumn(Term):
    """A joint's readings; the key is its name in the model file.

    `column` is the column of the joint. Instead of it, `columns` states a sum of columns, each
    with its factor: a controller may count a joint relative to another one, and both motors of a
    differential move both joints. `{J3: 1, J2: 1}` is short for `{columns: {J3: 1, J2: 1}}`.
    Without `unit`, the header states the unit. `offset` (`12.5 mm`) is the position of the joint
    where the column or the sum is zero.
    """

    column: str | None = None
    columns: dict[str, Annotated[Term, BeforeValidator(_factor_of_term)]] = Field(
        default_factory=dict
    )
    offset: str | None = None

    @model_validator(mode="before")
    @classmethod
    def _complete_short_form(cls, given: Any) -> Any:
        if isinstance(given, dict) and given and not given.keys() & cls.model_fields.keys():
            numbers = [isinstance(v, int | float) for v in given.values()]
            return {"columns": given} if all(numbers) else given
        return given

    @model_validator(mode="after")
    def _check_columns(self) -> JointColumn:
        if (self.column is None) == (not self.columns):
            raise ValueError(
                "expected either column, or columns with their factors: {column: J3}, or "
                "{columns: {J3: 1, J2: 1}}"
            )
        if self.columns and (self.factor != 1 or self.per_rev is not None):
            raise ValueError(
                "factor and per_rev are of one column: state them at each of the columns, as in "
                "{columns: {J3: {factor: 2, per_rev: 5 mm}, J2: 1}}"
            )
        return self

    @property
    def terms(self) -> dict[str, Term]:
        """The columns whose sum is the joint's reading, each with its unit."""
        if self.column is not None:
            return {self.column: self}
        return {
            name: term if term.unit else term.model_copy(update={"unit": self.unit})
            for name, term in self.columns.items()
        }


def si_unit(unit: str) -> str:
    """Return `m` for a unit of length and `rad` for a unit of angle."""
    return "m" if unit in LENGTHS else "rad"


def travel(text: str) -> float:
    """Parse `71.2 mm` or `3.6 deg` to m or rad; ValueError for anything else, and for zero."""
    number, _, unit = text.strip().partition(" ")
    try:
        value = float(number) * UNITS[unit.strip()]
    except (ValueError, KeyError):
        value = math.nan
    if not math.isfinite(value) or value == 0:
        raise ValueError(f"'{text}': expected a number and a unit, as in 71.2 mm or 3.6 deg")
    return value


class ReadingColumn(Part):
    """A sensor's readings; the key is the model file's channel. An empty cell is no reading."""

    column: str
    unit: Literal[Angle, Length, "px"] | None = None


class PositionColumns(Part):
    """x, y and z of {P} in {B}; null in place of a column means that it was not measured."""

    columns: Annotated[Sequence[str | None], Field(min_length=3, max_length=3)]
    unit: Length | None = None

    @field_validator("columns", mode="before")
    @classmethod
    def _check_columns(cls, columns: Any) -> Any:
        given = columns if isinstance(columns, list) else []
        if len(given) != 3 or not any(given):
            raise ValueError(
                "expected the columns of x, y and z. Write null for one that was not measured, as "
                "z of a robot that moves in the plane of x and y: [x, y, null]"
            )
        return columns

    @property
    def measured(self) -> list[bool]:
        """Whether x, y and z were measured."""
        return [name is not None for name in self.columns]

    @property
    def names(self) -> list[str]:
        """The columns of the coordinates that were measured."""
        return [name for name in self.columns if name is not None]


class AngleColumns(Part):
    """Three successive rotations, about fixed axes (`xyz`) or about moving ones (`XYZ`)."""

    columns: Annotated[list[str], Field(min_length=3, max_length=3)]
    axes: Annotated[str, Field(pattern="^([xyz]{3}|[XYZ]{3})$")] = "xyz"
    unit: Angle | None = None


class RotationVectorColumns(Part):
    """The axis of one rotation times its angle, as some controllers and devices state it."""

    columns: Annotated[list[str], Field(min_length=3, max_length=3)]
    unit: Angle | None = None


class Join(Part):
    """Rows of several tables that belong together.

    Their cells in the column `by` are equal, or, if `by` contains seconds, the nearest ones that
    differ by at most `within` seconds. `offset` is the time of the poses' clock minus that of the
    joints' clock, s; it is estimated from the motion if it is not stated. Without `unit`, times
    since 1970 tell it by their size, and others are in s.
    """

    by: str
    within: Annotated[float, Field(gt=0)] | None = None
    unit: Literal["s", "ms", "us", "ns"] | None = None
    offset: float | None = None


class Log(Part):
    """The rows are readings over time of a robot that moves, not one pose each.

    Each table has the column `time`. `unit` and `offset` are as in Join.
    """

    time: str
    unit: Literal["s", "ms", "us", "ns"] | None = None
    offset: float | None = None


class ColumnMap(Part):
    """The meaning of a table's columns; other columns are ignored.

    `orientation` is a quaternion x y z w; `angles`, `rotation_vector` and `matrix` (nine columns,
    row by row) are alternatives. `joints_only` states that nothing but redundant joints was read. A
    condition is a column,
    or a constant number. Rows of equal `group` are visits of one pose. The column `name` has a name
    of each row, such as the number of a shot. `visits` states whether the
    robot visited the poses in the order of the rows. `noise` is 1 sigma as the manufacturers state
    it (SI; for a motor's angle without `per_rev`, of this angle). `robot` is the maker of an arm,
    whose conventions complete the map.
    """

    joints: Annotated[dict[str, JointColumn], Field(min_length=1)]
    position: PositionColumns | None = None
    orientation: Annotated[list[str], Field(min_length=4, max_length=4)] | None = None
    angles: AngleColumns | None = None
    rotation_vector: RotationVectorColumns | None = None
    matrix: Annotated[list[str], Field(min_length=9, max_length=9)] | None = None
    readings: dict[str, ReadingColumn] = Field(default_factory=dict)
    joints_only: bool = False
    conditions: dict[str, str | float] = Field(default_factory=dict)
    group: str | None = None
    name: str | None = None
    visits: Literal["in order", "unordered"] = "in order"
    join: Join | None = None
    log: Log | None = None
    noise: NoisePart = NoisePart()
    robot: str | None = None

    @model_validator(mode="before")
    @classmethod
    def _complete_by_robot(cls, given: Any) -> Any:
        return complete_map(given)

    @property
    def joint_columns(self) -> list[str]:
        """The columns of the joints."""
        return [name for joint in self.joints.values() for name in joint.terms]

    @property
    def pose_columns(self) -> list[str]:
        """The columns of position and orientation."""
        names = self.position.names if self.position else []
        for turns in (self.angles, self.rotation_vector):
            names = names + (turns.columns if turns else [])
        return names + (self.orientation or []) + (self.matrix or [])

    @property
    def measured(self) -> list[bool]:
        """Whether x, y and z of the position and of the orientation (6) were measured."""
        position = self.position.measured if self.position else [False] * 3
        return position + [bool(self.orientations)] * 3

    @property
    def orientations(self) -> list[str]:
        """The keys that state the orientation: one at most is allowed."""
        return [key for key in ORIENTATIONS if getattr(self, key)]

    @property
    def columns(self) -> list[str]:
        """Every column that the map names."""
        names = self.number_columns + [reading.column for reading in self.readings.values()]
        return names + [one for one in (self.group, self.name) if one]

    @property
    def number_columns(self) -> list[str]:
        """The columns of joints, poses and conditions, which every sample needs."""
        conditions = [c for c in self.conditions.values() if isinstance(c, str)]
        return self.joint_columns + self.pose_columns + conditions


# The keys of a column map that have keys themselves; those of `joints` and `readings` have names
# first.
PARTS: dict[str, type[Part]] = {
    "joints": JointColumn,
    "position": PositionColumns,
    "angles": AngleColumns,
    "rotation_vector": RotationVectorColumns,
    "readings": ReadingColumn,
    "join": Join,
    "log": Log,
    "noise": NoisePart,
}
ORIENTATIONS = ("orientation", "angles", "rotation_vector", "matrix")


def read_column_map(path: Path, measured_elsewhere: bool = False) -> ColumnMap:
    """Read a column map; ModelFileError names line and key of an error.

    With `measured_elsewhere`, such as in images, the tables need not hold measurements.
    """
    try:
        document = parse_yaml(read_foreign_text(path), str(path))
    except UnicodeDecodeError:
        raise ModelFileError(f"{path}:1: not YAML: the file is not text") from None
    try:
        found = ColumnMap.model_validate(document.data)
    except ValidationError as error:
        first: Any = error.errors(include_url=False)[0]
        place = tuple(first["loc"])
        if first["type"] == "extra_forbidden":
            part = ColumnMap if len(place) == 1 else PARTS[place[0]]
            part = Term if place[0] == "joints" and len(place) > 3 else part
            known = list(part.model_fields)
            near = format_suggestion(str(place[-1]), known)
            text = f"unknown key{near}; expected one of {', '.join(known)}"
        else:
            text = sentence(first, place)
        raise document.error(place, text) from None
    if len(turned := found.orientations) > 1:
        raise document.error((turned[1],), f"{turned[0]} is given as well: remove one of the two")
    for key in ("position", *ORIENTATIONS):
        part = getattr(found, key)
        for name in getattr(part, "columns", part) or ():
            if name in found.joint_columns:
                raise document.error(
                    (key,), f"column {name} is that of a joint, too; expected one of its own"
                )
    measured = found.position or turned or found.readings
    if measured and found.joints_only:
        raise document.error(("joints_only",), "something else was measured, too: remove one")
    if not (measured or found.joints_only or measured_elsewhere):
        raise document.error(
            (),
            "neither position nor orientation nor readings: state what was measured. If redundant "
            "joints are all that was read, write 'joints_only: true'",
        )
    if found.log:
        for key, given in (("join", found.join), ("group", found.group), ("name", found.name)):
            if given is not None:
                raise document.error(
                    (key,), "log is given as well, which does not need it: remove one of the two"
                )
    for name in found.conditions:
        if name.split(".")[0] not in (*CONDITIONS, *list_channels("condition")):
            names = [f"{name}.JOINT" if given[2] else name for name, given in CONDITIONS.items()]
            expected = ", ".join(dict.fromkeys([*names, *list_channels("condition")]))
            raise document.error(
                ("conditions", name), f"unknown condition; expected one of {expected}"
            )
        in_log = found.log is not None and isinstance(found.conditions[name], str)
        if in_log and name not in list_channels("condition", among=[name]):
            raise document.error(
                ("conditions", name),
                "a log cannot state it in a column, because it follows from the motion: remove it",
            )
    return found
