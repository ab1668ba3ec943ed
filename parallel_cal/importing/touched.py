"""Touches on a plate as samples: joints at which the machine believed to touch."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from parallel_cal.base.errors import DatasetError
from parallel_cal.importing.deltas import MM, NAMES, Delta
from parallel_cal.importing.stated import Place, sha256
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.recordings.recording import Array, Dropped
from parallel_cal.recordings.samples import READING

PROBE = READING + "probe"
NO_SIZE = (
    "size: cannot_know: touches of a plate cannot tell the size: a printer too large by a "
    "hundredth touches alike; a printed length that is measured tells it"
)


def touches(
    delta: Delta,
    nozzle: ArrayLike,
    places: Sequence[Place],
    paths: Sequence[Path],
    step: ArrayLike,
    visits: Array | None = None,
    dropped: Sequence[Dropped] = (),
) -> Dataset:
    """Touches with the nozzle believed at (N, 3) m, each from a line of a file; `step` (m or rad)
    of a motor rounds its joint, equal `visits` are of one place."""
    at = np.array(nozzle, float).reshape(-1, 3)
    q = delta.joints(at)
    for k in np.flatnonzero(~np.isfinite(q).all(axis=1))[:1]:
        x, y, z = at[k] / MM
        point = f"x {x:.3f} y {y:.3f} z {z:.3f} mm"
        raise places[k].error("position", point, "a point within reach of the configured rods")
    return of_joints(q, np.zeros(len(q)), paths, step, visits, dropped)


def of_joints(
    q: Array,
    height: ArrayLike,
    paths: Sequence[Path],
    step: ArrayLike,
    visits: Array | None = None,
    dropped: Sequence[Dropped] = (),
    warnings: Sequence[str] = (),
) -> Dataset:
    """Touches at joints (N, 3), m or rad, where the tip is `height` (N,) m above the plate."""
    files = ", ".join(map(str, paths))
    if not len(q):
        raise DatasetError(f"{files}: no touches in there")
    same = None if visits is None else np.unique(visits, axis=0, return_inverse=True)[1].ravel()
    return Dataset.from_arrays(
        NAMES,
        q,
        np.zeros((len(q), 3)),
        measured=np.zeros(6, bool),
        joint_sigma=np.broadcast_to(step, 3) / 12**0.5,
        conditions={PROBE: height},
        pose_id=same,
        source=files,
        sha256=sha256(paths),
        dropped=tuple(dropped),
        warnings=(NO_SIZE, *warnings),
    )
