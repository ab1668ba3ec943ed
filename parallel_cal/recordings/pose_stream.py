"""Clean measured poses: positions, unit quaternions, covariances, and what is measured."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np

from parallel_cal.base.float_fields import NEGATIVE_INT, UNCONVERTED, is_unconverted
from parallel_cal.recordings.recording import (
    COORDINATES,
    MAX_PLAUSIBLE_READING,
    Array,
    Bools,
    PoseStream,
    Raw,
)
from parallel_cal.recordings.sieve import Sieve

NOT_MEASURED = 1e3  # a larger variance means that the coordinate is not measured
NOT_GIVEN = 1e-24  # up to this, a variance states nothing: no device measures to 1e-12 m or rad


def clean_poses(
    raw: Raw, sieve: Sieve, measures: Sequence[str] | None, notes: list[str]
) -> PoseStream:
    """Return clean poses; the raw rows are (frame, position, quaternion or None, covariance)."""
    position = np.array([row[1] for row in raw.rows], float)
    quaternion = np.array([row[2] or (0.0, 0.0, 0.0, 1.0) for row in raw.rows], float)
    has_rotation = np.array([row[2] is not None for row in raw.rows])
    variance = [np.zeros(36) if row[3] is None else row[3] for row in raw.rows]
    covariance, measured = read_covariance(np.array(variance).reshape(-1, 6, 6))
    notes += _remove_impossible_correlations(covariance, raw.topic)
    measured[:, 3:] &= has_rotation[:, None]
    if measures is not None:
        measured &= np.isin(COORDINATES, measures)
    frames = np.array([row[0] for row in raw.rows])
    frame = Counter(frames[sieve.keep].tolist()).most_common(1)[0][0]
    sieve.drop(frames != frame, f"frame_id is not '{frame}' like the others'")
    _sieve_poses(sieve, position, quaternion, measured)
    if np.all(quaternion[measured[:, 3:].any(1)] == (0, 0, 0, 1)) and measured[:, 3:].any():
        notes.append(
            f"{raw.topic}: every orientation is exactly the identity; if the device "
            "measures positions only, state it (measures=x,y,z, PointStamped, or "
            "variances above 1e3)"
        )
    covariance[~measured] = np.nan
    np.swapaxes(covariance, 1, 2)[~measured] = np.nan
    keep = sieve.keep
    return PoseStream(
        raw.topic,
        frame,
        sieve.time[keep],
        position[keep],
        quaternion[keep],
        measured[keep],
        covariance[keep],
    )


def pose_values(raw: Raw) -> Array:
    """Return positions and quaternions (n, 7), which have one sign: that in which the largest
    component is positive."""
    position = np.array([row[1] for row in raw.rows], float)
    quaternion = np.array([row[2] or (0.0, 0.0, 0.0, 1.0) for row in raw.rows], float)
    largest = quaternion[:, np.argmax(np.abs(np.nan_to_num(quaternion)).sum(axis=0))]
    return np.hstack([position, quaternion * np.where(largest < 0, -1.0, 1.0)[:, None]])


def read_covariance(covariance: Array) -> tuple[Array, Bools]:
    """Return the covariance (n, 6, 6), NaN where not given, and what is measured (n, 6)."""
    covariance = 0.5 * (covariance + np.swapaxes(covariance, 1, 2))
    variance = np.diagonal(covariance, axis1=1, axis2=2)
    measured = ~(variance > NOT_MEASURED)
    unknown = ~(variance > NOT_GIVEN) | ~measured | ~np.isfinite(variance)
    covariance[unknown] = np.nan
    np.swapaxes(covariance, 1, 2)[unknown] = np.nan
    return covariance, measured


def _remove_impossible_correlations(covariance: Array, topic: str) -> list[str]:
    """Reduce matrices (n, 6, 6) that are not a covariance to their variances; return a warning."""
    sigma = np.sqrt(np.nan_to_num(np.diagonal(covariance, axis1=1, axis2=2)))
    sigma[sigma == 0.0] = 1.0
    with np.errstate(over="ignore"):
        correlation = covariance / (sigma[:, :, None] * sigma[:, None, :])
    correlation = np.clip(np.nan_to_num(correlation), -2.0, 2.0)
    correlated = np.flatnonzero(np.count_nonzero(correlation, axis=(1, 2)) > 6)
    least = np.linalg.eigvalsh(correlation[correlated])[:, 0]
    bad = correlated[least < -1e-6]
    if not len(bad):
        return []
    alone = np.isnan(covariance[bad]) | np.eye(6, dtype=bool)
    covariance[bad] = np.where(alone, covariance[bad], 0.0)
    return [
        f"{topic}: the covariance has a negative eigenvalue in {len(bad)} of "
        f"{len(covariance)} messages (first: message {bad[0]}); only its "
        "variances are used"
    ]


def _sieve_poses(sieve: Sieve, position: Array, quaternion: Array, measured: Bools) -> None:
    """Drop poses that are not finite or not a rotation; fill unmeasured parts with placeholders."""
    rotates = measured[:, 3:].any(axis=1)
    position[~measured[:, :3]] = 0.0
    quaternion[~rotates] = (0.0, 0.0, 0.0, 1.0)
    finite = np.isfinite(position).all(axis=1) & np.isfinite(quaternion).all(axis=1)
    norm = np.linalg.norm(
        np.clip(np.nan_to_num(quaternion, nan=1.0), -MAX_PLAUSIBLE_READING, MAX_PLAUSIBLE_READING),
        axis=1,
    )
    hint = (
        "If the device measures positions only, state it: measures=x,y,z, a "
        "PointStamped topic, or orientation variances above 1e3."
    )
    shown = np.hstack([position, quaternion])
    absurd = (np.abs(position) > MAX_PLAUSIBLE_READING).any(axis=1)
    sieve.drop(~measured.any(axis=1), "nothing measured (all variances above 1e3)")
    unconverted = is_unconverted(shown).any(axis=1)
    sieve.drop(unconverted, UNCONVERTED, "", shown)
    also = NEGATIVE_INT if unconverted.any() else ""
    sieve.drop(~finite, f"pose is not finite{also}", "" if also else hint, shown)
    sieve.drop(absurd, "position is beyond 1e9", "Expected metres.", shown)
    sieve.drop(norm < 1e-6, "quaternion is zero", hint, quaternion)
    sieve.drop(np.abs(norm - 1.0) > 0.05, "quaternion is not of unit length", hint, quaternion)
    quaternion /= np.maximum(norm, 1e-300)[:, None]
