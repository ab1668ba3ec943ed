"""What a sensor is: what it shows at a pose, with unknown numbers of its own."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields, replace
from typing import Any, ClassVar, cast

import casadi as ca

from parallel_cal.model.mechanism import Mechanism
from parallel_cal.model.parameters import Named, Parameter, ParameterTable


class Sensor(ABC):
    """One measuring set-up (chapter 4); subclass it in a file of its own, whose name is its name.

    A file is a frozen dataclass whose fields describe the set-up (nominal geometry, uncertainty).
    It adds rows `readings(pose) - what was read` to the closure, and its numbers to the model's.
    A channel that was not read in a sample is an unknown there, and projected out like one.
    """

    physics: ClassVar[str]
    source: ClassVar[str]
    fixed: tuple[str, ...] = ()  # patterns of its own parameters that are known
    # Standard deviation of one reading (m). None: nobody stated it, so `guessed_sigma` weighs the
    # readings, and a fit scales it by its residuals before anything is judged by it.
    sigma: float | None = 0.0
    guessed_sigma: ClassVar[float] = 20e-6

    @abstractmethod
    def parameters(self, mechanism: Mechanism) -> list[Parameter]:
        """Its numbers, named without the sensor's own name (`hole1.x`)."""

    @property
    def channels(self) -> tuple[str, ...]:
        """What it reads, one row each: the names in the recorded `constraint` topic."""
        return ()

    def readings(self, r: Any, R: Any, s: Named) -> Any:
        """What every channel shows at the pose (r, R) of {P} in {B}: a column, m."""
        return ca.SX(0, 1)

    def pose(self, r: Any, R: Any, s: Named) -> tuple[Any, Any]:
        """The pose of {P} in {B} where the pose device shows (r, R)."""
        return r, R

    def shown(self, r: Any, R: Any, s: Named) -> tuple[Any, Any]:
        """What the pose device shows where {P} is at (r, R) in {B}: the inverse of `pose`."""
        return r, R

    def tolerances(self, table: ParameterTable, mechanism: Mechanism) -> Mapping[str, float]:
        """Tolerances of effects' numbers by full name, where the catalogue knows less."""
        return {}

    @property
    def weighing_sigma(self) -> float:
        """The standard deviation (m) that its readings are weighed by, stated or guessed."""
        return self.guessed_sigma if self.sigma is None else self.sigma

    @property
    def name(self) -> str:
        return type(self).__module__.removeprefix("parallel_cal.sensors.")

    @property
    def options(self) -> dict[str, Any]:
        """The fields that describe this set-up, without those at their defaults."""
        own = [(f.name, getattr(self, f.name), f.default) for f in fields(cast(Any, self))]
        return {name: value for name, value, default in own if value != default}

    def table(self, mechanism: Mechanism) -> ParameterTable:
        """Its parameters under their full names (`plane_spheres.hole1.x`)."""
        return ParameterTable(
            replace(p, name=f"{self.name}.{p.name}", group="sensor")
            for p in self.parameters(mechanism)
        )

    def fixed_patterns(self) -> list[str]:
        """Patterns of its fixed parameters under their full names."""
        return [f"{self.name}.{pattern}" for pattern in self.fixed]


def apply_sensor_tolerances(
    sensors: Iterable[Sensor], table: ParameterTable, mechanism: Mechanism
) -> ParameterTable:
    """An effect's table with the tolerances that sensors know better."""
    for sensor in sensors:
        table = table.with_tolerances(sensor.tolerances(table, mechanism))
    return table


def point_on_platform(r: Any, R: Any, s: Named, name: str = "tip") -> Any:
    """Where a point of the platform, given in {P} by three parameters, is in {B}."""
    return r + R @ s.vector(*[f"{name}.{axis}" for axis in "xyz"])


def point_parameters(
    name: str, point: Sequence[float], tolerance: float, axes: str = "xyz"
) -> list[Parameter]:
    """Coordinates of a point (m)."""
    pairs = zip(axes, point, strict=True)
    return [Parameter(f"{name}.{axis}", "m", float(v), tolerance) for axis, v in pairs]
