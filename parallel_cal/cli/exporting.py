"""Commands that export the model for controllers and residuals for ROS tools."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from parallel_cal.base.errors import ParallelCalError
from parallel_cal.cli.arguments import Data, JointSigma, Json, ModelFile
from parallel_cal.cli.recordings import data_options
from parallel_cal.reporting import console

if TYPE_CHECKING:
    from parallel_cal.exporting.bed_fit import Movement
    from parallel_cal.exporting.heights import BedHeights
    from parallel_cal.importing.touch_samples import Touches
    from parallel_cal.model.model import Model
    from parallel_cal.recordings.dataset import Dataset

Target = Annotated[
    str,
    typer.Option(
        "--to",
        metavar="TARGET[:option=value,...]",
        help="c, klipper, rrf, ... or the Python path of your own target",
    ),
]
Folder = Annotated[
    Path | None,
    typer.Option(
        "-o",
        "--output",
        help="folder to write to; the name of the file if the target writes one, such as "
        "robot.urdf",
    ),
]
Into = Annotated[
    list[Path] | None,
    typer.Option(
        help="instead of -o: change the parameters in this existing controller file; may be "
        "given several times"
    ),
]
TouchFiles = Annotated[
    list[Path] | None,
    typer.Option(
        help="recorded touches of the bed (.json), at which the height error of the firmware's "
        "model is computed; may be given several times [default: those that the model was "
        "fitted to]"
    ),
]
Force = Annotated[
    bool,
    typer.Option(
        "--force",
        help="write the file even if it is refused. It is refused if the height error at the "
        "touches rises, or if printed parts would change by more than 0.5 mm in x or y "
        "although no measurement covers x and y",
    ),
]


def export(
    model: ModelFile,
    to: Target,
    output: Folder = None,
    into: Into = None,
    touches: TouchFiles = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Write the calibrated model for a controller."""
    from parallel_cal.exporting import export as exporting
    from parallel_cal.model.file.modelfile import read_model

    if (output is None) == (not into):
        raise typer.BadParameter("expected either -o FOLDER (or FILE) or --into FILE")
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
            "movement": done.movement,
            "remarks": done.remarks,
        }
        document = document if done.loss else {"remarks": done.remarks} if done.remarks else {}
        return console.emit({"target": to, "files": files} | document)
    console.say(f"written: {', '.join(files)}")
    # Touches alone do not determine the model's x and y: a difference from them says nothing.
    if done.movement is None or done.movement.measured:
        if done.loss:
            words = _format_loss(done.loss)
            console.say(f"error that the firmware's simpler model leaves: {words}")
        if done.before:
            console.say(f"error with the previous numbers: {_format_loss(done.before)}")
        if done.before and done.loss and {"without_frame"} <= done.before.keys() & done.loss.keys():
            console.say(_format_frame(done.before["without_frame"], done.loss["without_frame"]))
    if done.heights:
        console.say(_heights(done.heights))
    if done.movement:
        console.say(_format_movement(done.movement))
    for remark in done.remarks:
        console.say(f"- {remark}")


def _touches(model: Model, file: Path, given: list[Path], into: bool) -> Touches | None:
    """Load the given touches, or those that the model was fitted to if their files still exist.

    The history of the model names these files, relative to the working folder or to the model's
    folder. Samples that the last fit excluded are excluded here, too. Without touches the result
    is None, with a warning if numbers are to be replaced.
    """
    from parallel_cal.exporting.heights import why_not
    from parallel_cal.identification.given_model import last_fit_to
    from parallel_cal.importing.touch_samples import touches_in
    from parallel_cal.recordings.loading import load_sessions

    steps = [step for step in model.history if isinstance(step.get("dataset"), dict)]
    last = steps[-1]["dataset"] if steps else {}

    def select_fitted(dataset: Dataset) -> Touches:
        if fit := last_fit_to(model, dataset):
            dataset = dataset.excluding(fit.get("excluded", []), "from the fit")
        return touches_in(dataset, model.joints)

    if given:
        return select_fitted(load_sessions(given, mechanism=model.mechanism))
    if not into or why_not(model):
        return None
    if not steps:
        console.warn(
            [
                f"the heights of the bed were not compared: {file} was not fitted to touches. Give "
                "samples of the bed: --touches TOUCHES.json"
            ]
        )
        return None
    for folder in (Path(), file.parent):
        paths = [folder / name for name in last.get("files", [])]
        if paths and all(path.is_file() for path in paths):
            try:
                dataset = load_sessions(paths, mechanism=model.mechanism)
            except ParallelCalError:  # another file under that name
                continue
            if last_fit_to(model, dataset):
                return select_fitted(dataset)
    console.warn(
        [
            f"the effect on the bed was not checked: the touches that {file} was fitted to "
            f"({last.get('source')}) were not found; give their samples: --touches TOUCHES.json"
        ]
    )
    return None


def _heights(heights: BedHeights) -> str:
    """Format `rms height error at 109 touches by the firmware's formula: 595.2 -> 17.1 um`."""
    before = "" if heights.before is None else f"{1e6 * heights.before:.1f} -> "
    words = (
        f"rms height error at {heights.touches} touches by the firmware's formula: "
        f"{before}{1e6 * heights.after:.1f} um"
    )
    if heights.excluded:
        numbers, plural = ", ".join(map(str, heights.excluded)), "s"[: len(heights.excluded) > 1]
        words += f", without sample{plural} {numbers} (excluded from the fit)"
    if heights.held_out is not None:
        words += "; at touches that this fit of the firmware's parameters did not use: "
        words += f"{1e6 * heights.held_out:.1f} um"
    return words


def _format_movement(movement: Movement) -> str:
    """Format how far x and y move, next to how well they are known."""
    moved = (
        "at the same motor positions, x and y over the bed move by at most "
        f"{1e3 * movement.largest:.2f} mm. Without a common shift and turn of the whole bed it is "
        f"{1e3 * movement.shape:.2f} mm."
    )
    source = "The model knows x and y"
    if movement.measured:
        known = (
            "The measurements of x and y show all of this motion but "
            f"{1e3 * movement.unsupported:.2f} mm."
        )
    else:
        known = "No measurement shows whether this is right."
        source = "From its tolerances and the touches, the model knows x and y"
    if movement.sigma is not None:
        known += f" {source} to {1e3 * movement.sigma:.2f} mm (1 sigma)."
    return f"{moved} {known}"


def _format_loss(loss: Mapping[str, Any]) -> str:
    """Format `mean 12.3 um, max 40.1 um at x 42 y -42 z 0 mm (2000 poses)`."""
    places = {
        "position": lambda at: f"{_format_axes('', 1e3 * at, 0)} mm",
        "orientation": lambda at: f"{_format_axes('r', 180 / math.pi * at, 1)} deg",
    }
    parts = [
        f"{words} at {places[kind](loss[f'{kind}_worst_at'])}"
        for kind, words in _format_sizes(loss).items()
    ]
    if "line_mean" in loss:
        parts.append(
            f"lines mean {1e6 * loss['line_mean']:.1f}, max {1e6 * loss['line_max']:.1f} um"
        )
    parts = parts or ["no pose is reachable"]
    beyond = f", {loss['not_reached']} not reachable" if loss["not_reached"] else ""
    return f"{'; '.join(parts)} ({loss['poses']} poses{beyond})"


def _format_sizes(loss: Mapping[str, Any]) -> dict[str, str]:
    """Format `mean 12.3 um, max 40.1 um` of each kind that the robot controls."""
    units = {"position": "um", "orientation": "urad"}
    return {
        kind: f"mean {1e6 * loss[f'{kind}_mean']:.1f} {unit}, max {1e6 * loss[f'{kind}_max']:.1f} "
        f"{unit}"
        for kind, unit in units.items()
        if f"{kind}_mean" in loss
    }


def _format_axes(prefix: str, values: Any, digits: int) -> str:
    """Format `x 42 y -42 z 0`."""
    rounded = values.round(digits) + 0.0  # no -0
    return " ".join(
        f"{prefix}{axis} {value:.{digits}f}" for axis, value in zip("xyz", rounded, strict=True)
    )


def _format_frame(before: Mapping[str, Any], after: Mapping[str, Any]) -> str:
    """Format the errors without frames, and where the frame of the previous numbers was."""
    shift = _format_axes("", 1e3 * before["shift"], 3)
    turn = _format_axes("r", 1e3 * before["turn"], 3)
    old, new = ("; ".join(_format_sizes(loss).values()) for loss in (before, after))
    return (
        f"the frame of the previous numbers was off by {shift} mm, {turn} mrad; without this rigid "
        f"motion the error with the previous numbers is {old}, with the new numbers {new}"
    )


def export_residuals(
    model: ModelFile,
    bag: Annotated[Path, typer.Argument(help="rosbag2 folder or file, or saved samples (.json)")],
    output: Annotated[Path, typer.Option("-o", "--output", help="MCAP file to write")],
    arrow_scale: Annotated[
        float, typer.Option(min=0.0, help="magnification of the arrows")
    ] = 100.0,
    joint_sigma: JointSigma = None,
    data: Data = None,
    as_json: Json = False,
) -> None:
    """Write the residuals as a recording (MCAP). RViz, Foxglove and PlotJuggler show it, at the
    times of the samples."""
    from parallel_cal.diagnosis.comparison import compare
    from parallel_cal.model.file.modelfile import read_model
    from parallel_cal.recordings.loading import load_stamped
    from parallel_cal.recordings.residuals import ROOT, TOPICS, write_residuals

    judged, options = read_model(model), data_options(data)
    dataset, start = load_stamped(bag, options, console.progress, mechanism=judged.mechanism)
    found = compare(judged, dataset, joint_sigma)
    stamps = start + (1e9 * dataset.time).round().astype(int)
    write_residuals(found.residuals(dataset.numbers, stamps), output, arrow_scale)
    console.progress("", 1.0)
    console.warn(found.dataset.warnings)
    if as_json:
        topics = {ROOT + name: kind for name, kind in TOPICS.items()}
        return console.emit({"output": str(output), "samples": len(dataset), "topics": topics})
    console.say(f"written: {output}, residuals of {len(dataset)} samples, topics under {ROOT}")
