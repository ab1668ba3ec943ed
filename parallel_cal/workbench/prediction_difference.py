"""The predictions of two branches compared; computed in another process."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from parallel_cal.base.errors import ParallelCalError


def compare_predictions(folder: Path, one: str, other: str) -> dict[str, Any]:
    """Draw the predicted positions of branch `other` minus those of branch `one`, under conditions
    of the session's samples."""
    # Imported in the other process only: they take long to import.
    from parallel_cal.identification.position_uncertainty import find_robot_conditions
    from parallel_cal.model.file.modelfile import read_model
    from parallel_cal.reporting.prediction_difference import draw_difference
    from parallel_cal.session.session import Session

    session = Session(folder)
    states = session.compared([one, other])
    first, second = (read_model(folder / states[name].model) for name in (one, other))
    recorded: Mapping[str, np.ndarray] = {}
    if session.recordings and (find_robot_conditions(first) or find_robot_conditions(second)):
        names = [*first.conditions, *second.conditions]
        # Without the recordings, conditions are neutral, as the caption then states.
        with suppress(ParallelCalError):
            recorded = session.conditions(names)
    return draw_difference(first, second, one, other, recorded)
