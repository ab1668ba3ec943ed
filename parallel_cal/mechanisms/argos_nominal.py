"""Argos as its controller sees it: everything at right angles, 3 encoder offsets (table 3.18)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from parallel_cal.mechanisms._argos import Argos
from parallel_cal.mechanisms.argos9 import Argos9
from parallel_cal.model.parameters import Named, ParameterTable


class ArgosNominal(Argos):
    """Motor axes and directions to the balls are perpendicular (eq. 3.27)."""

    parameters = ParameterTable(p for p in Argos9.parameters if p.name.endswith(".alpha0"))
    closed_forms = ("direct", "inverse")

    def closure(self, q: Any, r: Any, R: Any, p: Named) -> Any:
        """Model 9's closure (eq. 3.26) with the angles of eq. 3.27."""
        offsets = {f"chain{i + 1}.alpha0": p[f"chain{i + 1}"].alpha0 for i in range(3)}
        table = Argos9.parameters
        wide = Named(table.names, [offsets.get(row.name, row.nominal) for row in table])
        return Argos9(self.length).closure(q, r, R, wide)

    def widen(self, values: Mapping[str, float]) -> tuple[str, dict[str, float]]:
        """Model 9 with right angles."""
        return "argos9", {**Argos9.parameters.mapping(Argos9.parameters.nominal), **values}
