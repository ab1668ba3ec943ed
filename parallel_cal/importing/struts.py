"""Hexapods as LinuxCNC's genhexkins computes them: a joint is the length of a strut.

q_i = |r + R a_i - b_i|, with ends a on the platform and b on the base. Source: LinuxCNC
documentation, kins(9), "genhexkins".
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

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
