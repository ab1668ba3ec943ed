"""Observability indices: how well measurements determine the parameters (5.3.9)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from parallel_cal.identification.thresholds import RELATIVE_RANK


@dataclass(frozen=True)
class Indices:
    """Observability indices of a set of poses, from the singular values s_1 >= ... >= s_m of its
    whitened Jacobian with columns in tolerances.

    `condition` and `parameter_rms` are good if small, all others if large.

    rank: number of determined directions; condition: s_1 / s_m (Mooring 91); borm_menq:
    (s_1 ... s_m)^(1/m) / sqrt(poses) (Borm 91); noise_amplification: s_m^2 / s_1 (Nahvi 96);
    log_det: 2 sum log s (D-optimality); parameter_rms: rms sigma of the parameters in tolerances.
    """

    rank: int
    parameters: int
    poses: int
    condition: float
    borm_menq: float
    noise_amplification: float
    log_det: float
    parameter_rms: float

    def document(self) -> dict[str, float | int | None]:
        """Indices for JSON: None if an index is infinite."""
        return {k: v if np.isfinite(v) else None for k, v in vars(self).items()}


def indices(J: np.ndarray, poses: int, rank: int | None = None) -> Indices:
    """Compute the indices of a whitened, tolerance-scaled Jacobian (n_rows, n_parameters).

    `rank` is the number of directions that count if the model has directions that no pose can
    determine (thesis: "if the model is for sure not redundant"); all by default.
    """
    m = J.shape[1]
    sizes = np.zeros(m)
    found = np.linalg.svd(J, compute_uv=False)
    sizes[: len(found)] = found
    seen = int(np.sum(sizes > RELATIVE_RANK * max(sizes[0], 1e-300))) if m else 0
    s = sizes[: m if rank is None else rank]
    if seen < len(s):  # some direction is not determined: the parameters are not, either
        return Indices(seen, m, poses, np.inf, 0.0, 0.0, -np.inf, np.inf)
    log_det = 2 * float(np.sum(np.log(s)))
    return Indices(
        rank=seen,
        parameters=m,
        poses=poses,
        condition=float(s[0] / s[-1]),
        borm_menq=float(np.exp(log_det / (2 * len(s))) / np.sqrt(poses)),
        noise_amplification=float(s[-1] ** 2 / s[0]),
        log_det=log_det,
        parameter_rms=float(np.sqrt(np.mean(1 / s**2))),
    )


def prediction_rms(covariance: np.ndarray, weight: np.ndarray) -> float:
    """Return the rms error of the predicted poses: sqrt trace(covariance weight), m.

    `weight` (n, n) is the mean of G^T G over the workspace, G the poses' derivatives in the
    parameters (prediction- or V-optimality: its square is the mean variance).
    """
    return float(np.sqrt(max(np.sum(covariance * weight), 0.0)))


NAMES: Mapping[str, str] = {
    "condition": "condition number (Mooring)",
    "borm_menq": "observability (Borm-Menq)",
    "noise_amplification": "noise amplification (Nahvi)",
    "log_det": "log det of information (D)",
    "parameter_rms": "sigma of parameters, rms, in tolerances",
}
