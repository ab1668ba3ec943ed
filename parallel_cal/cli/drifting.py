"""The command that estimates how fast a robot drifts, and until when its model can be trusted."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from parallel_cal.base.errors import DatasetError, ParallelCalError
from parallel_cal.cli.arguments import Data, Details, Json, ModelFile, OptionalOut
from parallel_cal.cli.recordings import data_options
from parallel_cal.cli.watching import Times, match_times, read_time
from parallel_cal.reporting import console

if TYPE_CHECKING:
    from parallel_cal.identification.drift_estimate import Session
    from parallel_cal.identification.drift_rate import DriftRate
    from parallel_cal.model.model import Model

Recordings = Annotated[
    list[Path],
    typer.Argument(
        help="recordings of the robot at different times, with that of its last calibration"
    ),
]
FleetFolder = Annotated[
    Path | None,
    typer.Option(
        metavar="FOLDER",
        help="results of parallel-cal fleet for such robots: one recording is then enough",
    ),
]
LimitUm = Annotated[
    float | None,
    typer.Option(
        min=0,
        help="largest rms position error (um) that you accept [default: 1.41 times the "
        "validation error, where the drift is as large as the error of the calibration]",
    ),
]
LimitArcmin = Annotated[
    float | None,
    typer.Option(min=0, help="largest rms orientation error (arcmin) that you accept"),
]


def drift(
    model: ModelFile,
    recordings: Recordings,
    time: Times = None,
    fleet: FleetFolder = None,
    limit_um: LimitUm = None,
    limit_arcmin: LimitArcmin = None,
    output: OptionalOut = None,
    data: Data = None,
    details: Details = False,
    as_json: Json = False,
) -> None:
    """Say until when a calibration can be trusted.

    It estimates how fast the robot drifts, from recordings with measured poses at different times.
    With -o the model states it."""
    from parallel_cal.base.units import ERROR_UNITS
    from parallel_cal.identification.age import find_calibration, predict_age
    from parallel_cal.identification.drift_estimate import estimate_drift
    from parallel_cal.model.file.modelfile import model_hash, read_model, replace_model
    from parallel_cal.reporting.age import (
        describe_rate,
        describe_sessions,
        describe_trusts,
        document_age,
    )

    robot = read_model(model)
    last = find_calibration(robot)
    prior = None if fleet is None else _read_fleet(fleet)
    sessions, calibrated = _read_sessions(robot, recordings, time, data, details, last.hashes)
    console.progress("weighing how the sessions differ", 0.9)
    rate = estimate_drift(sessions, robot, prior)
    stated = {"position": limit_um, "orientation": limit_arcmin}
    limits = {kind: v / ERROR_UNITS[kind][1] for kind, v in stated.items() if v is not None}
    age = predict_age(robot, rate, calibrated, last.errors, limits)
    console.progress("", 1.0)
    written: dict[str, Any] = {}
    if output is not None:
        aged = replace(robot, history=(*robot.history, age.entry()))
        replace_model(aged, output)
        written = {"output": str(output), "hash": model_hash(aged)}
    if as_json:
        return console.emit(document_age(age) | written)
    console.show(
        [
            describe_rate(rate),
            f"from {describe_sessions(rate)}",
            *(f"trusted: {words}" for words in describe_trusts(age)),
        ]
    )
    if written:
        console.say(f"written: {output} (sha256 {written['hash'][:12]})")


def _read_sessions(
    robot: Model,
    recordings: list[Path],
    times: list[str] | None,
    data: list[str] | None,
    details: bool,
    calibration: frozenset[str],
) -> tuple[list[Session], float]:
    """Fit each recording, and find when the last of those of the calibration was made."""
    from parallel_cal.identification.drift_estimate import Session
    from parallel_cal.recordings.joining import fingerprint
    from parallel_cal.recordings.loading import load_stamped

    stated = match_times(times, recordings)
    options, found, calibrated = data_options(data), list[Session](), list[float]()
    for k, path in enumerate(recordings):
        console.progress(f"fitting {path.name}", 0.9 * k / len(recordings))
        dataset, stamp = load_stamped(path, options, mechanism=robot.mechanism)
        console.warn(dataset.warnings, brief=not details)
        when = read_time(path, dataset, stamp, stated[k])
        found.append(Session.of(robot, dataset, when))
        if (dataset.sha256 or fingerprint(dataset)) in calibration:
            calibrated.append(when)
    if not calibrated:
        raise DatasetError(
            "none of the recordings is that of the last fit of the model, so its age is not known: "
            "give this recording, too"
        )
    return sorted(found, key=lambda one: one.time), max(calibrated)


def _read_fleet(folder: Path) -> DriftRate:
    """Read how fast the robots of a fleet drift."""
    import json

    from parallel_cal.base.files import read_text
    from parallel_cal.identification.drift_rate import DriftRate

    file = folder / "fleet.json"
    try:
        document = json.loads(read_text(file))["drift"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ParallelCalError(
            f"--fleet {folder}: {file.name} cannot be read ({error}): expected a folder that "
            "parallel-cal fleet -o wrote"
        ) from None
    if document is None:
        raise ParallelCalError(
            f"--fleet {folder}: no robot of this fleet has two recordings at known times, so it "
            "shows no drift"
        )
    return DriftRate.from_document(document)
