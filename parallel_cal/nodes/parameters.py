"""Parameters of nodes: scalars and paths, declared from one table with their descriptions."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rcl_interfaces.msg import ParameterDescriptor, SetParametersResult
from rclpy.exceptions import InvalidParameterTypeException
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSPolicyKind, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions

from parallel_cal.errors import ParallelCalError

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
# Best effort receives from reliable publishers too, and an old reading is worth nothing.
SENSOR = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
RELIABLE = QoSProfile(depth=10)


def declare(node: Node, table: Mapping[str, tuple[Any, str]]) -> None:
    """Declare parameters from {name: (default, description)}; ParallelCalError for a wrong type.

    Where a real number is expected a whole one will do (`-p min_dwell:=1`).
    """
    for name, (default, what) in table.items():
        real = isinstance(default, float)
        descriptor = ParameterDescriptor(description=what, dynamic_typing=real)
        try:
            value = node.declare_parameter(name, default, descriptor).value
        except InvalidParameterTypeException:
            value = None
        if value is None or not _fits(value, default):
            raise ParallelCalError(f"parameter {name}: {_expected(default)}: {what}")

    def check(changes: list[Parameter]) -> SetParametersResult:
        """What dynamic typing would let pass later on."""
        for change in changes:
            default = table[change.name][0] if change.name in table else change.value
            if not _fits(change.value, default):
                return SetParametersResult(successful=False, reason=_expected(default))
        return SetParametersResult(successful=True)

    node.add_on_set_parameters_callback(check)


def _fits(value: Any, default: Any) -> bool:
    """Whether a value may stand where the default stands; a whole number for a real one."""
    real = isinstance(default, float) and not isinstance(value, bool)
    return isinstance(value, (int, float) if real else type(default))


def _expected(default: Any) -> str:
    return f"expected {_KINDS[type(default)]}"


_KINDS = {bool: "true or false", int: "a whole number", float: "a number", str: "a text"}


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
