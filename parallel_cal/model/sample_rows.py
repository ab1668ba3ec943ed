"""The measurement equations of a model on arrays of samples."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi as ca
import numpy as np

from parallel_cal.base.compiled import Batch, dense
from parallel_cal.base.rotation import compute_left_generators


class SampleRows:
    """(configuration, a, v) -> rows, d rows/d(q, r, w, u), d rows/dv of N samples.

    The closure of the ideal mechanism is evaluated at what effects and frames let it see,

        z = seen(q, r, R, u, v, a),   d phi/dv = d phi/dz dz/dv,

    so that its function is derived once for a mechanism, and each effect adds only its own. The
    rows of the closure are first, then the readings of the channels.

    Parameters
    ----------
    closure : Batch
        z -> phi, d phi/dz, of the ideal mechanism.
    given : sequence of casadi.SX
        Configuration (q, r, R9, u), conditions a and parameters v.
    n_joints : int
    seen : casadi.SX (nz,)
        What the closure sees at the measured pose.
    readings : casadi.Function or None
        (configuration, a, v) -> readings, d readings/d(q, r, w, u), d readings/dv.
    """

    def __init__(
        self,
        closure: Batch,
        given: Sequence[Any],
        n_joints: int,
        seen: Any,
        readings: ca.Function | None = None,
    ):
        configuration, _, v = given
        self._closure = closure
        self._readings = None if readings is None else Batch(readings)
        self._rotation = slice(n_joints + 3, n_joints + 12)
        self._n, self._n_inputs = configuration.numel(), configuration.numel() + v.numel()
        inputs = ca.vertcat(configuration, v)
        # Most of what the closure sees is what was measured, and the geometry as it is.
        moved = [k for k in range(seen.numel()) if not ca.is_equal(seen[k], inputs[k])]
        by = ca.jacobian(seen[moved], inputs)
        through = np.unique(np.array(by.sparsity().get_triplet()[1], dtype=int))
        self._kept = _list_runs(np.setdiff1d(np.arange(seen.numel()), moved))
        self._moved, self._through = moved, _list_runs(through)
        self._shape = len(through), len(moved)
        self._seen = Batch(dense("seen", given, (seen, by[:, through.tolist()])))

    def see(self, x: np.ndarray, a: np.ndarray, v: np.ndarray) -> np.ndarray:
        """q, r, R9, u and geometry as effects and frames let the closure see them: (N, nz)."""
        return self._seen(x, a, v)[0]

    def __call__(self, x: np.ndarray, a: np.ndarray, v: np.ndarray) -> list[np.ndarray]:
        """Each result (N, rows * columns) is stored column by column."""
        z, by_inputs = self._seen(x, a, v)
        phi, by_seen = self._closure(z)
        N, rows = phi.shape
        by_seen = by_seen.reshape(N, by_seen.shape[1] // rows, rows)
        J = by_seen
        if self._shape[1] or by_seen.shape[1] < self._n_inputs:
            J = np.zeros((N, self._n_inputs, rows))
            for kept in self._kept:
                J[:, kept] = by_seen[:, kept]
            more, end = by_inputs.reshape(N, *self._shape) @ by_seen[:, self._moved], 0
            for through in self._through:
                begin, end = end, end + through.stop - through.start
                J[:, through] += more[:, begin:end]
        by_entries = compute_left_generators(x[:, self._rotation].reshape(N, 3, 3))
        by_turn = by_entries.transpose(0, 2, 1) @ J[:, self._rotation]
        before, after = J[:, : self._rotation.start], J[:, self._rotation.stop : self._n]
        parts = [phi, np.concatenate([before, by_turn, after], axis=1), J[:, self._n :]]
        if self._readings is not None:
            readings, *slopes = self._readings(x, a, v)
            m = readings.shape[1]
            read = [readings, *(one.reshape(N, one.shape[1] // m, m) for one in slopes)]
            parts = [np.concatenate(pair, axis=-1) for pair in zip(parts, read, strict=True)]
        return [part.reshape(N, int(np.prod(part.shape[1:]))) for part in parts]


def _list_runs(numbers: np.ndarray) -> list[slice]:
    """Numbers that follow one another, as slices: arrays are much faster by these."""
    ends = np.flatnonzero(np.diff(numbers) > 1) + 1
    runs = np.split(numbers, ends) if len(numbers) else []
    return [slice(int(run[0]), int(run[-1]) + 1) for run in runs]
