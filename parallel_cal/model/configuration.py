"""Configurations: joints and pose, the coordinates of the closure."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from parallel_cal.base.rotation import rotation_matrix, rotation_vector

NO_PASSIVE: np.ndarray = np.empty(0)
NO_PASSIVE.setflags(write=False)


@dataclass(frozen=True)
class Configuration:
    """N configurations: joints q (N, nq), position r (N, 3) in m and rotation R (N, 3, 3) of {P}
    in {B}, and passive coordinates u (N, nu) of a mechanism that has some. Without N it is one
    configuration. A part without N applies to all N."""

    q: np.ndarray
    r: np.ndarray
    R: np.ndarray
    u: np.ndarray = field(default_factory=lambda: NO_PASSIVE)

    @classmethod
    def from_rows(cls, rows: np.ndarray, passive: int = 0) -> Configuration:
        """Make views of rows (N, nq + 12 + nu) or (nq + 12 + nu,): q, r, R row by row, and the
        `passive` = nu last ones, u."""
        n = rows.shape[-1] - 12 - passive
        R = rows[..., n + 3 : n + 12].reshape(*rows.shape[:-1], 3, 3)
        return cls(rows[..., :n], rows[..., n : n + 3], R, rows[..., n + 12 :])

    @property
    def rows(self) -> np.ndarray:
        """Rows (N, nq + 12 + nu) or (nq + 12 + nu,), the input of a structure's functions."""
        parts = (self.q, self.r, self.R.reshape(*self.R.shape[:-2], 9), self.u)
        shape = np.broadcast_shapes(*(part.shape[:-1] for part in parts))
        return np.concatenate([np.broadcast_to(p, (*shape, p.shape[-1])) for p in parts], axis=-1)

    def apply_change(self, change: np.ndarray) -> Configuration:
        """Apply changes (N, nq + 6 + nu) of (q, r, w, u): R <- exp(w) R."""
        n = self.q.shape[-1]
        q, r, w, u = np.split(change, (n, n + 3, n + 6), axis=-1)
        return Configuration(self.q + q, self.r + r, rotation_matrix(w) @ self.R, self.u + u)

    def change_from(self, other: Configuration) -> np.ndarray:
        """Compute the change (N, nq + 6 + nu) of (q, r, w, u) from `other` to this one."""
        turn = rotation_vector(self.R @ np.swapaxes(other.R, -1, -2))
        parts = (self.q - other.q, self.r - other.r, turn, self.u - other.u)
        shape = np.broadcast_shapes(*(part.shape[:-1] for part in parts))
        return np.concatenate([np.broadcast_to(p, (*shape, p.shape[-1])) for p in parts], axis=-1)
