"""The goal of the calibration node that finds laws: runs in its worker and writes nothing."""

from __future__ import annotations

from collections.abc import Callable

from parallel_cal.base.errors import ParallelCalError
from parallel_cal.discovery.discovery import discover
from parallel_cal.discovery.in_session import list_effects
from parallel_cal.identification.options import FitOptions
from parallel_cal.model.file.modelfile import read_model
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.session.goals import Outcome


def find_laws(
    model_file: str, dataset: Dataset, options: FitOptions, tell: Callable[[str, float], None]
) -> Outcome:
    """Search laws in what a model file leaves of the samples; a failure is a message.

    The document is that of `parallel-cal discover --json`. Its key `effects` has the text of each
    proven law's effect file by the name of the effect.
    """
    try:
        tell("reading the model file", 0.0)
        found = discover(read_model(model_file), dataset, options=options, progress=tell)
    except ParallelCalError as error:
        return Outcome(False, str(error))
    document = found.document() | {"effects": list_effects(found.laws)}
    return Outcome(True, f"{found.verdict}: {found.summary}", document, verdict=found.verdict)
