"""Argos as its controller sees it: everything at right angles, 3 encoder offsets (table 3.18)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from parallel_cal.mechanisms._argos import orientations
from parallel_cal.mechanisms.argos9 import Argos9
from parallel_cal.mechanisms.argos27 import RADIUS, angle_parameters
from parallel_cal.model.closed_form import joint_angles
from parallel_cal.model.mechanism import Mechanism
from parallel_cal.model.parameters import Named, ParameterTable


class ArgosNominal(Mechanism):
    """Motor axes and directions to the balls are perpendicular (eq. 3.27)."""

    joints = Argos9.joints
    moves = Argos9.moves
    controls = Argos9.controls
    parameters = ParameterTable(p for p in Argos9.parameters if p.name.endswith(".alpha0"))
    home = Argos9.home
    workspace = Argos9.workspace
    joint_limits = Argos9.joint_limits
    closed_forms = ("direct", "inverse")

    def __init__(self, radius: float = RADIUS):
        self.length = float(radius)

    def closure(self, q: Any, r: Any, R: Any, p: Named) -> Any:
        """Model 9's closure (eq. 3.26) with the angles of eq. 3.27."""
        return Argos9(self.length).closure(q, r, R, self._wide(p))

    def candidates(self, q: Any, p: Named) -> list[tuple[Any, Any]]:
        """All four regular solutions (eqs 6.43-6.49), the centre at rest."""
        return orientations(q, p)

    def joint_candidates(self, r: Any, R: Any, p: Named) -> list[tuple[Any, ...]]:
        """Both angles of every motor (eqs 6.50-6.52); home decides as eq. 6.53 does."""
        return joint_angles(self, r, R, p)

    def widen(self, values: Mapping[str, float]) -> tuple[str, dict[str, float]]:
        """Model 9 with right angles."""
        return "argos9", {**Argos9.parameters.mapping(Argos9.parameters.nominal), **values}

    @staticmethod
    def _wide(p: Named) -> Named:
        """Model 9's parameters: the encoder offsets as given, the rest by eq. 3.27."""
        right = {q.name: q.nominal for i in range(3) for q in angle_parameters(i)}
        offsets = {f"chain{i + 1}.alpha0": p[f"chain{i + 1}"].alpha0 for i in range(3)}
        return Named(tuple(right), [offsets.get(name, right[name]) for name in right])
