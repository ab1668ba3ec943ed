"""Makes the SROS2 policy of both nodes from what they really provide, call and subscribe to.

python -m parallel_cal.nodes.policy > policy.xml
python -m parallel_cal.nodes.policy --ros-args -p trajectory_action:=/arm/follow > policy.xml
ros2 security create_artifacts -k keystore -p policy.xml
"""

from __future__ import annotations

import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from itertools import chain
from multiprocessing import get_context
from typing import Any
from xml.etree import ElementTree

import rclpy
from rclpy.action import (
    ActionClient,
    ActionServer,
    get_action_client_names_and_types_by_node,
    get_action_server_names_and_types_by_node,
)
from rclpy.node import Node

from parallel_cal.base.errors import ParallelCalError
from parallel_cal.nodes.calibration_node import CalibrationNode
from parallel_cal.nodes.client import use_private_domain
from parallel_cal.nodes.kinematics_node import KinematicsNode

NODES = (KinematicsNode, CalibrationNode)
ABSOLUTE = ("/rosout", "/clock", "/diagnostics", "/parameter_events", "/tf", "/tf_static")
# The nodes move a robot by topics, or by an action: the policy allows both.
WITH_CAMERA = ("-p", "images:=camera/image_raw/compressed")
WITH_ACTION = ("-p", "trajectory_action:=joint_trajectory_controller/follow_joint_trajectory")
DISCOVERY_TIMEOUT_S = 30.0
ELEMENTS = {"topics": "topic", "services": "service", "actions": "action"}

Right = tuple[str, str]  # a group of ELEMENTS and the right in it, such as ("topics", "publish")


def policy(arguments: Sequence[str] = ()) -> str:
    """Return the policy as XML: a node may use the topics and services it uses now, no others.

    Parameters
    ----------
    arguments
        ROS arguments of the nodes, such as `--ros-args -p images:=cell/image_raw`.

    Returns
    -------
    str
        The policy of both nodes, whose names are relative where that is possible.
    """
    names = defaultdict[tuple[str, str], defaultdict[Right, set[str]]](lambda: defaultdict(set))
    # Each time in a process of its own: ROS does not discover a second node of the same name.
    with get_context("spawn").Pool(1, maxtasksperchild=1) as pool:
        both = [(*given, *arguments) for given in (WITH_CAMERA, WITH_CAMERA + WITH_ACTION)]
        for space, node, use, name in chain.from_iterable(pool.map(_list_uses, both, 1)):
            names[space, node][use].add(name)
    root = ElementTree.Element("policy", version="0.2.0")
    enclaves = ElementTree.SubElement(root, "enclaves")
    for (space, node), rights in names.items():
        path = f"{space.rstrip('/')}/{node}"
        enclave = ElementTree.SubElement(enclaves, "enclave", path=path)
        profiles = ElementTree.SubElement(enclave, "profiles")
        profile = ElementTree.SubElement(profiles, "profile", ns=space, node=node)
        for (group, right), listed in rights.items():
            part = ElementTree.SubElement(profile, group, {right: "ALLOW"})
            for name in sorted(listed):
                ElementTree.SubElement(part, ELEMENTS[group]).text = name
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode", xml_declaration=True) + "\n"


def _list_uses(arguments: Sequence[str]) -> list[tuple[str, str, Right, str]]:
    """Start both nodes; list namespace and name of the node, and each right with its name."""
    use_private_domain()
    fixed = ["--ros-args", "-p", "journal:=false", "--log-level", "fatal"]
    rclpy.init(args=[*fixed, *arguments])
    found = []
    try:
        for make in NODES:
            try:
                node = make()
            except ParallelCalError as error:
                sys.stderr.write(f"not in this policy: {error}\n")
                continue
            here = node.get_namespace(), node.get_name()
            found += [(*here, right, _policy_name(name, node)) for right, name in _uses(node)]
            node.end_work()
            node.destroy_node()
    finally:
        rclpy.try_shutdown()
    return found


def _uses(node: Node) -> Iterator[tuple[Right, str]]:
    """Yield each right that a node needs, with the full name of the topic, service or action."""
    for topic in (*(publisher.topic_name for publisher in node.publishers), "/rosout"):
        yield ("topics", "publish"), topic
    for topic in (*(one.topic_name for one in node.subscriptions), "/clock"):
        yield ("topics", "subscribe"), topic
    for service in node.services:
        yield ("services", "reply"), service.service_name
    for action in _list_actions(node, ActionServer, get_action_server_names_and_types_by_node):
        yield ("actions", "execute"), action
    for action in _list_actions(node, ActionClient, get_action_client_names_and_types_by_node):
        yield ("actions", "call"), action


def _list_actions(node: Node, kind: type, list_by_node: Callable[..., list[Any]]) -> list[str]:
    """Return the names of a node's own actions, once ROS has discovered all of them."""
    expected = sum(isinstance(waitable, kind) for waitable in node.waitables)
    end = time.monotonic() + DISCOVERY_TIMEOUT_S
    while True:
        found = list_by_node(node, node.get_name(), node.get_namespace())
        if len(found) >= expected:
            return [name for name, _ in found]
        if time.monotonic() > end:
            raise ParallelCalError(
                f"{node.get_name()}: {len(found)} of {expected} actions were discovered within "
                f"{DISCOVERY_TIMEOUT_S:.0f} s: try again"
            )
        time.sleep(0.05)


def _policy_name(name: str, node: Node) -> str:
    """Return a relative name where possible, so that the node can move to another namespace."""
    own = f"{node.get_fully_qualified_name()}/"
    if name.startswith(own):
        return "~/" + name.removeprefix(own)
    return name if name in ABSOLUTE else name.removeprefix("/")


if __name__ == "__main__":
    sys.stdout.write(policy(sys.argv[1:]))
