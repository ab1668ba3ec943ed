"""Declare and check the parameters of nodes from a table of `Setting`s."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.exceptions import (
    InvalidParameterTypeException,
    InvalidParameterValueException,
)
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSPolicyKind, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions

from parallel_cal.base.errors import ParallelCalError

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
# Best effort also receives from reliable publishers, and late readings are useless.
SENSOR = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
RELIABLE = QoSProfile(depth=10)
# Requests wait in this queue. With the default depth of 10, ROS drops the oldest silently.
WAITING = QoSProfile(depth=1000)


class Setting(NamedTuple):
    """A parameter: its default, its meaning, and the allowed values.

    `allowed` holds the smallest and the largest number, or the allowed words; if it is empty, any
    value is allowed. A `fixed` parameter is read at the start and cannot be set later.
    """

    default: Any
    what: str
    allowed: tuple[Any, ...] = ()
    fixed: bool = False

    def allows(self, value: Any) -> bool:
        """Return whether a value is allowed; an integer is allowed for a float."""
        real = isinstance(self.default, float) and not isinstance(value, bool)
        if not isinstance(value, (int, float) if real else type(self.default)):
            return False
        if not self.allowed or isinstance(value, str):
            return not self.allowed or value in self.allowed
        return bool(self.allowed[0] <= value <= self.allowed[-1])

    def descriptor(self) -> ParameterDescriptor:
        """Describe the parameter for `ros2 param describe` and other tools."""
        descriptor = ParameterDescriptor(
            description=self.what,
            read_only=self.fixed,
            additional_constraints=self.expected() if isinstance(self.default, str) else "",
        )
        if self.allowed and not isinstance(self.default, str):
            low, high = self.allowed
            if isinstance(self.default, float):
                real = FloatingPointRange(from_value=float(low), to_value=float(high))
                descriptor.floating_point_range = [real]
            else:
                descriptor.integer_range = [IntegerRange(from_value=int(low), to_value=int(high))]
        return descriptor

    def expected(self) -> str:
        """Say in words which values are allowed."""
        if not self.allowed:
            return _KINDS[type(self.default)]
        if isinstance(self.default, str):
            return " or ".join(self.allowed)
        return f"{_KINDS[type(self.default)]} from {self.allowed[0]:g} to {self.allowed[-1]:g}"


_KINDS = {bool: "true or false", int: "a whole number", float: "a number", str: "a text"}
Settings = Mapping[str, Setting]
Changes = list[Parameter]
ACCEPTED = SetParametersResult(successful=True)


def declare(
    node: Node,
    settings: Settings,
    accept: Callable[[Changes], SetParametersResult] = lambda changes: ACCEPTED,
) -> None:
    """Declare parameters; raise ParallelCalError if a value is not allowed.

    A later change is checked in the same way and refused with the same words. `accept` gets each
    allowed change and decides on it.
    """
    for name, setting in settings.items():
        try:
            value = _declare_one(node, name, setting)
        except (InvalidParameterTypeException, InvalidParameterValueException):
            value = None
        if not setting.allows(value):
            expected = f"expected {setting.expected()}: {setting.what}"
            raise ParallelCalError(f"parameter {name}: {expected}")

    def check(changes: Changes) -> SetParametersResult:
        for change in changes:
            setting = settings.get(change.name)
            if setting is not None and not setting.allows(change.value):
                reason = f"{change.name} {change.value}: expected {setting.expected()}"
                return SetParametersResult(successful=False, reason=reason)
        return accept(changes)

    def convert(changes: Changes) -> Changes:
        """Turn an integer for a float parameter into a float, so that its type never changes."""
        return [
            Parameter(change.name, Parameter.Type.DOUBLE, float(change.value))
            if change.type_ == Parameter.Type.INTEGER
            and change.name in settings
            and isinstance(settings[change.name].default, float)
            else change
            for change in changes
        ]

    node.add_pre_set_parameters_callback(convert)
    node.add_on_set_parameters_callback(check)


def _declare_one(node: Node, name: str, setting: Setting) -> Any:
    """Declare a parameter and return its value; an integer for a float becomes a float."""
    descriptor, start = setting.descriptor(), setting.default
    if isinstance(start, float):
        # The value at the start may be an integer: read it without a type, then declare the type.
        node.declare_parameter(name, start, ParameterDescriptor(dynamic_typing=True))
        start = node.get_parameter(name).value
        node.undeclare_parameter(name)
        if isinstance(start, int) and not isinstance(start, bool):
            start = float(start)
        if not isinstance(start, float):
            return start
    known = isinstance(start, float)
    return node.declare_parameter(name, start, descriptor, ignore_override=known).value


# Parameters of all nodes that accept requests.
SECURITY = {
    "allowed_folders": Setting(
        "",
        "folders whose files requests may name, separated by colons; empty = the folders of the "
        "files named at the start, and the journal's",
        fixed=True,
    ),
    "allow_foreign_modules": Setting(
        False, "allow mechanisms, effects and solvers given by Python path", fixed=True
    ),
}


def absolute(path: str) -> str:
    """Return an absolute path, with ~ as the home folder; an empty path stays empty."""
    return str(Path(os.path.expanduser(path)).absolute()) if path else ""


def overridable() -> QoSOverridingOptions:
    """Let parameters such as `qos_overrides./TOPIC.subscription.reliability` set the QoS."""
    return QoSOverridingOptions(
        [
            QoSPolicyKind.HISTORY,
            QoSPolicyKind.DEPTH,
            QoSPolicyKind.RELIABILITY,
            QoSPolicyKind.DURABILITY,
        ]
    )
