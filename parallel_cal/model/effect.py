"""What an effect is: given what was measured, what does the ideal mechanism see?"""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from math import isfinite
from typing import Any, ClassVar

from parallel_cal.base.errors import ModelError, wrap_plugin_error
from parallel_cal.model.mechanism import Mechanism
from parallel_cal.model.parameters import Named, Parameter, ParameterTable

# Conditions of a sample: unit, the value that means "nothing special", one a joint or not.
CONDITIONS: dict[str, tuple[str, float, bool]] = {
    "time": ("s", 0.0, False),
    "temperature": ("degC", 20.0, False),
    "payload": ("kg", 0.0, False),
    "direction": ("1", 0.0, True),
    "velocity": ("rad/s", 0.0, True),
    "travel": ("rad", 0.0, True),
    "session": ("1", 0.0, False),
}


@dataclass(frozen=True)
class Seen:
    """What the closure is given: joints q, position r, rotation R, geometry p."""

    q: Any
    r: Any
    R: Any
    p: Named

    def with_q(self, q: Any) -> Seen:
        return replace(self, q=q)

    def with_pose(self, r: Any, R: Any) -> Seen:
        return replace(self, r=r, R=R)

    def with_p(self, changes: Mapping[str, Any]) -> Seen:
        """The same, some of the geometric parameters changed."""
        return replace(self, p=self.p.replaced(changes))


class Effect(ABC):
    """One physical effect; subclass it in a file of its own, whose name is its name."""

    needs: ClassVar[tuple[str, ...]] = ()
    reads: ClassVar[tuple[str, ...]] = ()  # patterns of sensors' channels that it acts on
    fixed: ClassVar[tuple[str, ...]] = ()  # patterns of its numbers that are given, not identified
    of_device: ClassVar[bool] = False  # an error of the measurement, which the robot must not learn
    widens: ClassVar[bool] = False  # what it adds is the mechanism's next larger model
    refines: ClassVar[bool] = True  # between two settings of a scan there are others
    physics: ClassVar[str]
    remedy: ClassVar[str] = ""  # what to do about it at the machine
    source: ClassVar[str]
    lookalikes: ClassVar[tuple[str, ...]] = ()
    separated_by: ClassVar[str] = ""
    family: ClassVar[str] = ""  # in words, what it and others are that data seldom tell apart
    told_from: ClassVar[Mapping[str, str]] = {}  # by lookalike, where another measurement tells it

    @abstractmethod
    def parameters(self, mechanism: Mechanism) -> list[Parameter]:
        """Its numbers, named without the effect's own name (`joint2.sin`); 0 = no effect."""

    @abstractmethod
    def ideal(self, seen: Seen, e: Named, at: Named, mechanism: Mechanism) -> Seen:
        """What the ideal mechanism sees; `e` its numbers, `at` the sample's conditions."""

    def at_sensor(self, r: Any, R: Any, s: Named, e: Named) -> tuple[Any, Any]:
        """The pose of {P} in {B} at which an ideal sensor would show what this one shows.

        `s` are the sensor's numbers, `e` its own; of the channels in `reads` only.
        """
        return r, R

    def acts_on(self, channel: str) -> bool:
        """Whether it changes what a channel of a sensor reads."""
        return any(fnmatchcase(channel, pattern) for pattern in self.reads)

    def applies(self, mechanism: Mechanism) -> str:
        """Return why the effect does not apply to a mechanism; empty if it applies."""
        return ""

    def scan(
        self, mechanism: Mechanism, recorded: Mapping[str, Any]
    ) -> Iterable[Mapping[str, float]]:
        """Settings of its fixed numbers that a search tries where nobody knows them.

        `recorded` are the samples' conditions and joint readings by name, (N,) each.
        """
        return ({},)

    def multiples(self, setting: Mapping[str, float]) -> Iterable[Mapping[str, float]]:
        """Settings that show the same as the best one of the scan, and are meant where they fit
        as well: a wave's own frequency, not a half of it."""
        return ()

    def period(self, setting: Mapping[str, float]) -> float | None:
        """After how much of a joint's reading (rad or m) its pattern comes round, where it does."""
        return None

    def absurd(self, e: Named, mechanism: Mechanism) -> str:
        """Why its numbers cannot be together, though each of them may; empty where they can."""
        return ""

    @property
    def name(self) -> str:
        return type(self).__module__.removeprefix("parallel_cal.effects.")

    def fixed_patterns(self) -> list[str]:
        """Patterns of its fixed numbers under their full names."""
        return [f"{self.name}.{pattern}" for pattern in self.fixed]

    def table(self, mechanism: Mechanism) -> ParameterTable:
        """Its parameters under their full names (`encoder_eccentricity.joint2.sin`)."""
        try:
            own = self.parameters(mechanism)
        except Exception as error:
            raise wrap_plugin_error(self.name, error) from error
        each = zip(mechanism.joints, mechanism.joint_gearing, strict=False)
        gears = {joint: gear for joint, gear in each if gear != 1.0}
        return ParameterTable(
            replace(
                _scale_by_gear(p, gears, mechanism), name=f"{self.name}.{p.name}", group="effect"
            )
            for p in own
        )

    def conditions(self, mechanism: Mechanism) -> list[str]:
        """The condition columns it needs: `direction` becomes one a joint."""
        columns: list[str] = []
        for need in self.needs:
            if need not in CONDITIONS:
                known = ", ".join(CONDITIONS)
                raise ModelError(
                    f"{self.name} needs the condition '{need}', which is unknown; known "
                    f"conditions: {known}"
                )
            per_joint = CONDITIONS[need][2]
            columns += [f"{need}.{j}" for j in mechanism.joints] if per_joint else [need]
        return columns


def _scale_by_gear(p: Parameter, gears: Mapping[str, float], mechanism: Mechanism) -> Parameter:
    """What a joint may err by, as its reading shows it that is taken before the gear."""
    joint = p.name.partition(".")[0]
    gear = gears.get(joint, 1.0)
    if gear == 1.0 or p.unit != mechanism.joint_units[mechanism.joints.index(joint)]:
        return p
    return p.with_tolerance(gears[joint] * p.tolerance)


def parse_effects(text: str) -> list[tuple[str, dict[str, float]]]:
    """One effect or several, joined by `+`."""
    return [parse_effect(part) for part in re.split(r"\+(?=[A-Za-z_])", text)]  # none is 1e+3


def parse_effect(text: str) -> tuple[str, dict[str, float]]:
    """`NAME[:param=value,...]` -> name and its numbers; ModelError where it is not that."""
    name, _, numbers = text.partition(":")
    given: dict[str, float] = {}
    for item in filter(None, numbers.split(",")):
        key, equals, value = item.partition("=")
        try:
            given[key.strip()] = float(value)
        except ValueError:
            equals = ""
        if not (equals and key.strip() and isfinite(given[key.strip()])):
            raise ModelError(f"effect '{text}': expected NAME:param=value,..., found '{item}'")
    return name.strip(), given
