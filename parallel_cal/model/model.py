"""A model: mechanism + ordered effects + numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from parallel_cal.base.arguments import check_arguments, describe_argument, require
from parallel_cal.base.documents import make_plain
from parallel_cal.base.errors import ModelError
from parallel_cal.model.configuration import Configuration
from parallel_cal.model.effect import Effect, list_substitutes
from parallel_cal.model.machine_class import DEFAULT_CLASS, MachineClass, check_class
from parallel_cal.model.mechanism import Mechanism
from parallel_cal.model.parameters import Named, ParameterTable
from parallel_cal.model.sensor import Sensor
from parallel_cal.model.shelf import load_effect, load_mechanism
from parallel_cal.model.structure import Structure, structure_of


@dataclass(frozen=True)
class Noise:
    """Standard deviation of the measurement noise (1 sigma).

    Parameters
    ----------
    joint : float or dict of float, optional
        Standard deviation of joint readings, rad or m: one value for all joints, or values by unit
        (`{"m": 2e-6, "rad": 2e-5}`) or by joint. A joint's own value precedes that of its unit.
        Default: not stated.
    position : float, optional
        Standard deviation of each coordinate of a measured position, m. Default: not stated.
    orientation : float, optional
        Standard deviation of a measured orientation about each axis, rad. Default: not stated.
    assumed : bool
        Whether the values were assumed and not measured. A fit then uses only their ratios, as
        weights, and estimates the common factor from the residuals. Default False.
    """

    joint: float | Mapping[str, float] | None = None
    position: float | None = None
    orientation: float | None = None
    assumed: bool = False

    def with_joints(self, sigma: float | None) -> Noise:
        """Return the noise with that of all joints stated, rad or m; itself if `sigma` is None.

        What was assumed beside it is unknown then: there is one mark for all values.
        """
        if sigma is None:
            return self
        return Noise(sigma) if self.assumed else replace(self, joint=sigma)

    @property
    def as_stated(self) -> Noise:
        """What the model file states."""
        return self


@dataclass(frozen=True, eq=False)
class Model:
    """A mechanism, its effects and all parameter values.

    A model is immutable. A running program can therefore switch to a new model without locks.

    Parameters
    ----------
    mechanism : Mechanism
    effects : tuple of Effect
        In the order in which they act.
    values : array (n,)
        Values of all parameters in SI units, in the order of `table`: geometry, effects, sensors.
    covariance : array (n, n), optional
        Covariance of the values. None: the values are not identified. Default None.
    fixed : array of bool (n,)
        Which parameters a fit must not change. Default: those that mechanism, effects and sensors
        mark as fixed.
    noise : Noise
        Measurement noise. Default: nothing stated.
    history : tuple of dict
        One entry for each step that changed the model. Default empty.
    frames : dict of str
        ROS names of the frames `base` ({B}) and `platform` ({P}).
    sensors : tuple of Sensor
        Measuring set-ups. Default none: the device measures the pose in {B}.
    tolerances : dict of float
        Tolerances that replace those of the catalogue, for parameters of effects and sensors. Keys
        are full names or shell patterns. Default none.
    machine_class : str
        `precision`, `industrial` or `hobby`: how large the usual errors of such a machine are. It
        scales the tolerances of all effects of the robot, except those in `tolerances`. Default
        `industrial`.
    usual_tolerances : dict of float
        If a fit finds a value that is larger than usual, it replaces the tolerance of this
        parameter in `tolerances` by a larger one. The original tolerance is kept here, by the full
        name of the parameter. Default none.

    Raises
    ------
    ModelError
        If the number of values is not the number of parameters.

    Examples
    --------
    >>> import parallel_cal as pc
    >>> model = pc.new_model("delta24")
    >>> model.joints, len(model.values)
    (('joint1', 'joint2', 'joint3'), 24)
    >>> model.value("chain1.Lb")  # m
    0.24
    """

    mechanism: Mechanism
    effects: tuple[Effect, ...]
    values: np.ndarray
    covariance: np.ndarray | None = None
    fixed: np.ndarray = None  # type: ignore[assignment]  # default: __post_init__ computes it
    noise: Noise = Noise()
    history: tuple[dict[str, Any], ...] = ()
    frames: Mapping[str, str] = field(
        default_factory=lambda: {"base": "base", "platform": "platform"}
    )
    sensors: tuple[Sensor, ...] = ()
    tolerances: Mapping[str, float] = field(default_factory=dict)  # of effects and sensors
    machine_class: MachineClass = DEFAULT_CLASS
    usual_tolerances: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_class(self.machine_class)
        require("values", self.values, "ArrayLike", ModelError)
        values = np.array(self.values, dtype=float)
        values.setflags(write=False)
        object.__setattr__(self, "values", values)
        make_plain(self, "tolerances", "usual_tolerances")
        if self.fixed is None:
            parts = (*self.effects, *self.sensors)
            pattern = [*self.mechanism.fixed, *(p for part in parts for p in part.fixed_patterns())]
            mask = (
                self.table.matching(pattern) if pattern else np.zeros(len(self.table), dtype=bool)
            )
            object.__setattr__(self, "fixed", mask)
        n = len(self.table)
        if values.shape != (n,):
            raise ModelError(f"found {values.size} values, expected {n}, one for each parameter")
        if self.covariance is not None:
            covariance = np.asarray(self.covariance, dtype=float)
            object.__setattr__(self, "covariance", covariance)
            if covariance.shape != (n, n):
                shape = covariance.shape
                raise ModelError(f"the covariance has the shape {shape}; expected {(n, n)}")

    def __repr__(self) -> str:
        effects = "".join(f" + {effect.name}" for effect in self.effects)
        sensors = "".join(f" + {sensor.name}" for sensor in self.sensors)
        return f"Model({self.mechanism.name}{effects}{sensors}, {len(self.values)} parameters)"

    @property
    def structure(self) -> Structure:
        """Equations of the mechanism, its effects and sensors.

        Models that differ only in their values share one object."""
        known: Structure | None = vars(self).get("_structure")
        if known is None or known.content is not self.mechanism.content:
            known = structure_of(self.mechanism, self.effects, self.sensors)
            vars(self)["_structure"] = known
        return known

    @cached_property
    def table(self) -> ParameterTable:
        """All parameters with name, unit, nominal value and tolerance, in the order of `values`."""
        if not self.tolerances and self.machine_class == DEFAULT_CLASS:
            return self.structure.table
        return self.structure.table_of(self.machine_class, tuple(self.tolerances.items()))

    @property
    def usual_tolerance(self) -> np.ndarray:
        """Tolerance (n,) of each parameter before a fit raised it. A raised tolerance follows from
        the value: in units of it, every unusual value is equally far from nominal."""
        pairs = zip(self.table.names, self.table.tolerance, strict=True)
        return np.array([self.usual_tolerances.get(name, own) for name, own in pairs])

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the joints, in the order of joint readings (nq,)."""
        return self.mechanism.joints

    def configuration(self, rows: np.ndarray) -> Configuration:
        """Return views of rows (N, nq + 12 + nu): joints, poses and passive coordinates."""
        return Configuration.from_rows(rows, len(self.mechanism.passive))

    @property
    def joint_noise(self) -> np.ndarray:
        """Stated standard deviation (nq,) of each joint's readings, NaN if not stated."""
        stated, m = self.noise.joint, self.mechanism
        if not isinstance(stated, Mapping):
            return np.full(len(m.joints), np.nan if stated is None else stated)
        pairs = zip(m.joints, m.joint_units, strict=True)
        return np.array([stated.get(j, stated.get(unit, np.nan)) for j, unit in pairs])

    @property
    def conditions(self) -> tuple[str, ...]:
        """Names of the conditions that the effects and sensors depend on."""
        return self.structure.conditions

    def with_values(self, values: np.ndarray, covariance: np.ndarray | None = None) -> Model:
        """Return the model with other parameter values.

        Parameters
        ----------
        values : array (n,)
            Values of all parameters in SI units, in the order of `table`.
        covariance : array (n, n), optional
            Covariance of the values. Default None: the values are not identified.
        """
        return replace(self, values=values, covariance=covariance)

    def value(self, name: str) -> float:
        """Return the value of a parameter in SI units; ModelError if the name is unknown."""
        require("name", name, "str", ModelError)
        return float(self.values[self.table.index_of(name)])

    def has_effect(self, name: str) -> bool:
        """Return whether the model has the effect with this name."""
        return any(effect.name == name for effect in self.effects)

    def with_effect(self, name: str, settings: Mapping[str, float] | None = None) -> Model:
        """Return the model with one more effect, whose coefficients are zero; or, of an effect that
        it has, with a number that a joint has of its own.

        Parameters
        ----------
        name : str
            Name of the effect in the catalogue, or the Python path of your own. It becomes the last
            effect.
        settings : mapping of str to float, optional
            Known parameters of the effect, by short name, such as `{"ratio": 80.0}`. They are
            fixed. Of an effect that the model has, only such as `{"joint2.ratio": 15.0}`.

        Returns
        -------
        Model

        Raises
        ------
        ModelError
            If the effect is unknown, does not apply to the mechanism, or is in the model already,
            or if the settings state the constant of a joint without that of the others.
        """
        effect = load_effect(name)
        own = [key for key in settings or {} if effect.is_of_one_joint(key)]
        if self.has_effect(name):
            if own and len(own) == len(settings or {}):
                return self.with_settings(name, settings or {})
            hint = f"; a joint that differs: {name}:JOINT.{effect.each}=..." if effect.each else ""
            raise ModelError(f"the model already has the effect '{name}'{hint}")
        reason = effect.applies(self.mechanism)
        if effect.reads and not reason and not any(map(effect.acts_on, self.structure.channels)):
            reason = f"no sensor measures {' or '.join(effect.reads)}"
        if reason:
            raise ModelError(f"effect {name} does not apply to {self.mechanism.name}: {reason}")
        more = self.widen() if effect.widens else self.with_effects((*self.effects, effect))
        common, given = effect.each, settings or {}
        if own and common not in given and f"{name}.{common}" in more.table.names:
            raise ModelError(
                f"{name}: {own[0]} is stated without {common}, which the other joints have: state "
                f"both ({name}:{common}=...,{own[0]}=...), or none, to search for them"
            )
        return more.with_settings(name, given)

    def with_settings(self, effect: str, settings: Mapping[str, float]) -> Model:
        """Return the model with some parameters of an effect fixed at the given values.

        `settings` are the values in SI units by short name, such as `{"ratio": 80.0}`, or by a
        pattern of names, such as `{"*.width": 2e-3}` for the width of all joints.
        """
        values, fixed = self.values.copy(), self.fixed.copy()
        for key, value in settings.items():
            name = f"{effect}.{key}"
            which = self.table.matching([name]) if "*" in key else self.table.index_of(name)
            values[which], fixed[which] = value, True
        return replace(self, values=values, fixed=fixed)

    def settings_of(self, *effects: str) -> np.ndarray:
        """Return which parameters (n_parameters,) are settings of these effects, such as a ratio:
        numbers that are known or searched for, and not identified."""
        own = [one for one in self.effects if one.name in effects]
        patterns = [pattern for one in own for pattern in one.fixed_patterns()]
        return self.table.matching(patterns) & self.fixed

    def collect_own_constants(self, effect: Effect) -> dict[str, float]:
        """Collect the constants that joints may have of their own in an effect, by joint; 0 where a
        joint has the common one."""
        numbers = self.table.mapping(self.values) if effect.each else {}
        if f"{effect.name}.{effect.each}" not in numbers:
            return {}
        names = {joint: f"{effect.name}.{joint}.{effect.each}" for joint in self.joints}
        return {joint: numbers[name] for joint, name in names.items() if name in numbers}

    def list_unused_numbers(self) -> set[str]:
        """List the settings of effects that no joint has: its own where it has the common one, and
        the common one where each joint has its own."""
        unused = set[str]()
        for effect in self.effects:
            own = self.collect_own_constants(effect)
            absent = {f"{effect.name}.{joint}.{effect.each}" for joint in own if not own[joint]}
            unused |= absent if absent or not own else {f"{effect.name}.{effect.each}"}
        return unused

    def robot(self) -> Model:
        """Return the model as a controller needs it: effects of the measuring device are zero."""
        own = [f"{effect.name}.*" for effect in self.effects if effect.of_device]
        if not own:
            return self
        device = self.table.matching(own)
        return self.with_values(np.where(device, self.table.nominal, self.values), self.covariance)

    def find_contradiction(self) -> str:
        """Return why the values of an effect are impossible together; empty if all are possible."""
        numbers = Named(self.table.names, self.values)
        words = (effect.absurd(numbers[effect.name], self.mechanism) for effect in self.effects)
        return next(filter(None, words), "")

    def without_effect(self, name: str) -> Model:
        """Return the model without one of its effects; ModelError if it has no such effect."""
        kept = tuple(effect for effect in self.effects if effect.name != name)
        if len(kept) == len(self.effects):
            text = ", ".join(effect.name for effect in self.effects) or "none"
            steps = [step.get("step") for step in self.history if step.get("effect") == name]
            if steps[-1:] == ["add"]:  # an effect that widened the mechanism
                text += (
                    f": it was added by changing the mechanism to {self.mechanism.name}. To "
                    "undo it, go back to the model file from before"
                )
            raise ModelError(f"the model has no effect '{name}'; it has {text}")
        return self.with_effects(kept)

    @check_arguments(ModelError)
    def with_effects(self, effects: tuple[Effect, ...]) -> Model:
        """Return the model with these effects.

        Parameters that the model already has keep their values and stay free or fixed.
        """
        return self._with_parts(effects, self.sensors)

    @check_arguments(ModelError)
    def with_sensors(self, sensors: tuple[Sensor, ...]) -> Model:
        """Return the model with these sensors.

        Parameters that the model already has keep their values and covariance, and stay free or
        fixed. A sensor that states another nominal value than before starts at that value, with its
        usual tolerance.
        """
        return self._with_parts(self.effects, sensors).with_covariance_of(self)

    def with_covariance_of(self, other: Model) -> Model:
        """Return the model with the covariance of another one for the parameters that both have;
        that of all further parameters is zero. If the other one has no covariance, the returned
        model has none either."""
        if other.covariance is None:
            return replace(self, covariance=None)
        own, names = other.table.names, self.table.names
        kept = [i for i, name in enumerate(names) if name in own]
        before = [own.index(names[i]) for i in kept]
        covariance = np.zeros((len(names), len(names)))
        covariance[np.ix_(kept, kept)] = np.asarray(other.covariance)[np.ix_(before, before)]
        return replace(self, covariance=covariance)

    def _with_parts(self, effects: tuple[Effect, ...], sensors: tuple[Sensor, ...]) -> Model:
        table = structure_of(self.mechanism, effects, sensors).table
        stated = zip(self.table.names, self.table.nominal, strict=True)
        known = dict(zip(stated, zip(self.values, self.fixed, strict=True), strict=True))
        parts: tuple[Effect | Sensor, ...] = (*effects, *sensors)
        given = table.matching(p for part in parts for p in part.fixed_patterns())
        fresh = zip(table.nominal, given, strict=True)
        kept = [known.get((p.name, p.nominal), new) for p, new in zip(table, fresh, strict=True)]
        values, fixed = (np.array(column) for column in zip(*kept, strict=True))
        names = {name for name, _ in known}
        restated = {p.name for p in table if p.name in names and (p.name, p.nominal) not in known}
        return replace(
            self,
            effects=effects,
            sensors=sensors,
            tolerances={n: size for n, size in self.tolerances.items() if n not in restated},
            values=values,
            fixed=fixed.astype(bool),
            covariance=None,
        )

    def widen(self) -> Model:
        """Convert to the next larger mechanism (such as delta24 to delta54).

        The new model predicts the same poses. Parameters that both models have keep their values
        and stay free or fixed.
        """
        m = self.mechanism
        own = m.parameters
        name, values = m.widen(own.mapping(self.values[: len(own)]))
        larger = load_mechanism(name, **m.options)
        _, nominal = m.widen(own.mapping(own.nominal))
        larger.parameters = larger.parameters.with_nominal(nominal)
        larger.joints, larger.joint_limits = m.joints, m.joint_limits
        larger.joint_rates, larger.keep_out = m.joint_rates, m.keep_out
        larger.joint_gearing, larger.drives = m.joint_gearing, m.drives
        larger.home, larger.workspace, larger.gravity = m.home, m.workspace, m.gravity
        effects = [effect.name for effect in self.effects]
        wide = new_model(larger, effects=effects, sensors=self.sensors)
        values = self.table.mapping(self.values) | values
        masks = dict(zip(self.table.names, self.fixed, strict=True))
        names = wide.table.names
        return replace(
            self,
            mechanism=wide.mechanism,
            effects=wide.effects,
            values=np.array([values.get(n, v) for n, v in zip(names, wide.values, strict=True)]),
            fixed=np.array([masks.get(n, f) for n, f in zip(names, wide.fixed, strict=True)]),
            covariance=None,
        )

    def condition_rows(self, at: Mapping[str, Any] | None, n: int) -> np.ndarray:
        """Arrange conditions in an array (n, n_conditions), in the order of `conditions`.

        `at` holds scalars or columns (n,) by name. A condition that is not given gets its neutral
        value, at which the effect is zero (direction 0: the middle of the backlash). A lagged
        condition that is not given is settled: it equals the condition that it follows. A part
        whose temperature is not given has the general temperature.
        """
        if at is not None and not isinstance(at, Mapping):  # else the check costs microseconds
            require("at", at, "Mapping[str, Any] | None", ModelError)
        rows = np.empty((n, len(self.conditions)))
        given = at or {}
        for k, (name, neutral) in enumerate(
            zip(self.conditions, self.structure.neutral, strict=True)
        ):
            known = (given[one] for one in (name, *list_substitutes(name)) if one in given)
            value = next(known, neutral)
            try:
                rows[:, k] = value
            except (TypeError, ValueError):
                raise ModelError(
                    f"{describe_argument(f'condition {name}', value)}; expected a number"
                    + (f" or {n} numbers, one for each sample" if n > 1 else "")
                ) from None
        return rows


@check_arguments(ModelError)
def new_model(
    mechanism: Mechanism | str,
    values: Mapping[str, float] | None = None,
    effects: Sequence[str] = (),
    sensors: Sequence[Sensor] = (),
    machine_class: MachineClass = DEFAULT_CLASS,
) -> Model:
    """Make a model of a mechanism with nominal values.

    Parameters
    ----------
    mechanism : Mechanism or str
        `pc.mechanisms.names()` lists the names; a Python path names your own.
    values : mapping of str to float, optional
        Values (m, rad) that replace nominal ones, by parameter name.
    effects : sequence of str, optional
        Names of effects, in the order in which they act.
    sensors : sequence of Sensor, optional
    machine_class : str, optional
        `precision`, `industrial` or `hobby`: how large the usual errors of such a machine are.
        Default `industrial`.

    Returns
    -------
    Model

    Raises
    ------
    ModelError
        If a name is unknown.

    Examples
    --------
    >>> import parallel_cal as pc
    >>> model = pc.new_model("delta24", effects=["backlash"])
    >>> model.joints
    ('joint1', 'joint2', 'joint3')
    """
    if isinstance(mechanism, str):
        mechanism = load_mechanism(mechanism)
    loaded = tuple(load_effect(name) for name in effects)
    table = structure_of(mechanism, loaded, tuple(sensors)).table
    return Model(
        mechanism,
        loaded,
        table.vector(values or {}),
        sensors=tuple(sensors),
        machine_class=machine_class,
    )
