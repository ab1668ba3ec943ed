"""Hexapods as LinuxCNC's genhexkins computes them: a joint is the length of a strut.

q_i = |r + R a_i - b_i|, with ends a on the platform and b on the base. Source: LinuxCNC
documentation, kins(9), "genhexkins".
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from parallel_cal.base.errors import ModelError
from parallel_cal.importing.reach import shrink_workspace
from parallel_cal.model.mechanism import Home, Mechanism
from parallel_cal.model.shelf import load_mechanism
from parallel_cal.recordings.recording import Array


@dataclass(frozen=True)
class Struts:
    """Ends of the struts on base and platform (6, 3) m, and their lengths at the switches (6,) m.

    A motor's position is the length of its strut times `scale` (6,), counts per m, if it is known.
    A strut is then as long as its count says.
    """

    base: Array
    platform: Array
    switches: Array
    scale: Array | None = None

    @property
    def counts(self) -> Array:
        """Return motor positions per m of a strut (6,)."""
        return np.ones(6) if self.scale is None else self.scale

    @property
    def homed(self) -> Array:
        return self.switches * self.counts

    def joints(self, r: Array, R: Array) -> Array:
        return self.lengths(r, R) * self.counts

    def lengths(self, r: Array, R: Array) -> Array:
        """Return the lengths (N, 6) m of the struts."""
        ends = r[:, None] + np.einsum("nij,kj->nki", R, self.platform) - self.base
        return np.asarray(np.linalg.norm(ends, axis=2))

    def mechanism(self, lengths: Array, limits: Array) -> Mechanism:
        """Return the hexapod whose joint readings are the lengths of its struts.

        `lengths` (6,) m are about those at home, where the platform is parallel to the base. The
        default workspace shrinks until the struts reach its corners inside their `limits` (6, 2) m.
        """
        ends = self.platform - self.base
        tall = np.mean(lengths**2 - (ends[:, :2] ** 2).sum(axis=1))
        if tall <= 0:
            raise ModelError(
                f"struts of {1e3 * lengths.mean():.4g} mm do not reach from the base to the "
                "platform"
            )
        height = float(np.sqrt(tall) - ends[:, 2].mean())
        stated = {} if self.scale is None else {"scale": self.scale.tolist()}
        found = load_mechanism(
            "stewart42",
            base=self.base.tolist(),
            platform=self.platform.tolist(),
            height=height,
            limits=(float(limits[:, 0].min()), float(limits[:, 1].max())),
            switches=self.switches.tolist(),
            **stated,
        )
        zero = {f"leg{i}.L0": 0.0 for i in range(1, 7)}
        found.parameters = found.parameters.with_nominal(zero)
        position = np.array([[0.0, 0.0, height]])
        home = self.lengths(position, np.eye(3)[None])[0]
        found.home = Home(tuple(map(float, home)), (0.0, 0.0, height))
        found.joint_limits = tuple((float(low), float(high)) for low, high in limits)
        found.workspace = shrink_workspace(
            found.workspace,
            np.array([*found.home.position, 0.0, 0.0, 0.0]),
            lambda poses: self.lengths(*found.poses(poses)),
            limits,
        )
        return found
