"""The command that diagnoses a model."""

from __future__ import annotations

from parallel_cal.cli.arguments import (
    Also,
    Bags,
    Data,
    Details,
    FittingOrUpdating,
    Json,
    ModelFile,
    Tested,
    with_options,
)
from parallel_cal.cli.calibration import Given, list_options, read_model_and_data
from parallel_cal.reporting import console


@with_options
def diagnose(
    model: ModelFile,
    bags: Bags,
    *,
    effect: Tested = None,
    also: Also = None,
    options: FittingOrUpdating,
    data: Data = None,
    details: Details = False,
    as_json: Json = False,
) -> None:
    """Find the physical effect that the model lacks. The verdict states how certain this is, and
    what to measure next."""
    from parallel_cal.diagnosis import diagnose as diagnosis
    from parallel_cal.model.summary import export_command

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
    console.warn(found.best.fitted.warnings, brief=not details)
    if as_json:
        return console.emit(found.document())
    from parallel_cal.reporting.results import describe
    from parallel_cal.reporting.summary import list_step, summarize, summary_table

    console.show(describe(found), list_options(details))
    given = Given(model, bags, data, options.update)
    # The last calibration is the prior of its update, and stays.
    better = f"{model.stem}_updated.yaml" if options.update else "better.yaml"
    files = {"BETTER.yaml": better, "REFITTED.yaml": "refitted.yaml"}
    # The proposed commands exclude samples themselves.
    kept = given.without_exclusions
    lines = kept.fill(summarize(found), found.model, files)
    label = "then:" if found.next_steps else "next:"
    # A model that effects or a fit without a sample will replace is not one to use.
    is_last = not (found.effects or found.knocked)
    following = ""
    if is_last and judged.covariance is None:
        reason = "fit the model: the diagnosis only compared fits, and wrote none"
        following = f"{reason}: parallel-cal fit MODEL RECORDING -o better.yaml"
    elif is_last and (command := export_command(found.model, model)):
        following = command
    elif not found.next_steps:
        following = "parallel-cal report MODEL RECORDING -o report.html"
    if following:
        lines += given.fill(list_step(label, following), found.model)
    console.show([summary_table(lines)])
