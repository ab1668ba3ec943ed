"""The poses of a table on the robot, before the session imports it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from parallel_cal.base.documents import to_json_value
from parallel_cal.base.errors import ParallelCalError
from parallel_cal.identification.observations import observe
from parallel_cal.identification.predictions import predict_positions
from parallel_cal.reporting.figures import select_evenly
from parallel_cal.reporting.machine import draw_poses
from parallel_cal.reporting.recorded import describe_measurement
from parallel_cal.session.table_preview import read_samples

MAX_DRAWN_POSES = 400
MIN_POINTS_OF_FRAME = 4  # three define a rotation; with one more, a misfit can be seen


def preview_samples(file: Path, folder: Path, columns: Mapping[str, Any]) -> dict[str, Any]:
    """Read a table as an import with these columns would, and draw its positions on the robot: the
    measured ones, and those of the model at the same joint readings (for touches and readings of
    sensors, only the latter). `error` says why it cannot be read.

    The device may stand anywhere: its positions are moved as one rigid body to where they fit those
    of the model best, and the words say how much they then differ. They differ by some mm where a
    reflector is not at the origin of the platform; a wrong unit or column shows as more.
    """
    try:
        model, data = read_samples(file, folder, columns)
        said = describe_measurement(model, data, observe(model, data))
        some = data.select(select_evenly(len(data), MAX_DRAWN_POSES))
        predicted = predict_positions(model, observe(model, some, doubts=""))
    except ParallelCalError as error:
        return {"error": str(error)}
    solved = np.isfinite(predicted).all(axis=1)
    has_position = some.measured[:, :3].any(axis=1)
    words, places = f"samples: {said['samples']}; measured: {said['device']}", some.r[has_position]
    both = solved & has_position
    if both.sum() >= MIN_POINTS_OF_FRAME and some.measured[has_position, :3].all():
        here, there = some.r[both].mean(axis=0), predicted[both].mean(axis=0)
        turn, _ = Rotation.align_vectors(predicted[both] - there, some.r[both] - here)
        away = np.linalg.norm(predicted[both] - there - turn.apply(some.r[both] - here), axis=1)
        places = turn.apply(places - here) + there
        words += (
            ". Drawn where the measured positions fit those of the model best, as one body: they "
            f"differ by {1e3 * np.sqrt((away**2).mean()):.3g} mm rms"
        )
    return {
        "error": "",
        "words": words,
        "figure": to_json_value(draw_poses(model, places, predicted[solved])),
    }
