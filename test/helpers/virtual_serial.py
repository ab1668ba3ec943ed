"""Serial arms by plain homogeneous matrices, written out element by element (eqs 3.5 to 3.7)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from parallel_cal.virtual.robot import Array, Parameters, solve

# Table 3.7: name of the transformation and the joint that sits in it, if any.
SCARA = (("base", ""), ("link1", "R"), ("link2", "R"), ("link3", "P"), ("platform", ""))


def matrix(*rows: Sequence[ArrayLike]) -> Array:
    """A batch of 4x4 matrices from its sixteen elements, the last row being 0 0 0 1."""
    elements = [np.asarray(e, dtype=float) for row in (*rows, (0, 0, 0, 1)) for e in row]
    flat = np.stack(np.broadcast_arrays(*elements), -1)
    return flat.reshape(*flat.shape[:-1], 4, 4)


NUMBERS = "theta d a b alpha beta".split()


def link(
    theta: ArrayLike, d: ArrayLike, a: ArrayLike, b: ArrayLike, alpha: ArrayLike, beta: ArrayLike
) -> Array:
    """Rot(z, theta) Trans(z, d) Trans(x, a) Rot(x, alpha) Rot(y, beta), eq. 3.6 (figure 3.4).

    With beta = 0 it is Denavit and Hartenberg's (eq. 3.5a), with d = 0 Hayati's (eq. 3.5b). `b` is
    a shift along y beside a's, which the thesis does not have.
    """
    a, b = np.asarray(a, dtype=float), np.asarray(b, dtype=float)
    ct, st, ca, sa = np.cos(theta), np.sin(theta), np.cos(alpha), np.sin(alpha)
    cb, sb = np.cos(beta), np.sin(beta)
    screw = matrix(
        (ct, -st, 0, a * ct - b * st),
        (st, ct, 0, a * st + b * ct),
        (0, 0, 1, d),
    )
    first = matrix((1, 0, 0, 0), (0, ca, -sa, 0), (0, sa, ca, 0))
    second = matrix((cb, 0, sb, 0), (0, 1, 0, 0), (-sb, 0, cb, 0))
    return screw @ first @ second


class Serial:
    """A chain of eq. 3.6's transformations; revolute joints add to theta, prismatic ones to d."""

    def __init__(
        self,
        parameters: Parameters,
        links: Sequence[tuple[str, str]] = SCARA,
        home_joints: ArrayLike = (-0.7, 1.6, 0.0),
    ) -> None:
        self.parameters: Mapping[str, Any] = parameters
        self.links, self.home_joints = links, np.array(home_joints)

    def matrix(self, q: ArrayLike) -> Array:
        """The transformation from {B} to {P} (eq. 3.7), shape (..., 4, 4)."""
        q, whole, joint = np.asarray(q, dtype=float), np.eye(4), 0
        for name, kind in self.links:
            numbers = {k: self.parameters.get(f"{name}.{k}", 0.0) for k in NUMBERS}
            if kind:
                driven = {"R": "theta", "P": "d"}[kind]
                numbers[driven] = numbers[driven] + q[..., joint]
                joint += 1
            whole = whole @ link(**numbers)
        return whole

    def forward(self, q: ArrayLike, start: object = None) -> tuple[Array, Array]:
        """The pose (r, R) at joints `q`; a serial arm has one only."""
        whole = self.matrix(q)
        return whole[..., :3, 3], whole[..., :3, :3]

    def inverse(self, r: ArrayLike, start: ArrayLike | None = None) -> tuple[Array, Array, Array]:
        """Three joints that bring the origin of {P} to `r`, and the pose that follows."""
        r = np.asarray(r, dtype=float)
        q = np.asarray(self.home_joints if start is None else start, dtype=float)
        q = np.broadcast_to(q, r.shape)
        q = solve(lambda q: self.forward(q)[0] - r, q)
        return q, *self.forward(q)
