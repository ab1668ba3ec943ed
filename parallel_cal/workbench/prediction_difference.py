"""The predictions of two branches compared; computed in another process."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from parallel_cal.session.history import History


def compare_predictions(folder: Path, one: str, other: str) -> dict[str, Any]:
    """Draw the predicted positions of branch `other` minus those of branch `one`."""
    # Imported in the other process only: they take long to import.
    from parallel_cal.model.file.modelfile import read_model
    from parallel_cal.reporting.prediction_difference import draw_difference

    states = History(folder).compared([one, other])
    first, second = (read_model(folder / states[name].model) for name in (one, other))
    return draw_difference(first, second, one, other)
