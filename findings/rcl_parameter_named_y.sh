#!/bin/sh
# Versions: rclpy 7.1.6, rcl 9.2.8 (ROS 2 Jazzy)
# Question: What does a node read from a parameter file with `axis: y`, `count: 010`, `ratio: 1e-3` and
#   `axes: [x, y, z]`?
# Guess: "'y', 8 (YAML 1.1), '1e-3' as PyYAML does, and a list of three texts."
# True: axis is True, because rcl takes y for a boolean. count is 8, ratio is 0.001. `axes: [x, y, z]` is
#   refused before any node starts: "Sequence should be of same type". So is `[0, 0.5, 1]`. PyYAML reads
#   'y', '1e-3' and both lists from the same file.
# Matters: Names of axes are x, y and z. A file that a script in Python wrote and reads stops the node, or
#   sets the axis to True. Write "y" in quotes, and 0.0 for 0.
cd "$(dirname "$0")" && ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST ./with_packages ros-jazzy-rclpy==7.1.6 \
  ros-jazzy-rmw-fastrtps-cpp==8.4.3 numpy==2.4.6 pyyaml==6.0.3 <<'END' 2> /dev/null
import rclpy
import yaml


def read(text):
    with open("parameters.yaml", "w") as file:
        file.write(f"node:\n  ros__parameters: {{value: {text}}}\n")
    try:
        rclpy.init(args=["--ros-args", "--params-file", "parameters.yaml"])
    except Exception as error:
        return str(error).split("Error: ")[-1].split(".")[0]
    node = rclpy.create_node("node", automatically_declare_parameters_from_overrides=True)
    value = node.get_parameter("value").value
    rclpy.shutdown()
    return value


refused = "Sequence should be of same type"
for text, expected in (
    ("x", "x"), ("y", True), ("010", 8), ("1e-3", 0.001), ("[x, y, z]", refused), ("[0, 0.5, 1]", refused),
):
    found = read(text)
    print(f"{text}: rcl {found!r}, PyYAML {yaml.safe_load(text)!r}")
    assert found == expected and type(found) is type(expected)
END
# Seen:
#   x: rcl 'x', PyYAML 'x'
#   y: rcl True, PyYAML 'y'
#   010: rcl 8, PyYAML 8
#   1e-3: rcl 0.001, PyYAML '1e-3'
#   [x, y, z]: rcl 'Sequence should be of same type', PyYAML ['x', 'y', 'z']
#   [0, 0.5, 1]: rcl 'Sequence should be of same type', PyYAML [0, 0.5, 1]
