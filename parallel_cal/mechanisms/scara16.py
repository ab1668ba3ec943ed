"""Serial SCARA robot with three joints, model 16 (section 3.2.3, eq. 3.7, table 3.7)."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from parallel_cal.base.units import DEGREE
from parallel_cal.mechanisms.serial import Serial
from parallel_cal.model.mechanism import Workspace
from parallel_cal.model.parameters import Named

HAYATI = ["theta", "a", "alpha", "beta"]
# Table 3.7. {B} is 0.25 m in front of the first axis, in the middle of the reachable area;
# z of {P} is horizontal, as the row "DH" of link 3 requires (alpha near 90 degrees).
LINKS: list[dict[str, Any]] = [
    {"joint": None, "free": HAYATI, "theta": np.pi, "a": 0.25},
    {"joint": "R", "free": HAYATI, "theta": np.pi, "a": 0.20, "low": -2.6, "high": 2.6},
    {"joint": "R", "free": HAYATI, "a": 0.16, "low": 10 * DEGREE, "high": 2.7},
    {"joint": "P", "free": ["theta", "d", "alpha"], "alpha": np.pi / 2, "low": -0.1, "high": 0.1},
    {"joint": None, "free": ["theta"]},
]


class Scara16(Serial):
    """SCARA arm: two parallel revolute axes and a vertical slide.

    It has no wrist, so the three joints also determine the orientation.
    """

    def __init__(self) -> None:
        super().__init__(LINKS, home=(-0.7, 1.6, 0.0), controls=("x", "y", "z"))
        self.workspace = Workspace(low=(-0.06, -0.06, -0.05), high=(0.06, 0.06, 0.05))
        self.length = 0.1

    def joint_candidates(self, r: Any, R: Any, p: Named) -> list[tuple[Any, ...]]:
        """Find the angles with the elbow on either side; exact if all axes are parallel."""
        elbows = [self._elbow(r, p, sign) for sign in (1, -1)]
        return [tuple(e[i] for e in elbows) for i in range(2)] + [(r[2] - p["link3.d"],)]

    def start_inverse(self, r: Any, R: Any, p: Named) -> Any:
        """Start with the elbow on home's side for both angles."""
        shoulder, elbow = self._elbow(r, p, np.sign(self.home.joints[1]))
        angles = self.wrap_to_home([(shoulder,), (elbow,), (r[2] - p["link3.d"],)])
        return ca.vertcat(*[values[0] for values in angles])

    @staticmethod
    def _elbow(r: Any, p: Named, sign: float) -> tuple[Any, Any]:
        """Joints 1 and 2 of the planar arm, by the law of cosines."""
        base, upper, fore = p.base, p.link1, p.link2
        x = r[0] - base.a * ca.cos(base.theta)
        y = r[1] - base.a * ca.sin(base.theta)
        cosine = (x**2 + y**2 - upper.a**2 - fore.a**2) / (2 * upper.a * fore.a)
        bend = sign * ca.acos(ca.fmin(ca.fmax(cosine, -1), 1))
        aim = ca.atan2(y, x) - ca.atan2(fore.a * ca.sin(bend), upper.a + fore.a * ca.cos(bend))
        return aim - base.theta - upper.theta, bend - fore.theta
