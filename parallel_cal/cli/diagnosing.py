"""The command that diagnoses a model."""

from __future__ import annotations

import shlex

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
from parallel_cal.cli.calibration import (
    command_line,
    list_options,
    read_model_and_data,
    write_program,
)
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
    from parallel_cal.reporting.readable import COMMAND
    from parallel_cal.reporting.results import describe
    from parallel_cal.reporting.summary import Line, name_files, summarize, summary_table

    console.show(describe(found), list_options(details))
    # The proposed commands exclude samples themselves.
    reading = [f"--data={item}" for item in data or [] if not item.startswith("exclude=")]
    updates = ["--update"] if options.update else []
    reading += updates
    names = {
        "parallel-cal": write_program(found.model),
        "MODEL": shlex.quote(str(model)),
        "RECORDING": shlex.join([*map(str, bags), *reading]),
        # The last calibration is the prior of its update, and stays.
        "BETTER.yaml": f"{model.stem}_updated.yaml" if updates else "better.yaml",
        "REFITTED.yaml": "refitted.yaml",
    }
    lines = [name_files(line, names) for line in summarize(found)]
    label = "then:" if found.next_steps else "next:"
    # A model that effects or a fit without a sample will replace is not one to use.
    is_last = not (found.effects or found.knocked)
    if is_last and judged.covariance is None:
        command = command_line(["fit", model], found.model, bags, data, "-o", "better.yaml")
        lines.append(Line(label, "fit the model: the diagnosis only compared fits, and wrote none"))
        lines.append(Line("", command, COMMAND))
    elif is_last and (command := export_command(found.model, model)):
        lines.append(Line(label, command, COMMAND))
    elif not found.next_steps:
        words = *updates, "-o", "report.html"
        command = command_line(["report", model], found.model, bags, data, *words)
        lines.append(Line("next:", command, COMMAND))
    console.show([summary_table(lines)])
