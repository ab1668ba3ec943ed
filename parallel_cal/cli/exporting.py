"""What others read: the model for controllers, residuals for ROS tools."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from parallel_cal.cli.arguments import Data, JointSigma, Json, ModelFile
from parallel_cal.cli.recordings import bag_progress, data_options
from parallel_cal.reporting import console


def export(
    model: ModelFile,
    to: Annotated[
        str,
        typer.Option(
            "--to",
            metavar="TARGET[:option=value,...]",
            help="c, table, ... or your own's Python path",
        ),
    ],
    output: Annotated[Path, typer.Option("-o", "--output", help="folder to write into")],
    as_json: Json = False,
) -> None:
    """Write the calibrated model for a controller: the robot alone, its effects in it."""
    from parallel_cal.exporting import export as exporting
    from parallel_cal.model.file.modelfile import read_model

    written = exporting.export(read_model(model), to, output)
    if as_json:
        return console.emit({"target": to, "files": [str(path) for path in written]})
    console.say(f"written: {', '.join(map(str, written))}")


def export_residuals(
    model: ModelFile,
    bag: Annotated[Path, typer.Argument(help="rosbag2 folder or file, or saved samples (.json)")],
    output: Annotated[Path, typer.Option("-o", "--output", help="MCAP file to write")],
    arrow_scale: Annotated[
        float, typer.Option(min=0.0, help="length of arrows over the residuals'")
    ] = 100.0,
    joint_sigma: JointSigma = None,
    data: Data = None,
    as_json: Json = False,
) -> None:
    """Write residuals as an MCAP for RViz, Foxglove and PlotJuggler, at the samples' times."""
    from parallel_cal.diagnosis.comparison import compare
    from parallel_cal.model.file.modelfile import read_model
    from parallel_cal.recordings.loading import load_stamped
    from parallel_cal.recordings.residuals import ROOT, TOPICS, write_residuals

    judged, options = read_model(model), data_options(data)
    dataset, start = load_stamped(bag, options, bag_progress, joints=judged.joints)
    found = compare(judged, dataset, joint_sigma)
    stamps = start + (1e9 * dataset.time).round().astype(int)
    write_residuals(found.residuals(dataset.numbers, stamps), output, arrow_scale)
    console.progress("", 1.0)
    console.warn(found.dataset.warnings)
    if as_json:
        topics = {ROOT + name: kind for name, kind in TOPICS.items()}
        return console.emit({"output": str(output), "samples": len(dataset), "topics": topics})
    console.say(f"written: {output}, residuals of {len(dataset)} samples below {ROOT}")
