"""The command that diagnoses a model."""

from __future__ import annotations

from parallel_cal.cli.arguments import (
    Also,
    Bags,
    Data,
    Fitting,
    Json,
    ModelFile,
    Tested,
    with_options,
)
from parallel_cal.cli.calibration import read_model_and_data
from parallel_cal.reporting import console


@with_options
def diagnose(
    model: ModelFile,
    bags: Bags,
    *,
    effect: Tested = None,
    also: Also = None,
    options: Fitting,
    data: Data = None,
    as_json: Json = False,
) -> None:
    """Find the physical effect that the model lacks. The verdict states how certain this is, and
    what to measure next."""
    from parallel_cal.diagnosis import diagnose as diagnosis

    judged, dataset = read_model_and_data(model, bags, data)
    found = diagnosis.diagnose(
        judged,
        dataset,
        effects=effect or (),
        also=also or (),
        options=options,
        progress=console.progress,
    )
    console.progress("", 1.0)
    console.warn(found.best.fitted.warnings)
    if as_json:
        return console.emit(found.document())
    from parallel_cal.reporting import text

    console.say(text.show(found))
