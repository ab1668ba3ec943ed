"""Parameters of nodes: scalars and paths, declared from one table with their descriptions."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rcl_interfaces.msg import ParameterDescriptor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSPolicyKind, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
# Best effort receives from reliable publishers too, and an old reading is worth nothing.
SENSOR = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
RELIABLE = QoSProfile(depth=10)


def declare(node: Node, table: Mapping[str, tuple[Any, str]]) -> None:
    """Declare parameters from {name: (default, description)}."""
    for name, (default, what) in table.items():
        node.declare_parameter(name, default, ParameterDescriptor(description=what))


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
