"""What others read: the model for controllers, residuals for ROS tools."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from parallel_cal.base.errors import ParallelCalError
from parallel_cal.cli.arguments import Data, JointSigma, Json, ModelFile
from parallel_cal.cli.recordings import data_options
from parallel_cal.reporting import console

if TYPE_CHECKING:
    from parallel_cal.exporting.heights import BedHeights
    from parallel_cal.importing.touch_samples import Touches
    from parallel_cal.model.model import Model


def export(
    model: ModelFile,
    to: Annotated[
        str,
        typer.Option(
            "--to",
            metavar="TARGET[:option=value,...]",
            help="c, klipper, rrf, ... or your own's Python path",
        ),
    ],
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="folder to write into")
    ] = None,
    into: Annotated[
        list[Path] | None,
        typer.Option(help="edit the numbers in the controller's own file instead (repeat)"),
    ] = None,
    touches: Annotated[
        list[Path] | None,
        typer.Option(
            help="samples (.json) of the bed, to judge the firmware's heights by (repeat) "
            "[default: those that the model was fitted on]"
        ),
    ] = None,
    force: Annotated[
        bool, typer.Option("--force", help="write numbers that make heights at the touches worse")
    ] = False,
    as_json: Json = False,
) -> None:
    """Write the calibrated model for a controller: the robot alone, its effects in it."""
    from parallel_cal.exporting import export as exporting
    from parallel_cal.model.file.modelfile import read_model

    if (output is None) == (not into):
        raise typer.BadParameter("expected either -o FOLDER or --into FILE")
    robot = read_model(model)
    judged = _touches(robot, model, touches or [], bool(into))
    if into:
        done = exporting.export_into(robot, to, into, judged, force)
    else:
        done = exporting.export(robot, to, output or Path(), judged)
    files = [str(path) for path in done.paths]
    if as_json:
        document = {
            "loss": done.loss,
            "before": done.before,
            "heights": done.heights,
            "remarks": done.remarks,
        }
        return console.emit({"target": to, "files": files} | (document if done.loss else {}))
    console.say(f"written: {', '.join(files)}")
    if done.loss:
        console.say(f"lost by the firmware's fewer numbers: {_format_loss(done.loss)}")
    if done.before:
        console.say(f"with the numbers it had: {_format_loss(done.before)}")
    if done.heights:
        console.say(_heights(done.heights))
    for remark in done.remarks:
        console.say(f"- {remark}")


def _touches(model: Model, file: Path, given: list[Path], into: bool) -> Touches | None:
    """The touches that are given, else those that the model was fitted on where their files still
    are: as its history names them, from this folder or from the model's. None without any, which
    is said where numbers are replaced."""
    from parallel_cal.exporting.heights import why_not
    from parallel_cal.importing.touch_samples import touches_in
    from parallel_cal.recordings.loading import load_sessions

    if given:
        return touches_in(load_sessions(given, joints=model.joints), model.joints)
    steps = [step["dataset"] for step in model.history if isinstance(step.get("dataset"), dict)]
    if not into or why_not(model):
        return None
    if not steps:
        console.warn(
            [
                f"the heights of the bed were not compared: {file} was not fitted on touches. Give "
                "samples of the bed: --touches TOUCHES.json"
            ]
        )
        return None
    last = steps[-1]
    for folder in (Path(), file.parent):
        paths = [folder / name for name in last.get("files", [])]
        if paths and all(path.is_file() for path in paths):
            try:
                dataset = load_sessions(paths, joints=model.joints)
            except ParallelCalError:  # another file under that name
                continue
            if dataset.sha256 == last.get("sha256"):
                return touches_in(dataset, model.joints)
    console.warn(
        [
            f"whether the bed gets better is not known: the touches that {file} was fitted on "
            f"({last.get('source')}) are not here; give their samples: --touches TOUCHES.json"
        ]
    )
    return None


def _heights(heights: BedHeights) -> str:
    """`height at 109 touches by the firmware's formula, rms: 595.2 -> 17.1 um`."""
    before = "" if heights.before is None else f"{1e6 * heights.before:.1f} -> "
    return (
        f"height at {heights.touches} touches by the firmware's formula, rms: "
        f"{before}{1e6 * heights.after:.1f} um"
    )


def _format_loss(loss: Mapping[str, Any]) -> str:
    """`mean 12.3 um, max 40.1 um at x 42 y -42 z 0 mm (2000 poses)`."""
    units = {"position": ("um", 1e6), "orientation": ("urad", 1e6)}
    said = []
    for kind, (unit, many) in units.items():
        if f"{kind}_mean" in loss:
            mean, most = (f"{many * loss[f'{kind}_{of}']:.1f} {unit}" for of in ("mean", "max"))
            worst = zip("xyz", 1e3 * loss[f"{kind}_worst_at"], strict=True)
            at = " ".join(f"{axis} {value:.0f}" for axis, value in worst)
            said.append(f"mean {mean}, max {most} at {at} mm")
    if "line_mean" in loss:
        said.append(
            f"lines mean {1e6 * loss['line_mean']:.1f}, max {1e6 * loss['line_max']:.1f} um"
        )
    said = said or ["no pose is reached"]
    beyond = f", {loss['not_reached']} beyond its reach" if loss["not_reached"] else ""
    return f"{'; '.join(said)} ({loss['poses']} poses{beyond})"


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
    dataset, start = load_stamped(bag, options, console.progress, joints=judged.joints)
    found = compare(judged, dataset, joint_sigma)
    stamps = start + (1e9 * dataset.time).round().astype(int)
    write_residuals(found.residuals(dataset.numbers, stamps), output, arrow_scale)
    console.progress("", 1.0)
    console.warn(found.dataset.warnings)
    if as_json:
        topics = {ROOT + name: kind for name, kind in TOPICS.items()}
        return console.emit({"output": str(output), "samples": len(dataset), "topics": topics})
    console.say(f"written: {output}, residuals of {len(dataset)} samples below {ROOT}")
