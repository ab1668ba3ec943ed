"""Makes the parameters file of all nodes, with every parameter at its default.

python -m parallel_cal.nodes.parameters_file > config/nodes/parameters.yaml
"""

from __future__ import annotations

import json
import sys
import textwrap
from importlib import import_module

NODES = ("kinematics_node", "calibration_node", "virtual_cell_node", "replay_node")
WIDTH = 100
HEADER = """\
# The parameters of all nodes of parallel_cal, with their defaults. SI units. Copy this file, change
# what you need, and delete the rest:
#
#   ros2 launch parallel_cal calibration.launch.py params_file:=my_parameters.yaml
#   ros2 run parallel_cal kinematics_node --ros-args --params-file my_parameters.yaml
#
# A launch argument of the same name replaces the value of this file. QoS is set in the same way:
# qos_overrides: {/measured_pose: {subscription: {reliability: best_effort}}}
"""


def parameters_file() -> str:
    """Return the text of the file."""
    text = HEADER
    for node in NODES:
        text += f"\n/**/{node}:\n  ros__parameters:\n"
        for name, setting in import_module(f"parallel_cal.nodes.{node}").PARAMETERS.items():
            start = ", read at the start" if setting.fixed else ""
            what = f"{setting.what} ({setting.expected()}{start})"
            comment = textwrap.fill(
                what, WIDTH, initial_indent="    # ", subsequent_indent="    # "
            )
            # JSON is YAML: a float stays a float, and an empty text stays a text.
            text += f"{comment}\n    {name}: {json.dumps(setting.default)}\n"
    return text


if __name__ == "__main__":
    sys.stdout.write(parameters_file())
