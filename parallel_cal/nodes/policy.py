"""Makes the SROS2 policy of both nodes from what they really provide and subscribe to.

python -m parallel_cal.nodes.policy > policy.xml
ros2 security create_artifacts -k keystore -p policy.xml
"""

from __future__ import annotations

import sys
from collections.abc import Iterable
from xml.etree import ElementTree

import rclpy
from rclpy.action import get_action_server_names_and_types_by_node
from rclpy.node import Node

from parallel_cal.nodes.calibration_node import CalibrationNode
from parallel_cal.nodes.client import use_private_domain
from parallel_cal.nodes.kinematics_node import KinematicsNode

NODES = (KinematicsNode, CalibrationNode)
ABSOLUTE = ("/rosout", "/clock", "/diagnostics", "/parameter_events")


def policy() -> str:
    """Return the policy as XML: a node may use the topics and services it uses now, no others."""
    use_private_domain()
    rclpy.init(args=["--ros-args", "-p", "journal:=false", "--log-level", "fatal"])
    root = ElementTree.Element("policy", version="0.2.0")
    enclaves = ElementTree.SubElement(root, "enclaves")
    try:
        for make in NODES:
            node = make()
            path = node.get_fully_qualified_name()
            enclave = ElementTree.SubElement(enclaves, "enclave", path=path)
            profiles = ElementTree.SubElement(enclave, "profiles")
            _add_profile(profiles, node)
            node.end_work()
            node.destroy_node()
    finally:
        rclpy.try_shutdown()
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode", xml_declaration=True) + "\n"


def _add_profile(profiles: ElementTree.Element, node: Node) -> None:
    node_name, space = node.get_name(), node.get_namespace()
    profile = ElementTree.SubElement(profiles, "profile", ns=space, node=node_name)
    actions = get_action_server_names_and_types_by_node(node, node_name, space)
    rules: tuple[tuple[str, str, str, Iterable[str]], ...] = (
        ("topics", "publish", "topic", (*(p.topic_name for p in node.publishers), "/rosout")),
        ("topics", "subscribe", "topic", (*(s.topic_name for s in node.subscriptions), "/clock")),
        ("services", "reply", "service", (s.service_name for s in node.services)),
        ("actions", "execute", "action", (action for action, _ in actions)),
    )
    for group, right, kind, names in rules:
        listed = sorted({_policy_name(name, node) for name in names})
        if listed:
            part = ElementTree.SubElement(profile, group, {right: "ALLOW"})
            for name in listed:
                ElementTree.SubElement(part, kind).text = name


def _policy_name(name: str, node: Node) -> str:
    """Return a relative name where possible, so that the node can move to another namespace."""
    own = f"{node.get_fully_qualified_name()}/"
    if name.startswith(own):
        return "~/" + name.removeprefix(own)
    return name if name in ABSOLUTE else name.removeprefix("/")


if __name__ == "__main__":
    sys.stdout.write(policy())
