"""Lines that leave swivelling pulleys: the anchor of a line is a wheel, not a point."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import casadi as ca
import numpy as np

from parallel_cal.effects._lines import find_strands, needs_lines, needs_point, shift_lines
from parallel_cal.mechanisms.cable import Cable
from parallel_cal.model.effect import Effect, Seen
from parallel_cal.model.mechanism import Mechanism
from parallel_cal.model.parameters import Named, Parameter


class PulleyRadius(Effect):
    """q_ideal = q - (L - L_home - |P - A| + |A|) / k for every line, k in m of line per unit of q.

    The line comes along the axis a, touches the pulley at the anchor A, runs over it by the angle
    beta and leaves to P. The pulley swivels about this axis, so that P lies in the pulley's plane.
    With z = (P - A) . a and the distance x of P from the axis: l^2 = x^2 + z^2 - 2 radius x,
    beta = atan2(x - radius, z) + atan2(radius, l) and L = l + radius beta.

    `radius` (m) is that of the groove plus half the line, the same for all pulleys. `axis` is the
    direction in {B} in which the line runs towards its pulley. By default it is that of the last
    coordinate that moves (z; y if P moves in x and y only), with the sign that points away from
    home: upwards for a high pulley, downwards for a low one. For a line that is steeper than 2 : 1
    at home, it is that of the first coordinate instead.
    """

    fixed = ("*.axis_?",)
    depends_on_class = False  # a dimension of the machine, not a fault of its making
    physics = "A line leaves its pulley at a point that moves with the platform."
    remedy = "keep the correction in the model, or let the line leave through a small eyelet"
    source = "Pott, Cable-driven parallel robots (2018); pulleys of 5-50 mm"
    lookalikes = ("spool_buildup", "line_flex", "encoder_gain", "line_sag")
    separated_by = "poses near an anchor and far from it, high and low, up to the workspace's edges"

    def parameters(self, mechanism: Mechanism) -> list[Parameter]:
        return [
            Parameter("radius", "m", 0.0, 10e-3, low=0.0, high=0.2, label="pulleys' radius"),
            *_list_axes(mechanism),
        ]

    def applies(self, mechanism: Mechanism) -> str:
        return needs_lines(mechanism) or needs_point(mechanism)

    def ideal(self, seen: Seen, e: Named, at: Named, mechanism: Mechanism) -> Seen:
        assert isinstance(mechanism, Cable)

        def excess(placed: Seen) -> list[Any]:
            strands = enumerate(find_strands(placed, mechanism), start=1)
            return [_detour(-s, e.radius, _find_axis(e, i)) for i, s in strands]

        return shift_lines(seen, mechanism, excess)


def _list_axes(mechanism: Mechanism) -> list[Parameter]:
    """Return the directions in which the lines come to their pulleys."""
    table = dict(zip(mechanism.parameters.names, mechanism.parameters.nominal, strict=True))
    return [
        Parameter(
            f"line{i}.axis_{axis}",
            "1",
            value,
            0.02,
            low=-1.0,
            high=1.0,
            label=f"{axis} of the direction in which the line comes",
        )
        for i in range(1, len(mechanism.joints) + 1)
        for axis, value in zip("xyz", _guess_axis(mechanism, table, i), strict=True)
    ]


def _guess_axis(mechanism: Mechanism, table: Mapping[str, float], line: int) -> list[float]:
    """Return the direction in which a line comes, so that its pulley turns it clearly at home."""
    first, *_, last = mechanism.moves
    anchor = np.array([table.get(f"line{line}.A_{axis}", 0.0) for axis in "xyz"])
    away = anchor - mechanism.home.position
    up = "xyz".index(last)
    steep = abs(away[up]) > 2 * np.linalg.norm(np.delete(away, up))
    axis = "xyz".index(first) if steep else up
    direction = [0.0, 0.0, 0.0]
    direction[axis] = -1.0 if away[axis] < 0 else 1.0
    return direction


def _find_axis(e: Named, line: int) -> Any:
    axis = e[f"line{line}"].vector("axis_x", "axis_y", "axis_z")
    return axis / ca.norm_2(axis)


def _detour(to_point: Any, radius: Any, axis: Any) -> Any:
    """Return by how much the line over the pulley is longer than the way to a point (m)."""
    z = ca.dot(to_point, axis)
    x = ca.norm_2(ca.cross(axis, to_point))
    way = ca.norm_2(to_point)
    free = ca.sqrt(way**2 - 2 * radius * x)
    wrapped = radius * (ca.atan2(x - radius, z) + ca.atan2(radius, free))
    return wrapped - 2 * radius * x / (free + way)  # no difference of two lengths: 0 at radius 0
