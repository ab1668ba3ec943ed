"""Delta robot as its controller sees it: one radius, one arm, one rod length (table 3.12)."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from parallel_cal.base.units import DEGREE, MM
from parallel_cal.mechanisms._delta import POSITION
from parallel_cal.mechanisms.delta24 import Delta24
from parallel_cal.model.mechanism import Home, Workspace
from parallel_cal.model.parameters import Named, Parameter, ParameterTable

BODIES = {"arms": ("La",), "rods": ("Lb",), "base": ("R",)}


class DeltaNominal(Delta24):
    """Delta robot with three equal chains at the angles theta_i.

    R is the radius of the base minus the radius of the platform.

    Options: `base`, `platform`, `arm`, `rod`, `direction`, `home`, `below` and `limits`, the size
    of the robot in m and rad. `base` and `platform` are the distances of the motor axes and of the
    rods' joints on the platform from the centre (0.1 and 0.024), `arm` and `rod` the lengths (0.12
    and 0.24). `direction` is that of the first motor about z, measured from x (0); the others
    follow at 120 and 240 degrees. `home` is the angle of all arms at home, positive towards +z
    (0.535). With `below: true` the platform is on the -z side of the arms: a hanging robot with z
    up (then `home` is -0.535). `limits` are those of the angles (-0.52 to 2.36, or -2.36 to 0.52
    with `below`). With any of them, the motors lie in the plane z = 0, and home and workspace
    follow from the size. Without options, the robot is that of table 3.12.

    `switches` (rad) are the readings at which the controller homes the joints (default: the upper
    limits).
    """

    parameters = ParameterTable(
        [
            *[
                Parameter(
                    f"chain{i + 1}.theta",
                    "rad",
                    i * 120 * DEGREE,
                    0.5 * DEGREE,
                    label="chain's direction about z",
                )
                for i in range(3)
            ],
            Parameter("R", "m", 76 * MM, 1 * MM, label="base radius less platform radius"),
            Parameter("La", "m", 120 * MM, 0.5 * MM, label="arm length"),
            Parameter("Lb", "m", 240 * MM, 0.5 * MM, label="rod length"),
        ]
    )
    home = Home(joints=(30.65 * DEGREE,) * 3, position=(0.0, 0.0, 0.22078))
    workspace = Workspace(low=(-0.06, -0.06, 0.155), high=(0.06, 0.06, 0.275))
    bodies = BODIES

    def chains(self, p: Named) -> list[Named]:
        """Return model 24's parameters with the numbers of table 3.12."""
        names = tuple(POSITION)
        return [
            Named(names, [p.R, 0, 0, p[f"chain{i + 1}.theta"], np.pi / 2, p.La, 0, p.Lb])
            for i in range(3)
        ]

    def widen(self, values: Mapping[str, float]) -> tuple[str, dict[str, float]]:
        """Widen to model 24 with equal chains."""
        chains = self.chains(Named(list(values), list(values.values())))
        numbers = [chain[name] for chain in chains for name in POSITION]
        return "delta24", dict(zip(Delta24.parameters.names, numbers, strict=True))
