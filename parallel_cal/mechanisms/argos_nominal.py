"""Argos as its controller sees it: everything at right angles, 3 encoder offsets (table 3.18)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from parallel_cal.mechanisms._argos import Argos
from parallel_cal.mechanisms.argos9 import Argos9
from parallel_cal.model.drawing import Line
from parallel_cal.model.parameters import Named, ParameterTable


class ArgosNominal(Argos):
    """Argos with nominal geometry and three encoder offsets.

    The motor axes are perpendicular to one another, and so are the directions to the three balls
    (Vischer 1996, eq. 3.27).
    """

    parameters = ParameterTable(p for p in Argos9.parameters if p.name.endswith(".alpha0"))
    closed_forms = ("direct", "inverse")

    def closure(self, q: Any, r: Any, R: Any, p: Named) -> Any:
        """Compute model 9's closure (eq. 3.26) with the angles of eq. 3.27."""
        return Argos9(self.length).closure(q, r, R, self._to_model9_parameters(p))

    def drawing(self, q: Any, r: Any, R: Any, p: Named) -> list[Line]:
        """Draw the robot like model 9."""
        return Argos9(self.length).drawing(q, r, R, self._to_model9_parameters(p))

    @staticmethod
    def _to_model9_parameters(p: Named) -> Named:
        """Model 9's parameters."""
        offsets = {f"chain{i + 1}.alpha0": p[f"chain{i + 1}"].alpha0 for i in range(3)}
        table = Argos9.parameters
        return Named(table.names, [offsets.get(row.name, row.nominal) for row in table])

    def widen(self, values: Mapping[str, float]) -> tuple[str, dict[str, float]]:
        """Widen to model 9 with right angles."""
        return "argos9", {**Argos9.parameters.mapping(Argos9.parameters.nominal), **values}
