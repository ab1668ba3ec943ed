"""Robots with struts as LinuxCNC computes them: a joint is the length of a strut.

- genhexkins: q_i = |r + R a_i - b_i|, with ends a on the platform and b on the base.
- pentakins: P_i = R' (b_i - r) is the end on the base, seen from the spindle. The other end rides
  on a ring about the spindle's axis, on its side: q_i = |(hypot(x, y) - radius_i, z - height_i)|.
  R = Ry(B) Rx(A): the spindle is never turned about itself.
- tripodkins: q_i = |r - b_i|, with b = (0, 0, 0), (Bx, 0, 0) and (Cx, Cy, 0). Of the two points
  with these lengths, forward kinematics takes the one above z = 0 after the start.

Sources: LinuxCNC documentation, kins(9), "genhexkins"; LinuxCNC/linuxcnc 5c41560ebb,
src/emc/kinematics, pentakins.c (InvKins) and tripodkins.c (kinematicsForward).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

import numpy as np

from parallel_cal.base.errors import ModelError
from parallel_cal.base.rotation import matrix_to_quaternion, rot_x, rot_y, rotation_vector
from parallel_cal.base.units import MM
from parallel_cal.importing.reach import shrink_workspace
from parallel_cal.model.mechanism import Home, Mechanism, Workspace
from parallel_cal.model.shelf import load_mechanism
from parallel_cal.recordings.recording import Array

CLOSED_M = 1e-6  # m; struts whose lengths differ by more do not meet


@dataclass(frozen=True)
class Struts(ABC):
    """Ends of the struts on the base (n, 3) m, and their lengths at the switches (n,) m.

    A motor's position is the length of its strut times `scale` (n,), counts per m, if it is known.
    A strut is then as long as its count says.
    """

    base: Array
    switches: Array
    scale: Array | None

    @property
    def counts(self) -> Array:
        """Return motor positions per m of a strut (n,)."""
        return np.ones(len(self.base)) if self.scale is None else self.scale

    @property
    def homed(self) -> Array:
        return self.switches * self.counts

    def joints(self, r: Array, R: Array) -> Array:
        return self.lengths(r, R) * self.counts

    @abstractmethod
    def lengths(self, r: Array, R: Array) -> Array:
        """Return the lengths (N, n) m of the struts."""

    @abstractmethod
    def mechanism(self, lengths: Array, limits: Array) -> Mechanism:
        """Return the robot whose joint readings are the lengths of its struts.

        `lengths` (n,) m are those at home. The default workspace shrinks until the struts reach its
        corners inside their `limits` (n, 2) m. ModelError if the struts do not meet at home.
        """

    def load(
        self, name: str, limits: Array, r: Array, R: Array | None = None, **options: Any
    ) -> Mechanism:
        """Return a mechanism of the shelf with these struts and its home at the pose r, R."""
        R = np.eye(3) if R is None else R
        stated = {} if self.scale is None else {"scale": self.scale.tolist()}
        found = load_mechanism(
            name,
            base=self.base.tolist(),
            limits=(float(limits[:, 0].min()), float(limits[:, 1].max())),
            switches=self.switches.tolist(),
            **stated,
            **options,
        )
        zero = {f"{leg}.L0": 0.0 for leg in found.joints}
        found.parameters = found.parameters.with_nominal(zero)
        drawn = np.array([*found.home.position, *found.home.rotation_vector])
        home = np.array([*r, *rotation_vector(R)])
        moved = (home - drawn)[found.controlled]
        box = Workspace(
            tuple(map(float, found.workspace.low + moved)),
            tuple(map(float, found.workspace.high + moved)),
        )
        at = self.lengths(r[None], R[None])[0]
        (x, y, z), (i, j, k, w) = map(float, r), map(float, matrix_to_quaternion(R))
        found.home = Home(tuple(map(float, at)), (x, y, z), (i, j, k, w))
        found.joint_limits = tuple((float(low), float(high)) for low, high in limits)
        found.workspace = shrink_workspace(
            box,
            home[found.controlled],
            lambda poses: self.lengths(*found.poses(poses)),
            limits,
        )
        return found


@dataclass(frozen=True)
class Hexapod(Struts):
    """genhexkins, with the struts' ends `platform` (6, 3) m."""

    platform: Array

    def lengths(self, r: Array, R: Array) -> Array:
        ends = r[:, None] + np.einsum("nij,kj->nki", R, self.platform) - self.base
        return np.asarray(np.linalg.norm(ends, axis=2))

    def mechanism(self, lengths: Array, limits: Array) -> Mechanism:
        """Return the hexapod; at home its platform is parallel to the base, at about `lengths`."""
        ends = self.platform - self.base
        tall = np.mean(lengths**2 - (ends[:, :2] ** 2).sum(axis=1))
        if tall <= 0:
            raise ModelError(
                f"struts of {1e3 * lengths.mean():.4g} mm do not reach from the base to the "
                "platform"
            )
        height = float(np.sqrt(tall) - ends[:, 2].mean())
        place, platform = np.array([0.0, 0.0, height]), self.platform.tolist()
        return self.load("stewart42", limits, place, platform=platform, height=height)


@dataclass(frozen=True)
class Pentapod(Struts):
    """pentakins, with the `radii` and the `heights` (5,) m of the rings on the spindle."""

    radii: Array
    heights: Array

    def lengths(self, r: Array, R: Array) -> Array:
        seen = np.einsum("nji,nkj->nki", R, self.base - r[:, None])
        out = np.hypot(seen[..., 0], seen[..., 1]) - self.radii
        return np.asarray(np.hypot(out, seen[..., 2] - self.heights))

    def mechanism(self, lengths: Array, limits: Array) -> Mechanism:
        """Return the pentapod. As in LinuxCNC, home is searched from X0 Y0 Z0 A0 B0; it is there if
        struts of these lengths do not meet."""
        from scipy.optimize import least_squares

        def pose(x: Array) -> tuple[Array, Array]:
            return x[:3], np.array(rot_y(float(x[4])) @ rot_x(float(x[3])))

        def missed(x: Array) -> Array:
            r, R = pose(x)
            return (self.lengths(r[None], R[None])[0] - lengths) / MM

        found = least_squares(missed, np.zeros(5), xtol=1e-15, ftol=1e-15, gtol=1e-15)
        meet = np.abs(found.fun).max() * MM < CLOSED_M
        r, R = pose(np.asarray(found.x) if meet else np.zeros(5))
        return self.load(
            "pentapod",
            limits,
            r,
            R,
            radius=self.radii.tolist(),
            heights=self.heights.tolist(),
            home=r.tolist(),
            retracted=0.0,
        )


@dataclass(frozen=True)
class Tripod(Struts):
    """tripodkins; only `Bx`, `Cx` and `Cy` of its base points (3, 3) differ from 0."""

    def lengths(self, r: Array, R: Array) -> Array:
        return np.asarray(np.linalg.norm(r[:, None] - self.base, axis=2))

    def mechanism(self, lengths: Array, limits: Array) -> Mechanism:
        """Return the tripod, with its end point above z = 0."""
        (_, b, c), square = self.base, lengths**2
        x = (square[0] - square[1] + b[0] ** 2) / (2 * b[0])
        y = (square[0] - square[2] + c @ c - 2 * c[0] * x) / (2 * c[1])
        if not square[0] > x**2 + y**2:
            raise ModelError(f"struts of {np.round(lengths / MM, 3).tolist()} mm are too short")
        home = np.array([x, y, np.sqrt(square[0] - x**2 - y**2)])
        return self.load("tripod_struts", limits, home, home=home.tolist(), retracted=0.0)
