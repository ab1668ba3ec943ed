"""Text of a model file; equal models give equal text in every process."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import fields
from typing import Any

import numpy as np

from parallel_cal.model.effect import Effect
from parallel_cal.model.file.yamltext import flow
from parallel_cal.model.machine_class import DEFAULT_CLASS
from parallel_cal.model.mechanism import Box, Workspace
from parallel_cal.model.model import Model
from parallel_cal.model.parameters import Parameter
from parallel_cal.model.sensor import Sensor

HEAD = """\
# Model file of parallel_cal. SI units: m, rad, kg, s, N, degC. sigma and tolerance are 1 sigma;
# a value more than 10 tolerances from nominal is refused when the file is read.
parallel_cal: 1
"""


def dump_model(model: Model) -> str:
    """Write a model as text; ModelFileError if a number is not finite."""
    parts = (_setup, _parameters, _effects, _sensors, _tolerances, _covariance, _history)
    return HEAD + "".join(f"{line}\n" for part in parts for line in part(model))


def _setup(model: Model) -> Iterator[str]:
    m = model.mechanism
    yield from _mechanism(model)
    if model.machine_class != DEFAULT_CLASS:
        yield f"class: {model.machine_class}"
    yield "joints:"
    rates = m.joint_rates or ((math.inf, math.inf),) * len(m.joints)
    gears = m.joint_gearing or (1.0,) * len(m.joints)
    drives = m.drives or (None,) * len(m.joints)
    rows = zip(m.joints, m.joint_units, m.joint_limits, rates, gears, drives, strict=True)
    for joint, unit, (low, high), (velocity, acceleration), gearing, drive in rows:
        limits = {"low": low, "high": high, "velocity": velocity, "acceleration": acceleration}
        limits |= {"gearing": gearing} if gearing != 1.0 else {}
        finite = {key: float(v) for key, v in limits.items() if math.isfinite(v)}
        own = {}
        if drive:
            stated = {f: getattr(drive, f.name) for f in fields(drive)}
            own["drive"] = {f.name: value for f, value in stated.items() if value != f.default}
        yield f"  {flow(joint)}: {flow({'unit': unit, **finite, **own})}"
    yield "home:"
    for key in ("joints", "position", "quaternion"):
        yield f"  {key}: {flow([float(v) for v in getattr(m.home, key)])}"
    if m.home.passive:
        yield f"  passive: {flow([float(v) for v in m.home.passive])}"
    yield f"workspace: {flow(_box(m.workspace))}"
    if m.keep_out:
        yield "keep_out:"
        yield from (f"  - {flow(_box(box))}" for box in m.keep_out)
    yield f"frames: {flow(dict(model.frames))}"
    if tuple(m.gravity) != type(m).gravity:
        yield f"gravity: {flow([float(v) for v in m.gravity])}"
    noise = {key: value for key, value in vars(model.noise.as_stated).items() if value is not False}
    yield f"noise: {flow(noise)}"


def _box(box: Workspace | Box) -> dict[str, list[float]]:
    return {side: [float(v) for v in getattr(box, side)] for side in ("low", "high")}


def _mechanism(model: Model) -> Iterator[str]:
    m = model.mechanism
    if not m.options:
        yield f"mechanism: {flow(m.name)}"
        return
    yield f"mechanism:\n  name: {flow(m.name)}\n  options:"
    for key, value in m.options.items():
        if isinstance(value, (list, tuple)) and any(isinstance(v, Mapping) for v in value):
            yield f"    {flow(key)}:"
            yield from (f"    - {flow(item)}" for item in value)
        else:
            yield f"    {flow(key)}: {flow(value)}"


def _parameters(model: Model) -> Iterator[str]:
    yield "parameters:"
    for i, parameter in enumerate(model.mechanism.parameters):
        name = parameter.name
        own = {
            "nominal": parameter.nominal,
            "tolerance": model.tolerances.get(name, parameter.tolerance),
            "usual_tolerance": model.usual_tolerances.get(name),
        }
        yield f"  {flow(name)}: {flow(_entry(model, i, parameter, own))}"


def _effects(model: Model) -> Iterator[str]:
    yield "effects:" if model.effects else "effects: []"
    for effect in model.effects:
        yield f"- name: {flow(effect.name)}"
        yield from _numbers(model, effect)


def _sensors(model: Model) -> Iterator[str]:
    """No section without sensors: most robots are measured by a pose device in {B}."""
    if model.sensors:
        yield "sensors:"
    for sensor in model.sensors:
        yield f"- name: {flow(sensor.class_name)}"
        yield f"  options: {flow(sensor.options)}"
        yield from _numbers(model, sensor)


def _tolerances(model: Model) -> Iterator[str]:
    """Tolerances of effects outside the model; the others are beside their parameters."""
    if others := {k: float(v) for k, v in model.tolerances.items() if k not in model.table.names}:
        yield "tolerances:"
        yield from (f"  {flow(name)}: {flow(value)}" for name, value in others.items())


def _numbers(model: Model, part: Effect | Sensor) -> Iterator[str]:
    """The parameters of an effect or a sensor under their short names."""
    table = part.table(model.mechanism)
    yield "  parameters:" if len(table) else "  parameters: {}"
    for parameter in table:
        name, i = parameter.name.removeprefix(f"{part.name}."), model.table.index_of(parameter.name)
        own = {
            "tolerance": model.tolerances.get(parameter.name),
            "usual_tolerance": model.usual_tolerances.get(parameter.name),
        }
        yield f"    {flow(name)}: {flow(_entry(model, i, parameter, own))}"


def _entry(
    model: Model, i: int, parameter: Parameter, own: Mapping[str, float | None]
) -> dict[str, Any]:
    """One parameter's keys, the value first; `own` without those that are None."""
    entry: dict[str, Any] = {"value": float(model.values[i]), "unit": parameter.unit}
    entry |= {key: float(value) for key, value in own.items() if value is not None}
    if model.covariance is not None and model.covariance[i, i] > 0:
        entry["sigma"] = math.sqrt(model.covariance[i, i])
    if model.fixed is not None and model.fixed[i]:
        entry["fixed"] = True
    return entry


def _covariance(model: Model) -> Iterator[str]:
    """Names and lower triangle of the estimated parameters; omitted if sigmas suffice."""
    if model.covariance is None:
        return
    full = np.asarray(model.covariance)
    diagonal = np.diag(full)
    if (full == np.diag(np.sqrt(np.maximum(diagonal, 0)) ** 2)).all() and diagonal.any():
        return
    used = np.flatnonzero(diagonal != 0)
    names = [model.table.names[i] for i in used]
    yield "covariance:"
    yield f"  names: {flow(names)}"
    yield "  lower:" if len(used) else "  lower: []"
    for k, i in enumerate(used):
        yield f"  - {flow([float(full[i, j]) for j in used[: k + 1]])}"


def _history(model: Model) -> Iterator[str]:
    yield "history:" if model.history else "history: []"
    for step in model.history:
        for k, (key, value) in enumerate(step.items()):
            yield f"{'  ' if k else '- '}{flow(key)}: {flow(value)}"
