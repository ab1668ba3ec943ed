"""The base class of effects: from what was measured to what the ideal mechanism sees."""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from math import isfinite, nan
from typing import Any, ClassVar

from parallel_cal.base.errors import ModelError, wrap_plugin_error
from parallel_cal.base.options import split_options
from parallel_cal.model.mechanism import Mechanism
from parallel_cal.model.parameters import Named, Parameter, ParameterTable

# Conditions of a sample: unit, neutral value, whether each joint has one.
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
    """The inputs of the closure: joints q, position r, rotation R and geometry p."""

    q: Any
    r: Any
    R: Any
    p: Named

    def with_q(self, q: Any) -> Seen:
        return replace(self, q=q)

    def with_pose(self, r: Any, R: Any) -> Seen:
        return replace(self, r=r, R=R)

    def with_p(self, changes: Mapping[str, Any]) -> Seen:
        """Return a copy with some geometric parameters changed."""
        return replace(self, p=self.p.replaced(changes))


class Effect(ABC):
    """Base class of a physical effect.

    Subclass it in a file of its own; the file name is the effect's name. Implement `parameters`
    and `ideal`.

    Attributes
    ----------
    needs : tuple of str
        Conditions that it needs, of `CONDITIONS`. Default none.
    reads : tuple of str
        Patterns of the sensor channels on which it acts. Default none.
    fixed : tuple of str
        Patterns of its parameters that are given, not identified. Default none.
    of_device : bool
        Whether it is an error of the measuring device, which a robot's controller must not correct.
        Default False.
    widens : bool
        Whether adding it replaces the mechanism by the next larger model. Default False.
    refines : bool
        Whether values between two settings of a scan exist. Default True.
    physics : str
        The cause, in one sentence.
    remedy : str
        What to do about it at the machine.
    source : str
        Typical sizes, and where they come from.
    lookalikes : tuple of str
        Effects whose residuals are similar. Default none.
    separated_by : str
        Measurements that distinguish it from its lookalikes.
    family : str
        In words, the group of effects that data rarely distinguish. Default empty.
    told_from : dict of str
        By lookalike, a measurement that distinguishes it better than `separated_by`. Default empty.
    """

    needs: ClassVar[tuple[str, ...]] = ()
    reads: ClassVar[tuple[str, ...]] = ()  # patterns of the sensor channels on which it acts
    fixed: ClassVar[tuple[str, ...]] = ()  # patterns of its parameters that are known
    of_device: ClassVar[bool] = False  # an error of the device, which a controller must not correct
    widens: ClassVar[bool] = False  # adding it replaces the mechanism by the next larger model
    refines: ClassVar[bool] = True  # values between two settings of a scan exist
    physics: ClassVar[str]
    remedy: ClassVar[str] = ""  # action at the machine
    source: ClassVar[str]
    lookalikes: ClassVar[tuple[str, ...]] = ()
    separated_by: ClassVar[str] = ""
    family: ClassVar[str] = ""  # group of effects that data rarely distinguish
    told_from: ClassVar[Mapping[str, str]] = {}  # by lookalike: a better measurement

    @abstractmethod
    def parameters(self, mechanism: Mechanism) -> list[Parameter]:
        """Return its parameters under short names (`joint2.sin`); 0 means no effect."""

    @abstractmethod
    def ideal(self, seen: Seen, e: Named, at: Named, mechanism: Mechanism) -> Seen:
        """Return what the ideal mechanism sees.

        Parameters
        ----------
        seen : Seen
            What was measured, after the effects before this one.
        e : Named
            The effect's parameters.
        at : Named
            The conditions of the sample.
        mechanism : Mechanism
        """

    def at_sensor(self, r: Any, R: Any, s: Named, e: Named) -> tuple[Any, Any]:
        """Return the pose of {P} in {B} at which an ideal sensor would show what this sensor shows.

        It is called for the channels in `reads` only. `s` are the sensor's parameters, `e` its own.
        """
        return r, R

    def acts_on(self, channel: str) -> bool:
        """Return whether it changes the reading of a sensor's channel."""
        return any(fnmatchcase(channel, pattern) for pattern in self.reads)

    def applies(self, mechanism: Mechanism) -> str:
        """Return why the effect does not apply to a mechanism; empty if it applies."""
        return ""

    def scan(
        self, mechanism: Mechanism, recorded: Mapping[str, Any]
    ) -> Iterable[Mapping[str, float]]:
        """Return settings of its fixed parameters that a search tries if they are unknown.

        `recorded` are the samples' conditions and joint readings by name, (N,) each.
        """
        return ({},)

    def multiples(self, setting: Mapping[str, float]) -> Iterable[Mapping[str, float]]:
        """Return settings that give equal residuals to the best setting of the scan.

        One of them is preferred if it fits as well: a wave's own frequency, not half of it.
        """
        return ()

    def period(self, setting: Mapping[str, float]) -> float | None:
        """Return the period of its pattern in a joint's reading (rad or m); None if it has none."""
        return None

    def absurd(self, e: Named, mechanism: Mechanism) -> str:
        """Return why its values contradict each other; empty if they do not."""
        return ""

    @property
    def name(self) -> str:
        return type(self).__module__.removeprefix("parallel_cal.effects.")

    def fixed_patterns(self) -> list[str]:
        """Return the patterns of its fixed parameters under their full names."""
        return [f"{self.name}.{pattern}" for pattern in self.fixed]

    def table(self, mechanism: Mechanism) -> ParameterTable:
        """Return its parameters under their full names (`encoder_eccentricity.joint2.sin`)."""
        try:
            own = self.parameters(mechanism)
        except Exception as error:
            raise wrap_plugin_error(self.name, error) from error
        each = zip(mechanism.joints, mechanism.joint_gearing, strict=False)
        gears = {joint: gear for joint, gear in each if gear != 1.0}
        table = []
        for p in own:
            scaled, joint = p, p.name.partition(".")[0]
            if joint in gears and p.unit == mechanism.joint_units[mechanism.joints.index(joint)]:
                # The reading is taken before the gear, so its errors are larger by the gear ratio.
                scaled = p.with_tolerance(gears[joint] * p.tolerance)
            table.append(replace(scaled, name=f"{self.name}.{p.name}", group="effect"))
        return ParameterTable(table)

    def conditions(self, mechanism: Mechanism) -> list[str]:
        """Return the condition columns that it needs: `direction` becomes one for each joint."""
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


def parse_effects(text: str) -> list[tuple[str, dict[str, float]]]:
    """Parse one or several effects, joined by `+`."""
    return [parse_effect(part) for part in re.split(r"\+(?=[A-Za-z_])", text)]  # not at 1e+3


def parse_effect(text: str) -> tuple[str, dict[str, float]]:
    """Parse `NAME[:key=value,...]` into name and parameters; ModelError for other text."""
    name, given = split_options(text, "effect", ModelError)
    numbers: dict[str, float] = {}
    for key, value in given.items():
        try:
            numbers[key] = float(value)
        except ValueError:
            numbers[key] = nan
        if not isfinite(numbers[key]):
            raise ModelError(f"effect '{text}': {key} is '{value}', expected a number")
    return name, numbers
