"""The command that plans the poses to measure."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from parallel_cal.base.documents import to_json_value
from parallel_cal.base.units import ARCMIN
from parallel_cal.cli.arguments import Json, ModelFile, with_options
from parallel_cal.planning.options import PlanOptions
from parallel_cal.reporting import console
from parallel_cal.reporting.readable import format_fixed, format_fixed_vector

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
    console.warn(found.warnings)
    if output is not None:
        write_atomically(output, format_plan(found, output.suffix))
    if as_json:
        extra = {} if output is None else {"output": str(output)}
        return console.emit({**document, **extra})
    _show(found, document)
    if output is not None:
        console.say(f"{output}: {len(found)} poses")


def format_plan(found: Plan, suffix: str) -> str:
    """Format the poses as CSV (m, rad), or the whole plan as YAML or JSON, by the file suffix."""
    import json

    if suffix.lower() in (".yaml", ".yml", ".json"):
        # JSON is YAML.
        return json.dumps(to_json_value(found.document()), indent=1) + "\n"
    return found.csv()


def _show(found: Plan, document: dict[str, Any]) -> None:
    import numpy as np

    from parallel_cal.planning.indices import NAMES

    model = found.model
    units = model.mechanism.joint_units
    joints = [f"{name} [{unit}]" for name, unit in zip(model.joints, units, strict=True)]
    header = ("", "x [m]", "y [m]", "z [m]", "quaternion x y z w", *joints)
    console.table(
        header,
        [
            (
                str(i + 1),
                *(format_fixed(v, 1, 5) for v in row["position"]),
                format_fixed_vector(np.round(row["quaternion"], 5) + 0.0, 1, 5),
                *(format_fixed(v, 1, 5) for v in row["joints"]),
            )
            for i, row in enumerate(document["poses"])
        ],
    )
    console.say("")
    columns = (document["indices"], document["random"])
    rows = [
        [words, *(_format_short(column[key]) for column in columns)] for key, words in NAMES.items()
    ]
    expected = (document["expected"], document["random"]["expected"])
    rows += [
        ["expected position error, rms [um]", *_numbers(expected, "position", 1e6)],
        [
            "expected orientation error, rms [arcmin]",
            *_numbers(expected, "orientation", 1 / ARCMIN),
        ],
    ]
    console.table(("", "planned", "random"), rows)
    from parallel_cal.model.words import describe

    sigmas = {k: v["sigma_tolerances"] for k, v in document["expected"]["parameters"].items()}
    order = sorted(sigmas, key=lambda k: -(math.inf if sigmas[k] is None else sigmas[k]))
    shown = [
        f"{describe(name, found.model.table)} ({name}) {_format_short(sigmas[name])}"
        for name in order[:5]
    ]
    console.say(f"least certain parameters, sigma in tolerances: {'; '.join(shown)}")


def _numbers(columns: tuple[dict[str, Any], ...], kind: str, factor: float) -> list[str]:
    return [format_fixed(column[f"{kind}_rms"], factor, 2) for column in columns]


def _format_short(value: float | None) -> str:
    return "-" if value is None else f"{value:.4g}"
