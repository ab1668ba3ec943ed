"""Lines that leave swivelling pulleys: the anchor of a line is a wheel, not a point."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import casadi as ca
import numpy as np

from parallel_cal.effects._lines import (
    find_home,
    find_strands,
    find_wound_struts,
    needs_lines,
    needs_point,
    shift_lines,
)
from parallel_cal.effects._struts import needs_struts
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

    The lines of a cable robot, or struts with a spool as their stated drive: lines from the foot A
    to the head P, whose reading is a length (k = 1).

    `radius` (m) is that of the groove plus half the line, one for all pulleys. `axis`, times
    `sense`, is the direction in {B} in which the line runs towards its pulley. By default it is
    that of the last coordinate that moves (z; y if P moves in x and y only), with the sign that
    points away from home: upwards for a high pulley, downwards for a low one. For a line that is
    steeper than 2 : 1 at home, it is that of the first coordinate instead. `sense` is 1, or -1 if
    the lines come from the other side; `scan` tries both.
    """

    fixed = ("*.axis_?", "sense")
    added_later = ("sense",)
    depends_on_class = False  # a dimension of the machine, not a fault of its making
    physics = "A line leaves its pulley at a point that moves with the platform."
    remedy = "keep the correction in the model, or let the line leave through a small eyelet"
    source = "Pott, Cable-driven parallel robots (2018); pulleys of 5-50 mm"
    lookalikes = ("spool_buildup", "line_flex", "encoder_gain", "line_sag")
    separated_by = "poses near an anchor and far from it, high and low, up to the workspace's edges"

    def parameters(self, mechanism: Mechanism) -> list[Parameter]:
        sense = "1, or -1 if the lines come from the other side"
        return [
            Parameter("radius", "m", 0.0, 10e-3, low=0.0, high=0.2, label="pulleys' radius"),
            Parameter("sense", "1", 1.0, 1.0, low=-1.0, high=1.0, label=sense),
            *_list_axes(mechanism),
        ]

    def applies(self, mechanism: Mechanism) -> str:
        if _name_lines(mechanism):
            return ""
        why = needs_lines(mechanism) or needs_point(mechanism)
        if needs_struts(mechanism):
            return why
        return f"{why}, unless the model file states spools that let out line as drives of struts"

    def scan(
        self, mechanism: Mechanism, recorded: Mapping[str, Any]
    ) -> Iterator[Mapping[str, float]]:
        """Return both sides from which the lines may come."""
        yield {"sense": 1.0}
        yield {"sense": -1.0}

    def ideal(self, seen: Seen, e: Named, at: Named, mechanism: Mechanism) -> Seen:
        lines = _name_lines(mechanism)

        def excess(placed: Seen) -> list[Any]:
            more = [0.0] * len(mechanism.joints)
            for i, way in _find_ways(placed, mechanism).items():
                more[i] = _detour(way, e.radius, e.sense * _find_axis(e[lines[i]]))
            return more

        return shift_lines(seen, mechanism, excess)


def _name_lines(mechanism: Mechanism) -> dict[int, str]:
    """Return how parameters call the lines that may leave a pulley, by the number of the joint."""
    if isinstance(mechanism, Cable):
        return (
            {}
            if needs_lines(mechanism)
            else {i: f"line{i + 1}" for i in range(len(mechanism.joints))}
        )
    return {i: mechanism.joints[i] for i in find_wound_struts(mechanism)}


def _find_ways(seen: Seen, mechanism: Mechanism) -> dict[int, Any]:
    """Return the vectors in {B}, (3, 1) m, from the anchor of each line to its end, by joint."""
    if isinstance(mechanism, Cable):
        return {i: -strand for i, strand in enumerate(find_strands(seen, mechanism))}
    struts = mechanism.struts(seen.r, seen.R, seen.p)
    return {i: struts[i][1] - struts[i][0] for i in find_wound_struts(mechanism)}


def _list_axes(mechanism: Mechanism) -> list[Parameter]:
    """Return the directions in which the lines come to their pulleys."""
    names, p = _name_lines(mechanism), mechanism.parameters
    r, R = find_home(mechanism)
    at_home = Seen(ca.DM(mechanism.home.joints), r, R, Named(p.names, ca.DM(p.nominal)))
    return [
        Parameter(
            f"{names[i]}.axis_{axis}",
            "1",
            value,
            0.02,
            low=-1.0,
            high=1.0,
            label=f"{axis} of the direction in which the line comes",
        )
        for i, way in _find_ways(at_home, mechanism).items()
        for axis, value in zip("xyz", _guess_axis(mechanism, -np.array(way).ravel()), strict=True)
    ]


def _guess_axis(mechanism: Mechanism, away: np.ndarray) -> list[float]:
    """Return the direction in which a line comes, so that its pulley turns it clearly at home;
    `away` (3,) m is the way from its end to its anchor there."""
    first, *_, last = [axis for axis in mechanism.moves if axis in "xyz"]
    up = "xyz".index(last)
    steep = abs(away[up]) > 2 * np.linalg.norm(np.delete(away, up))
    axis = "xyz".index(first) if steep else up
    direction = [0.0, 0.0, 0.0]
    direction[axis] = -1.0 if away[axis] < 0 else 1.0
    return direction


def _find_axis(own: Named) -> Any:
    axis = own.vector("axis_x", "axis_y", "axis_z")
    return axis / ca.norm_2(axis)


def _detour(to_point: Any, radius: Any, axis: Any) -> Any:
    """Return by how much the line over the pulley is longer than the way to a point (m)."""
    z = ca.dot(to_point, axis)
    x = ca.norm_2(ca.cross(axis, to_point))
    way = ca.norm_2(to_point)
    free = ca.sqrt(way**2 - 2 * radius * x)
    wrapped = radius * (ca.atan2(x - radius, z) + ca.atan2(radius, free))
    return wrapped - 2 * radius * x / (free + way)  # no difference of two lengths: 0 at radius 0
