"""The nodes as commands: their help, and a one-line error if ROS 2 is not installed."""

from __future__ import annotations

import sys
from importlib import import_module
from typing import Any


def kinematics_node() -> int:
    """The command `kinematics_node`."""
    return _start("kinematics_node")


def calibration_node() -> int:
    """The command `calibration_node`."""
    return _start("calibration_node")


def replay_node() -> int:
    """The command `replay_node`."""
    return _start("replay_node")


def virtual_cell_node() -> int:
    """The command `virtual_cell_node`."""
    return _start("virtual_cell_node")


def _start(name: str) -> int:
    try:
        module = import_module(f"parallel_cal.nodes.{name}")
    except ImportError as missing:
        package = (missing.name or "").split(".")[0]
        if package == "parallel_cal":
            raise
        sys.stderr.write(
            f"error: {name} needs ROS 2, and {package} is not installed: source its setup.bash, "
            "run pip install 'parallel_cal[ros]', or, in a clone, 'make venv'\n"
        )
        return 1
    if {"-h", "--help"} & set(sys.argv[1:]):
        sys.stdout.write(help_of(name, module))
        return 0
    return int(module.main() or 0)


def help_of(name: str, module: Any) -> str:
    """Return the help text: purpose, usage, and each parameter with its default and range."""
    lines = [module.__doc__.strip(), "", f"usage: {name} [--ros-args -p PARAMETER:=VALUE ...]", ""]
    width = max(map(len, module.PARAMETERS))
    for key, setting in module.PARAMETERS.items():
        default = repr(setting.default) if setting.default != "" else "empty"
        lines.append(f"  {key:{width}}  {setting.what} ({setting.expected()}; {default})")
    return "\n".join([*lines, "", "topics, services and actions: docs/ros.md", ""])
