"""Heavy lines and chains that sag between anchor and platform: elastic catenaries."""

from __future__ import annotations

from typing import Any

import casadi as ca

from parallel_cal.effects._lines import (
    LINES,
    find_strands,
    find_tensions,
    find_up,
    has_redundant_lines,
    needs_tension,
    shift_lines,
)
from parallel_cal.model.effect import Effect, Seen
from parallel_cal.model.mechanism import Mechanism
from parallel_cal.model.parameters import Named, Parameter

MIN_TENSION = 0.1  # of the tension T; below it a line is slack and no catenary of this kind
ROUNDS = 5  # of the fixed point; each leaves about the line's strain of the error


class LineSag(Effect):
    """q_ideal = q - (L - L_home - |P - A| + |A|) / k for every line, k in m of line per unit of q.

    L is the unstretched length of the catenary from the anchor A to the end point P, and L_home is
    its value at home. A line has the weight w (N/m) and the axial stiffness EA (N). Its point s (m
    of unstretched line from the anchor) is at the horizontal distance x(s) from the anchor, and
    lower than the anchor by z(s):

    x(s) = H s / EA + H / w (asinh(V / H) - asinh((V - w s) / H)),
    z(s) = s (V - w s / 2) / EA + (sqrt(H^2 + V^2) - sqrt(H^2 + (V - w s)^2)) / w.

    The point s = L is P. H and V are the horizontal and the vertical force at the anchor. H is the
    horizontal force that a straight line with the tension t would have. The tensions follow from
    the equilibrium of the platform, W t = weight; the columns of W are the directions of the lines
    (as in `line_flex`).

    `sag` is (w / T)^2 (1/m^2). T is the pretension if there are more lines than degrees of freedom,
    and the weight of the platform if there are not. `load` is this weight over T, and `strain` is
    T / EA: two known constants. The weight of the lines that the platform carries is neglected.
    """

    fixed = ("load", "strain")
    physics = "A line sags under its own weight, so it is longer than the distance that it spans."
    remedy = "raise the tension, take lighter lines, or keep the correction in the model"
    source = "Irvine, Cable structures (1981); 3 m of chain of 3 N/m under 50 N: 4 mm longer"
    lookalikes = ("line_flex", "pulley_radius", "spool_buildup", "encoder_gain")
    separated_by = (
        "the same poses under two tensions, with long and short lines: the sag falls as 1/t^2"
    )

    def parameters(self, mechanism: Mechanism) -> list[Parameter]:
        # The square, because the length grows with it: its slope at no effect is not 0.
        label = "(weight of a metre of line / T)^2"
        load = 0.0 if has_redundant_lines(mechanism) else 1.0
        return [
            Parameter("sag", "1/m^2", 0.0, 1e-3, low=0.0, high=0.1, label=label),
            Parameter("load", "1", load, 0.5, low=0.0, label="weight of the platform / T"),
            Parameter("strain", "1", 0.0, 1e-3, low=0.0, high=20e-3, label="T / EA"),
        ]

    def applies(self, mechanism: Mechanism) -> str:
        return needs_tension(mechanism)

    def ideal(self, seen: Seen, e: Named, at: Named, mechanism: Mechanism) -> Seen:
        assert isinstance(mechanism, LINES)
        up = find_up(mechanism)

        def excess(placed: Seen) -> list[Any]:
            tensions = find_tensions(placed, mechanism, 1, e.load)
            found = []
            for strand, tension in zip(find_strands(placed, mechanism), tensions, strict=True):
                chord, height = ca.norm_2(strand), ca.dot(strand, up)
                t = ca.fmax(tension, MIN_TENSION)
                found.append(_slack(chord, height, t, e.sag, e.strain))
            return found

        return shift_lines(seen, mechanism, excess)


def _slack(chord: Any, height: Any, t: Any, sag: Any, strain: Any) -> Any:
    """Return by how much a catenary's unstretched length L exceeds its chord (m); t in units of T.

    An elastic catenary has the shape of an inextensible one whose span is shorter by H L / EA and
    lower by L V_mean / EA. With the span x and the height z, the inextensible one has the length
    sqrt(z^2 + (x sinh(u) / u)^2), u = w x / (2 H).
    """
    flat = chord**2 - height**2
    more: Any = 0
    z = height
    for _ in range(ROUNDS):
        length = chord + more
        shorter = 1 - t * strain * length / chord  # span over the horizontal distance
        u2 = sag * (chord * shorter / (2 * t)) ** 2
        mean = t * (z / chord) / shorter * _cosh(u2) / _sinhc(u2)
        z = height - strain * length * mean
        squares = z**2 - height**2 + flat * ((shorter * _sinhc(u2)) ** 2 - 1)
        more = squares / (ca.sqrt(chord**2 + squares) + chord)
    return more


def _sinhc(u2: Any) -> Any:
    """Return sinh(u) / u, given u^2: smooth at u = 0, exact to 1e-12 for u up to 1."""
    return _series(u2, (6, 20, 42, 72, 110, 156, 210))


def _cosh(u2: Any) -> Any:
    return _series(u2, (2, 12, 30, 56, 90, 132, 182))


def _series(x: Any, ratios: tuple[int, ...]) -> Any:
    """Return 1 + x / a (1 + x / b (1 + ...)) for the ratios a, b, ..."""
    value: Any = 1
    for ratio in reversed(ratios):
        value = 1 + x / ratio * value
    return value
