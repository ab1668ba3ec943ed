"""The base class of effects, which convert measured quantities to those of the ideal mechanism."""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from math import isfinite, nan
from typing import Any, ClassVar

from parallel_cal.base.errors import ModelError, wrap_plugin_error
from parallel_cal.base.options import split_options
from parallel_cal.model.mechanism import SCALES, Mechanism
from parallel_cal.model.parameters import Named, Parameter, ParameterTable

# Conditions of a sample: unit, neutral value, whether each joint has one.
CONDITIONS: dict[str, tuple[str, float, bool]] = {
    "time": ("s", 0.0, False),
    "temperature": ("degC", 20.0, False),
    "payload": ("kg", 0.0, False),
    "direction": ("1", 0.0, True),
    "velocity": ("rad/s", 0.0, True),
    "acceleration": ("rad/s^2", 0.0, True),
    "travel": ("rad", 0.0, True),
    "session": ("1", 0.0, False),
}
# `temperature.arms`: the temperature of a part. `temperature.lag540`, `temperature.arms.lag540`:
# what follows the one or the other with a time constant of 540 s.
PART = re.compile(r"(temperature)\.(?!lag\d+$)([A-Za-z]\w*)")
LAGGED = re.compile(r"(temperature(?:\.(?!lag\d)[A-Za-z]\w*)?)\.lag(\d+)")


def parse_lag(condition: str) -> tuple[str, float] | None:
    """Return the condition that a lagged one follows, and its time constant (s); None for a
    condition that is not lagged."""
    match = LAGGED.fullmatch(condition)
    return (match[1], float(match[2])) if match and int(match[2]) else None


def parse_part(condition: str) -> tuple[str, str] | None:
    """Return the condition that a part has of its own, and the part; None for other conditions."""
    match = PART.fullmatch(condition)
    return (match[1], match[2]) if match else None


def list_substitutes(condition: str) -> list[str]:
    """Return what takes the place of a condition that is not known, the nearest first: what a
    lagged one follows, and then the general condition in place of that of a part. The scales of
    legs are as warm as the legs, and those of rails as the base if only that is known."""
    found = []
    if lag := parse_lag(condition):
        condition = lag[0]
        found.append(condition)
    if part := parse_part(condition):
        on_scales = part[1] == SCALES
        found += [f"{part[0]}.legs", part[0], f"{part[0]}.base"] if on_scales else [part[0]]
    return found


def _none() -> Any:
    import casadi as ca

    return ca.SX(0, 1)


@dataclass(frozen=True)
class Seen:
    """The inputs of the closure: joints q, position r, rotation R, geometry p, and the passive
    coordinates u of a mechanism that declares some."""

    q: Any
    r: Any
    R: Any
    p: Named
    u: Any = field(default_factory=_none)

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
        Names of the conditions (keys of `CONDITIONS`) on which it depends. `temperature.lag540` is
        the temperature delayed with a time constant of 540 s, `temperature.arms` is the temperature
        of the part `arms`. Default none.
    reads : tuple of str
        Name patterns of the sensor channels on which it acts. Default none.
    fixed : tuple of str
        Name patterns of its parameters that are known constants. A fit does not identify them.
        Default none.
    each : str
        Name of a known constant of which each joint may have its own, the parameter `joint.NAME`:
        0 where a joint has the common one. A diagnosis looks for joints that differ. Default none.
    alone : tuple of str
        Name patterns of parameters that may be there without the others, whatever its known
        constants are. A diagnosis weighs these alone, too. Default none.
    alike : tuple of str
        Name patterns, such as `*.lag`, of properties that equal parts nearly share. A diagnosis
        weighs parts that are alike, too. Default none.
    added_later : tuple of str
        Name patterns of parameters that model files of earlier releases lack. They have their
        nominal values there, and are fixed if all others of the effect are. Default none.
    of_device : bool
        Whether it is an error of the measuring device, which a robot's controller must not correct.
        Default False.
    depends_on_class : bool
        Whether its usual size depends on the class of the machine (precision, industrial, hobby).
        False for a property of a material. Default True.
    widens : bool
        Whether adding it replaces the mechanism by one with more geometric parameters.
        Default False.
    refines : bool
        Whether a diagnosis refines the best of the values that the method `scan` tries: one
        parameter after the other, between its neighbours in the scan. True for continuous
        parameters (the ratio of a gear), False for an integer (the order of a harmonic), or if
        finer steps change little. Default True.
    title : str
        What messages and tables call it, if its name means nothing to a user. Default: its name.
    mistaken : float
        How many times its usual size it has if a person entered a wrong number, such as the lead
        of another screw. A diagnosis weighs this size, too.
    found_in_data : bool
        Whether its formula was found in data, so that its cause is not known. Default False.
    physics : str
        The cause, in one sentence.
    remedy : str
        What to do about it at the machine.
    source : str
        Typical sizes, and where they come from.
    lookalikes : tuple of str
        Names of effects whose residuals are similar. Default none.
    separated_by : str
        Measurements that distinguish it from its lookalikes.
    family : str
        Name, in words, of a group of effects that data rarely distinguish. Default empty.
    generalizes : tuple of str
        Names of effects that are special cases of it. A diagnosis considers it only if it explains
        significantly more than each of them. Default none.
    told_from : dict of str
        Maps the name of a lookalike to a measurement that distinguishes this effect from it better
        than `separated_by` does. Default empty.
    """

    needs: ClassVar[tuple[str, ...]] = ()
    reads: ClassVar[tuple[str, ...]] = ()
    fixed: ClassVar[tuple[str, ...]] = ()
    each: ClassVar[str] = ""
    alone: ClassVar[tuple[str, ...]] = ()
    alike: ClassVar[tuple[str, ...]] = ()
    added_later: ClassVar[tuple[str, ...]] = ()
    of_device: ClassVar[bool] = False
    depends_on_class: ClassVar[bool] = True
    widens: ClassVar[bool] = False
    refines: ClassVar[bool] = True
    title: ClassVar[str] = ""
    found_in_data: ClassVar[bool] = False
    mistaken: ClassVar[float] = 1.0
    physics: ClassVar[str]
    remedy: ClassVar[str] = ""
    source: ClassVar[str]
    lookalikes: ClassVar[tuple[str, ...]] = ()
    separated_by: ClassVar[str] = ""
    family: ClassVar[str] = ""
    generalizes: ClassVar[tuple[str, ...]] = ()
    told_from: ClassVar[Mapping[str, str]] = {}

    @abstractmethod
    def parameters(self, mechanism: Mechanism) -> list[Parameter]:
        """Return its parameters under short names (`joint2.sin`); 0 means no effect."""

    @abstractmethod
    def ideal(self, seen: Seen, e: Named, at: Named, mechanism: Mechanism) -> Seen:
        """Convert measured quantities to those of the ideal mechanism, which has no such effect.

        CONVENTIONS, section "The closure and the effects", has the equation of each effect.

        Parameters
        ----------
        seen : Seen
            Measured joint readings and pose, with the geometric parameters. The effects that stand
            before this one in the model have corrected them already.
        e : Named
            The effect's parameters.
        at : Named
            The conditions of the sample.
        mechanism : Mechanism

        Returns
        -------
        Seen
        """

    def at_sensor(self, r: Any, R: Any, s: Named, e: Named) -> tuple[Any, Any]:
        """Return the pose at which an ideal sensor has the same reading as the real one.

        It is called only for the channels that `reads` matches.

        Parameters
        ----------
        r, R : CasADi (3, 1), (3, 3)
            Position (m) and rotation of {P} in {B}.
        s : Named
            The parameters of the sensor.
        e : Named
            The parameters of the effect.

        Returns
        -------
        r, R : CasADi (3, 1), (3, 3)
        """
        return r, R

    def acts_on(self, channel: str) -> bool:
        """Return whether it changes the reading of a sensor's channel."""
        return any(fnmatchcase(channel, pattern) for pattern in self.reads)

    def applies(self, mechanism: Mechanism) -> str:
        """Return why the effect does not apply to a mechanism; empty if it applies."""
        return ""

    def other_kinds(self, mechanism: Mechanism) -> Mapping[str, float]:
        """Return the kinds of machine that the mechanism may be, if it does not state its kind, and
        on which the effect has another usual size.

        Returns
        -------
        dict of float
            Maps a sentence that says how to state the kind to how many times its usual size the
            effect has there. A diagnosis weighs these sizes, too, and shows the sentence if it
            finds the effect larger than usual.
        """
        return {}

    def scan(
        self, mechanism: Mechanism, recorded: Mapping[str, Any]
    ) -> Iterable[Mapping[str, float]]:
        """Return trial values of the parameters in `fixed`.

        A diagnosis tries them if the user did not state a value.

        Parameters
        ----------
        mechanism : Mechanism
        recorded : dict of array (N,)
            Conditions and joint readings of the samples, by name.

        Returns
        -------
        iterable of dict
            Each one maps parameter names to values.
        """
        return ({},)

    def multiples(self, setting: Mapping[str, float]) -> Iterable[Mapping[str, float]]:
        """Return other settings that can describe the residuals as well as the best one of `scan`.

        Example: half of a gear's true ratio fits as well as the true one, because the effect has a
        second harmonic. If a setting returned here fits equally well, the diagnosis takes it in
        place of the best one of `scan`.
        """
        return ()

    def period(self, setting: Mapping[str, float]) -> float | None:
        """Return the period of its pattern in a joint's reading (rad or m); None if it has none."""
        return None

    def least_travel(self, e: Named, joint: str) -> float:
        """How far a joint must move after a reversal (rad or m) until the effect has its full size;
        0 if it has it at once. `e` are the effect's parameters by name."""
        return 0.0

    def absurd(self, e: Named, mechanism: Mechanism) -> str:
        """Return why its values are physically impossible together; empty if they are possible."""
        return ""

    @property
    def name(self) -> str:
        """Name in model files and commands: that of its file, or its Python path."""
        return type(self).__module__.removeprefix("parallel_cal.effects.")

    def is_of_one_joint(self, key: str) -> bool:
        """Return whether a parameter, by its short name, is the constant that a joint has of its
        own."""
        return bool(self.each) and key.endswith(f".{self.each}")

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
            if parse_lag(need) or parse_part(need):
                columns.append(need)
                continue
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


def format_effect(name: str, settings: Mapping[str, float], names: Iterable[str]) -> str:
    """Format an effect with its settings as `parse_effect` reads them. Settings that all joints, or
    all parts, of a model with the parameters `names` have alike are one pattern."""
    own = [n.removeprefix(f"{name}.") for n in names if n.startswith(f"{name}.")]
    short: dict[str, float] = {}
    for key, value in settings.items():
        part, dot, last = key.partition(".")
        alike = [n for n in own if n.partition(".")[2] == last] if dot and part else []
        shared = len(alike) > 1 and all(settings.get(n) == value for n in alike)
        short[f"*.{last}" if shared else key] = value
    numbers = ",".join(f"{key}={float(value)!r}" for key, value in short.items())
    return ":".join(filter(None, [name, numbers]))


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
