"""From the data of a model file to a model; each step relies on the checks before it."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from fnmatch import fnmatchcase
from functools import cached_property
from typing import Any

import numpy as np

from parallel_cal.base.errors import ModelError
from parallel_cal.model.drive import Drive
from parallel_cal.model.effect import Effect
from parallel_cal.model.file import checks
from parallel_cal.model.file.schema import FilePart, OwnNumberPart, suggestion, validate
from parallel_cal.model.file.sensoroptions import own_numbers, read_sensor
from parallel_cal.model.file.yamltext import Document, Path
from parallel_cal.model.machine_class import scale_usual_sizes
from parallel_cal.model.mechanism import Box, Home, Mechanism, Workspace
from parallel_cal.model.model import Model, Noise
from parallel_cal.model.parameters import Parameter, ParameterTable
from parallel_cal.model.sensor import Sensor, apply_sensor_tolerances
from parallel_cal.model.shelf import list_plugins, load_class, load_effect, load_mechanism

VERSION = 1


class Reader:
    """Build a model from one document; any step may raise ModelFileError."""

    def __init__(self, document: Document, known: Model | None = None):
        self._document, self._known = document, known
        self._error = document.error

    def model(self) -> Model:
        self._check_version()
        mechanism = self._mechanism()
        effects = self._load_parts("effects", lambda path, name, entry: load_effect(name))
        sensors = self._load_parts("sensors", self._sensor)
        hint = checks.Hint(self._document, _full_table(mechanism, effects, sensors))
        file = validate(self._document, hint)
        self._configure(mechanism, file)
        if self._known is not None and _is_same_mechanism(self._known.mechanism, mechanism):
            mechanism = self._known.mechanism
        tolerances = self._own_tolerances(mechanism, file)
        # The noise of joints may be stated by joint or by unit.
        known = [*mechanism.joints, *sorted(set(mechanism.joint_units))]
        for name in file.noise.joint if isinstance(file.noise.joint, dict) else ():
            if name not in known:
                raise self._error(
                    ("noise", "joint", name),
                    f"neither a joint nor a unit of a joint{suggestion(name, known)}",
                )
        entries = self._entries(file, mechanism, effects, sensors, tolerances)
        for path, parameter, entry in entries:
            checks.number(self._document, path, parameter, entry.value, entry.sigma)
        table = _full_table(mechanism, effects, sensors)
        sigmas = [entry.sigma for _, _, entry in entries]
        model = Model(
            mechanism,
            tuple(effects),
            np.array([entry.value for _, _, entry in entries]),
            covariance=checks.covariance(self._document, file.covariance, table, sigmas),
            fixed=np.array([entry.fixed for _, _, entry in entries], dtype=bool),
            noise=Noise(**dict(file.noise)),
            history=tuple(file.history),
            frames=dict(file.frames),
            sensors=tuple(sensors),
            machine_class=file.machine_class,
            tolerances=tolerances
            | {
                parameter.name: entry.tolerance
                for path, parameter, entry in entries
                if entry.tolerance is not None
                and (path[0] != "parameters" or entry.usual_tolerance is not None)
            },
            usual_tolerances={
                parameter.name: entry.usual_tolerance
                for _, parameter, entry in entries
                if entry.usual_tolerance is not None
            },
        )
        try:
            model.structure.phi  # noqa: B018  (evaluate a user's closure now, not at its first use)
        except ModelError as error:
            raise self._error(("mechanism",), str(error)) from None
        if file.home is not None:
            checks.home(self._document, model)
        return model

    # ------------------------------------------------------------------ version, mechanism, parts

    def _check_version(self) -> None:
        data = self._document.data
        if not isinstance(data, dict) or "parallel_cal" not in data:
            raise self._error((), "not a model file: the key 'parallel_cal: 1' is missing")
        version = data["parallel_cal"]
        if version != VERSION or isinstance(version, bool):
            raise self._error(
                ("parallel_cal",),
                f"found version {version!r}, expected {VERSION}: the file was written by "
                "another release; update parallel_cal or create the file again",
            )

    def _mechanism(self) -> Mechanism:
        entry = self._document.data.get("mechanism")
        options = entry.get("options", {}) if isinstance(entry, dict) else {}
        name = entry.get("name") if isinstance(entry, dict) else entry
        if not isinstance(name, str) or not isinstance(options, dict):
            known = ", ".join(list_plugins("mechanisms"))
            raise self._error(("mechanism",), f"found {name!r}, expected one of {known}")
        parameters = self._document.data.get("parameters")
        names = parameters if isinstance(parameters, dict) else {}
        try:
            cls: type[Mechanism] = load_class("mechanisms", name, Mechanism)
            return load_mechanism(name, **cls.complete_options(options, names))
        except ModelError as error:
            raise self._error(("mechanism",), str(error)) from None

    def _sensor(self, path: Path, name: str, entry: dict[str, Any]) -> Sensor:
        options = entry.get("options", {})
        if not isinstance(options, dict):
            raise self._error((*path, "options"), f"expected a mapping, found {options!r}")
        return read_sensor(self._document, (*path, "options"), name, options)

    def _load_parts(self, key: str, load: Callable[[Path, str, dict[str, Any]], Any]) -> list[Any]:
        """Load the parts that a list names, each once, in order."""
        entries = self._document.data.get(key)
        loaded: list[Any] = []
        for i, entry in enumerate(entries if isinstance(entries, list) else []):
            name = entry.get("name") if isinstance(entry, dict) else None
            if not isinstance(name, str):  # the schema reports it
                continue
            try:
                part = load((key, i), name, entry)
            except ModelError as error:
                raise self._error((key, i, "name"), str(error)) from None
            if any(other.name == part.name for other in loaded):
                raise self._error((key, i, "name"), f"the {key[:-1]} '{part.name}' occurs twice")
            loaded.append(part)
        return loaded

    # ------------------------------------------------------------------ this robot's mechanism

    def _configure(self, mechanism: Mechanism, file: FilePart) -> None:
        """Set joints, home, workspace, nominal values and tolerances of this robot."""
        self._set_joints(mechanism, file)
        n, controls = len(mechanism.joints), mechanism.controls
        if file.home is not None:
            path, joints = ("home", "joints"), file.home.joints
            checks.length(self._document, path, joints, n, "one for each joint")
            if math.hypot(*file.home.quaternion) < 1e-9:
                raise self._error(
                    ("home", "quaternion"), "found all zeros, expected a rotation x y z w"
                )
            passive = tuple(file.home.passive) or mechanism.home.passive
            what = f"one for each of {', '.join(mechanism.passive) or 'no passive coordinates'}"
            path = ("home", "passive")
            checks.length(self._document, path, passive, len(mechanism.passive), what)
            mechanism.home = replace(Home(*(tuple(v) for _, v in file.home)), passive=passive)
        if file.workspace is not None:
            for key, values in file.workspace:
                what = f"one for each of {', '.join(controls)}"
                checks.length(self._document, ("workspace", key), values, len(controls), what)
            checks.box(self._document, ("workspace",), file.workspace.low, file.workspace.high)
            stated = Workspace(*(tuple(v) for _, v in file.workspace))
            try:
                mechanism.workspace = mechanism.complete_workspace(stated)
            except ModelError as error:
                raise self._error(("workspace",), str(error)) from None
        for k, box in enumerate(file.keep_out):
            checks.box(self._document, ("keep_out", k), box.low, box.high)
        mechanism.keep_out = tuple(Box(*(tuple(v) for _, v in box)) for box in file.keep_out)
        if file.gravity is not None:
            checks.gravity(self._document, file.gravity)
            x, y, z = file.gravity
            mechanism.gravity = (x, y, z)
        names = mechanism.parameters.names
        checks.names(self._document, ("parameters",), file.parameters, names)
        own = []
        for parameter in mechanism.parameters:
            entry = file.parameters[parameter.name]
            checks.unit(self._document, ("parameters", parameter.name), parameter, entry.unit)
            nominal = entry.value if entry.nominal is None else entry.nominal
            tolerance = entry.usual_tolerance or entry.tolerance  # a raised one is the model's
            own.append(replace(parameter, nominal=nominal, tolerance=tolerance))
        mechanism.parameters = ParameterTable(own)

    def _own_tolerances(self, mechanism: Mechanism, file: FilePart) -> dict[str, float]:
        """Return the tolerances by parameter name or shell pattern; each must match a parameter.

        An effect's name stands for all its parameters, except known constants.
        """
        own = dict[str, float]()
        for name, tolerance in file.tolerances.items():
            try:
                effect = load_effect(name.partition(".")[0])
                table = effect.table(mechanism)
                if name != effect.name:
                    table.matching([name])
                    own[name] = tolerance
                    continue
            except ModelError as error:
                raise self._error(("tolerances", name), str(error)) from None
            fixed = effect.fixed_patterns()
            known = table.matching(fixed) if fixed else [False] * len(table)
            free = [p for p, constant in zip(table, known, strict=True) if not constant]
            if len(units := {p.unit: f"{p.name} [{p.unit}]" for p in free}) > 1:
                raise self._error(
                    ("tolerances", name),
                    f"{name} has parameters with different units; state a tolerance for each: "
                    f"{', '.join(units.values())}",
                )
            own |= {p.name: tolerance for p in free} if fixed else {f"{name}.*": tolerance}
        return own

    def _set_joints(self, mechanism: Mechanism, file: FilePart) -> None:
        """Set names, limits, gearing, drives and rates of the joints, in the mechanism's order."""
        names, own = tuple(file.joints), mechanism.joints
        expected = f"{mechanism.name} has {len(own)}: {', '.join(own)}"
        found = f"found {', '.join(names) or 'none'}; {expected}"
        if len(names) != len(own):
            raise self._error(("joints",), f"{len(names)} joints, {found}")
        if names != own and set(names) == set(own):
            raise self._error(("joints",), f"joints are in another order: {found}")
        for (name, joint), unit in zip(file.joints.items(), mechanism.joint_units, strict=True):
            checks.joint(self._document, name, unit, joint)
        mechanism.joints = names
        mechanism.joint_limits = tuple(
            (
                -math.inf if joint.low is None else joint.low,
                math.inf if joint.high is None else joint.high,
            )
            for joint in file.joints.values()
        )
        mechanism.joint_gearing = tuple(joint.gearing for joint in file.joints.values())
        if any(joint.drive for joint in file.joints.values()):
            mechanism.drives = tuple(
                Drive(**dict(joint.drive)) if joint.drive else None
                for joint in file.joints.values()
            )
        rates = [(joint.velocity, joint.acceleration) for joint in file.joints.values()]
        if any(rate is not None for each in rates for rate in each):
            mechanism.joint_rates = tuple((v or math.inf, a or math.inf) for v, a in rates)

    def _entries(
        self,
        file: FilePart,
        mechanism: Mechanism,
        effects: Sequence[Effect],
        sensors: Sequence[Sensor],
        tolerances: Mapping[str, float],
    ) -> list[tuple[Path, Parameter, Any]]:
        """(key, parameter, entry) in the order of the parameter vector."""
        found: list[tuple[Path, Parameter, Any]] = []
        for p in mechanism.parameters:
            own = file.parameters[p.name]
            judged = replace(p, tolerance=own.tolerance)  # raised, if the drawing is wrong
            found.append((("parameters", p.name), judged, own))
        for i, (effect, entry) in enumerate(zip(effects, file.effects, strict=True)):
            path: Path = ("effects", i, "parameters")
            table = apply_sensor_tolerances(sensors, effect.table(mechanism), mechanism)
            # The range finds wrong units. A value that is unusual for a precision machine only was
            # identified, and a reader must not refuse it.
            table = scale_usual_sizes(effect, table, file.machine_class, at_least=1.0)
            table = table.with_tolerances(tolerances)
            found += self._part(path, effect, table, entry.parameters)
        for i, (sensor, given) in enumerate(zip(sensors, file.sensors, strict=True)):
            table = sensor.table(mechanism)
            numbers = given.parameters
            numbers = own_numbers(sensor, table) if numbers is None else numbers
            found += self._part(("sensors", i, "parameters"), sensor, table, numbers)
        return found

    def _part(
        self,
        path: Path,
        part: Effect | Sensor,
        table: ParameterTable,
        numbers: Mapping[str, OwnNumberPart],
    ) -> Iterator[tuple[Path, Parameter, OwnNumberPart]]:
        """The parameters of an effect or a sensor; the file contains their short names."""
        short = {p.name.removeprefix(f"{part.name}."): p for p in table}
        if isinstance(part, Effect):
            numbers = _add_later_parameters(part, short, numbers)
        checks.names(self._document, path, numbers, short)
        for name, parameter in short.items():
            checks.unit(self._document, (*path, name), parameter, numbers[name].unit)
            if (own := numbers[name].tolerance) is not None:
                parameter = parameter.with_tolerance(own)
            yield (*path, name), parameter, numbers[name]


def _add_later_parameters(
    effect: Effect, short: Mapping[str, Parameter], numbers: Mapping[str, OwnNumberPart]
) -> dict[str, OwnNumberPart]:
    """Return the numbers of an effect with those that files of earlier releases lack."""
    fixed = bool(numbers) and all(number.fixed for number in numbers.values())
    later = {
        name: OwnNumberPart(
            value=p.nominal,
            unit=p.unit,
            fixed=fixed or any(fnmatchcase(name, one) for one in effect.fixed),
        )
        for name, p in short.items()
        if name not in numbers and any(fnmatchcase(name, one) for one in effect.added_later)
    }
    return {**numbers, **later}


def _full_table(
    mechanism: Mechanism, effects: Sequence[Effect], sensors: Sequence[Sensor]
) -> ParameterTable:
    parts: list[Effect | Sensor] = [*effects, *sensors]
    tables = [part.table(mechanism) for part in parts]
    return ParameterTable([*mechanism.parameters, *(p for table in tables for p in table)])


def _is_same_mechanism(one: Mechanism, other: Mechanism) -> bool:
    """Return whether two mechanisms are of one type and equal in all that their files state."""
    if type(one) is not type(other):
        return False
    names = {
        name
        for name in {**vars(one), **vars(other)}
        if not isinstance(getattr(type(one), name, None), cached_property)
    }
    stated = ({n: getattr(m, n, None) for n in names - {"parameters"}} for m in (one, other))
    try:
        return tuple(one.parameters) == tuple(other.parameters) and bool(
            next(stated) == next(stated)
        )
    except ValueError:  # of arrays in a user's own mechanism, which have no truth value
        return False
