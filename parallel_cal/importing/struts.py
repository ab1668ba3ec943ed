"""Hexapods as LinuxCNC's genhexkins computes them: a joint is the length of a strut.

q_i = |r + R a_i - b_i|, with ends a on the platform and b on the base. Source: LinuxCNC
documentation, kins(9), "genhexkins".
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from parallel_cal.base.errors import ModelError
from parallel_cal.model.mechanism import Home, Mechanism
from parallel_cal.model.shelf import load_mechanism
from parallel_cal.recordings.recording import Array


@dataclass(frozen=True)
class Struts:
    """Ends of the struts on base and platform (6, 3) m, and their lengths (6,) when homed."""

    base: Array
    platform: Array
    homed: Array

    def joints(self, r: Array, R: Array) -> Array:
        ends = r[:, None] + np.einsum("nij,kj->nki", R, self.platform) - self.base
        return np.asarray(np.linalg.norm(ends, axis=2))

    def mechanism(self, lengths: Array) -> Mechanism:
        """Return the hexapod whose joint readings are the lengths of its struts.

        `lengths` (6,) m are about those at home, where the platform is parallel to the base.
        """
        ends = self.platform - self.base
        tall = np.mean(lengths**2 - (ends[:, :2] ** 2).sum(axis=1))
        if tall <= 0:
            raise ModelError(
                f"struts of {1e3 * lengths.mean():.4g} mm at home do not reach from the base to "
                "the platform: expected longer struts"
            )
        height = float(np.sqrt(tall) - ends[:, 2].mean())
        limits = (float(lengths.min()) / 2, float(self.homed.max()))
        found = load_mechanism(
            "stewart42",
            base=self.base.tolist(),
            platform=self.platform.tolist(),
            height=height,
            limits=limits,
        )
        zero = {f"leg{i}.L0": 0.0 for i in range(1, 7)}
        found.parameters = found.parameters.with_nominal(zero)
        position = np.array([[0.0, 0.0, height]])
        home = self.joints(position, np.eye(3)[None])[0]
        found.home = Home(tuple(map(float, home)), (0.0, 0.0, height))
        found.joint_limits = tuple((limits[0], float(top)) for top in self.homed)
        return found
