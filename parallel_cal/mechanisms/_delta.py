"""What the models of the Delta robot share: its table, home, workspace (table 3.10, 5.12)."""

from __future__ import annotations

import numpy as np

from parallel_cal.model.mechanism import Home, Workspace
from parallel_cal.model.parameters import Parameter, ParameterTable

MM, DEGREE = 1e-3, np.pi / 180

# name: unit, nominal value (table 5.12), tolerance of a real robot (1 sigma).
POSITION = {
    "D_x": ("m", 76 * MM, 1 * MM),
    "D_y": ("m", -16.5 * MM, 1 * MM),
    "D_z": ("m", 0.0, 1 * MM),
    "theta": ("rad", 0.0, 0.5 * DEGREE),
    "alpha": ("rad", 90 * DEGREE, 0.5 * DEGREE),
    "La_x": ("m", 119.963 * MM, 0.5 * MM),
    "La_y": ("m", -3 * MM, 1 * MM),
    "Lb": ("m", 240 * MM, 0.5 * MM),
}
HOME = Home(joints=(30.65 * DEGREE,) * 3, position=(0.0, 0.0, 0.2))
WORKSPACE = Workspace(low=(-0.06, -0.06, 0.14), high=(0.06, 0.06, 0.26))
JOINTS = ("joint1", "joint2", "joint3")
JOINT_LIMITS = ((-30 * DEGREE, 135 * DEGREE),) * 3  # section 2.3.2: mechanical stops
LENGTH = 24 * MM  # half the bar of a rod pair


def chain_parameters(groups: dict[str, dict[str, tuple[str, float, float]]]) -> ParameterTable:
    """The table of three equal chains, 120 degrees apart (theta is the thesis' vartheta)."""
    return ParameterTable(
        Parameter(
            f"chain{i + 1}.{name}",
            unit,
            nominal + (i * 120 * DEGREE if name == "theta" else 0.0),
            tolerance,
            group,
        )
        for i in range(3)
        for group, members in groups.items()
        for name, (unit, nominal, tolerance) in members.items()
    )
