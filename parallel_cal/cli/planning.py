"""The command that plans the poses to measure."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from parallel_cal.base.documents import to_json_value
from parallel_cal.cli.arguments import Details, Json, ModelFile, with_options
from parallel_cal.cli.calibration import list_options
from parallel_cal.planning.options import PlanOptions
from parallel_cal.reporting import console
from parallel_cal.reporting.blocks import Detail

if TYPE_CHECKING:
    from parallel_cal.planning.plan import Plan


@with_options
def plan(
    model: ModelFile,
    *,
    poses: Annotated[int, typer.Option(min=1, help="number of poses to measure")],
    options: PlanOptions,
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", help="file for the poses (.csv) or the whole plan (.yaml)"),
    ] = None,
    details: Details = False,
    as_json: Json = False,
) -> None:
    """Choose the poses to measure. Compare the expected error of the calibrated robot with the
    expected error after a calibration at random poses."""
    from parallel_cal.base.files import write_atomically
    from parallel_cal.model.file.modelfile import read_model
    from parallel_cal.planning import plan as planning
    from parallel_cal.recordings.simulate import with_noise

    own = read_model(model)
    known = with_noise(own)
    if known.noise != own.noise and not own.structure.channels:
        console.note(
            f"{model} states no noise of the joints or the device: typical values are assumed"
        )
    found = planning.plan(known, poses, options, console.progress)
    console.progress("", 1.0)
    document = found.document()
    console.warn(found.warnings, brief=not details)
    if output is not None:
        write_atomically(output, format_plan(found, output.suffix))
    if as_json:
        extra = {} if output is None else {"output": str(output)}
        return console.emit({**document, **extra})
    from parallel_cal.cli import plans

    table = plans.describe_poses(found, document)
    shown = Detail(table) if output else table  # the file has them
    console.show([shown, *plans.describe_plan(found, document)], list_options(details))
    if output is not None:
        console.say(f"{output}: {len(found)} poses")
    # Touches that do not determine all parameters leave the others to the tolerances.
    sigmas = [one["sigma_tolerances"] for one in document["expected"]["parameters"].values()]
    relies = options.prior or (bool(own.structure.channels) and None in sigmas)
    how = " --update" if options.update else " --prior" if relies else ""
    fit = f"measure these poses, then parallel-cal fit {shlex.quote(str(model))} RECORDING{how}"
    fit += " -o FILE"
    if options.update:
        fit += "; fit after every few poses, and stop as soon as it says that it is decided"
    following = fit if output else "the same command with -o FILE, which writes the poses"
    console.show([plans.summarize_plan(found, document, following)])


def format_plan(found: Plan, suffix: str) -> str:
    """Format the poses as CSV (m, rad), or the whole plan as YAML or JSON, by the file suffix."""
    import json

    if suffix.lower() in (".yaml", ".yml", ".json"):
        # JSON is YAML.
        return json.dumps(to_json_value(found.document()), indent=1) + "\n"
    return found.csv()
