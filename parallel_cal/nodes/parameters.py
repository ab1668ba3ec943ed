"""Parameters of nodes: scalars and paths, declared from one table that says what they may be."""

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
# Best effort receives from reliable publishers too, and an old reading is worth nothing.
SENSOR = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
RELIABLE = QoSProfile(depth=10)
# Requests that wait for their turn: of ROS' usual ten, the oldest is silently lost to a newer one.
WAITING = QoSProfile(depth=1000)


class Setting(NamedTuple):
    """A parameter: its default, what it means, and which values it may have.

    `allowed` holds the least and the greatest number or the words to choose from; empty: any. A
    `fixed` one is read at the start and cannot be set later.
    """

    default: Any
    what: str
    allowed: tuple[Any, ...] = ()
    fixed: bool = False

    def allows(self, value: Any) -> bool:
        """Whether the parameter may have this value; a whole number will do for a real one."""
        real = isinstance(self.default, float) and not isinstance(value, bool)
        if not isinstance(value, (int, float) if real else type(self.default)):
            return False
        if not self.allowed or isinstance(value, str):
            return not self.allowed or value in self.allowed
        return bool(self.allowed[0] <= value <= self.allowed[-1])

    def descriptor(self) -> ParameterDescriptor:
        """What `ros2 param describe` and the parameter tools show of it."""
        made = ParameterDescriptor(
            description=self.what,
            dynamic_typing=isinstance(self.default, float),
            read_only=self.fixed,
            additional_constraints=self.expected() if isinstance(self.default, str) else "",
        )
        if self.allowed and not isinstance(self.default, str):
            low, high = self.allowed
            if isinstance(self.default, float):
                real = FloatingPointRange(from_value=float(low), to_value=float(high))
                made.floating_point_range = [real]
            else:
                made.integer_range = [IntegerRange(from_value=int(low), to_value=int(high))]
        return made

    def expected(self) -> str:
        """What a value must be, in words."""
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
    """Declare parameters; ParallelCalError for a value that is not allowed.

    Whoever sets some later is refused with the same words; `accept` hears of changes that are
    allowed and has the last word.
    """
    for name, setting in settings.items():
        try:
            value = node.declare_parameter(name, setting.default, setting.descriptor()).value
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

    node.add_on_set_parameters_callback(check)


# What nodes that take requests have in common.
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
    """A path with ~ as the home folder; what is empty stays so."""
    return str(Path(os.path.expanduser(path)).absolute()) if path else ""


def overridable() -> QoSOverridingOptions:
    """Makes a topic's QoS settable by `qos_overrides./TOPIC.subscription.reliability` etc."""
    return QoSOverridingOptions(
        [
            QoSPolicyKind.HISTORY,
            QoSPolicyKind.DEPTH,
            QoSPolicyKind.RELIABILITY,
            QoSPolicyKind.DURABILITY,
        ]
    )
