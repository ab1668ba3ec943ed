"""Configurations: joints and pose, the coordinates of the closure."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from parallel_cal.base.rotation import rotation_matrix, rotation_vector


@dataclass(frozen=True)
class Configuration:
    """N configurations: joints q (N, nq), position r (N, 3) in m and rotation R (N, 3, 3) of {P}
    in {B}. Without N it is one configuration. A part without N applies to all N."""

    q: np.ndarray
    r: np.ndarray
    R: np.ndarray

    @classmethod
    def from_rows(cls, rows: np.ndarray) -> Configuration:
        """Make views of rows (N, nq + 12) or (nq + 12,): q, r, and R row by row."""
        n = rows.shape[-1] - 12
        R = rows[..., n + 3 :].reshape(*rows.shape[:-1], 3, 3)
        return cls(rows[..., :n], rows[..., n : n + 3], R)

    @property
    def rows(self) -> np.ndarray:
        """Rows (N, nq + 12) or (nq + 12,), the input of a structure's functions."""
        parts = (self.q, self.r, self.R.reshape(*self.R.shape[:-2], 9))
        shape = np.broadcast_shapes(*(part.shape[:-1] for part in parts))
        return np.concatenate([np.broadcast_to(p, (*shape, p.shape[-1])) for p in parts], axis=-1)

    def apply_change(self, change: np.ndarray) -> Configuration:
        """Apply changes (N, nq + 6) of (q, r, w): R <- exp(w) R."""
        n = self.q.shape[-1]
        q, r, w = np.split(change, (n, n + 3), axis=-1)
        return Configuration(self.q + q, self.r + r, rotation_matrix(w) @ self.R)

    def change_from(self, other: Configuration) -> np.ndarray:
        """Compute the change (N, nq + 6) of (q, r, w) from `other` to this configuration."""
        turn = rotation_vector(self.R @ np.swapaxes(other.R, -1, -2))
        return np.concatenate([self.q - other.q, self.r - other.r, turn], axis=-1)
