"""The poses of a table on the robot, before the session imports it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from parallel_cal.base.documents import to_json_value
from parallel_cal.base.errors import ParallelCalError
from parallel_cal.identification.observations import observe
from parallel_cal.identification.predictions import predict_positions
from parallel_cal.reporting.figures import select_evenly
from parallel_cal.reporting.machine import draw_poses
from parallel_cal.reporting.recorded import describe_measurement
from parallel_cal.session.table_preview import read_samples

MAX_DRAWN_POSES = 400


def preview_samples(file: Path, folder: Path, columns: Mapping[str, Any]) -> dict[str, Any]:
    """Read a table as an import with these columns would, and draw its positions: the measured
    ones, and those of the model at the same joint readings (for touches and readings of sensors,
    only the latter). `error` says why it cannot be read."""
    try:
        model, data = read_samples(file, folder, columns)
        said = describe_measurement(model, data, observe(model, data))
        some = data.select(select_evenly(len(data), MAX_DRAWN_POSES))
        predicted = predict_positions(model, observe(model, some, doubts=""))
    except ParallelCalError as error:
        return {"error": str(error)}
    solved = np.isfinite(predicted).all(axis=1)
    has_position = some.measured[:, :3].any(axis=1)
    return {
        "error": "",
        "words": f"samples: {said['samples']}; measured: {said['device']}",
        "figure": to_json_value(draw_poses(model, some.r[has_position], predicted[solved])),
    }
