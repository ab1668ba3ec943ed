"""Hangprinters as their firmware computes them: lines from anchors, on spools whose radius grows.

Line i is l = |r - A_i| - |A_i| longer than at the origin, and its motor turns by 2 g a l / (R +
sqrt(R^2 - a Q l)), with the gear ratio g, the mechanical advantage a, the radius R at the origin,
and the build-up Q (m) of all lines on the spool together. Source: Duet documentation, "M666" and
"Configuring RepRapFirmware for a Hangprinter".
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from parallel_cal.base.errors import ModelError
from parallel_cal.model.model import Model, new_model
from parallel_cal.model.shelf import load_mechanism
from parallel_cal.recordings.recording import Array


@dataclass(frozen=True)
class Hangprinter:
    """Anchors (n, 3) m; radii (m), gears and advantages (n,) of the spools."""

    anchors: Array
    radii: Array
    gears: Array
    advantages: Array
    buildup: float

    @property
    def homed(self) -> Array:
        """The motors at the origin: zero."""
        return np.zeros(len(self.anchors))

    def joints(self, r: Array, R: Array | None = None) -> Array:
        """Return the motors (N, n) in rad for the end point at r (N, 3) in m."""
        away = np.linalg.norm(r[:, None] - self.anchors, axis=2)
        line = self.advantages * (away - np.linalg.norm(self.anchors, axis=1))
        with np.errstate(invalid="ignore"):
            left = np.sqrt(self.radii**2 - self.buildup * line)
        return np.asarray(2 * self.gears * line / (self.radii + left))

    def model(self) -> Model:
        """Return the cable robot with the effect spool_buildup.

        Lines whose spools have the same radius and advantage share the radius as a parameter.
        """
        if not self.anchors.any(axis=1).all():
            raise ModelError(
                "an anchor is at the origin, where readings are zero: its line has no length"
            )
        alike = [*dict.fromkeys(zip(self.radii, self.advantages, strict=True))]
        spools = [alike.index(p) + 1 for p in zip(self.radii, self.advantages, strict=True)]
        mechanism = load_mechanism(
            "cable",
            anchors=self.anchors.tolist(),
            advantages=self.advantages.tolist(),
            spools=spools,
        )
        nominal = {f"line{i + 1}.gear": float(g) for i, g in enumerate(self.gears)}
        nominal |= {f"spool{k}.R": float(r) for k, r in zip(spools, self.radii, strict=True)}
        mechanism.parameters = mechanism.parameters.with_nominal(nominal)
        return new_model(mechanism, {"spool_buildup.Q": self.buildup}, effects=["spool_buildup"])
