"""Which poses to measure next."""

from __future__ import annotations

import csv
import io
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from parallel_cal.base.files import write_atomically
from parallel_cal.cli.tables import POSITION, QUATERNION
from parallel_cal.model.file.modelfile import read_model
from parallel_cal.model.model import Model, Noise
from parallel_cal.model.words import describe
from parallel_cal.planning.indices import NAMES
from parallel_cal.planning.plan import Plan
from parallel_cal.planning.plan import plan as planned
from parallel_cal.reporting import console

ARCMIN = 60 * 180 / np.pi


def plan(model_file: Path, poses: int, output: Path | None, as_json: bool, **options: Any) -> None:
    """Plan, write the poses where wanted, show or emit the document."""
    model = with_noise(read_model(model_file), str(model_file))
    found = planned(model, poses, progress=console.progress, **options)
    console.progress("", 1.0)
    document = found.document()
    console.warn(found.warnings)
    if output is not None:
        write_atomically(output, as_file(found, output.suffix))
    if as_json:
        extra = {} if output is None else {"output": str(output)}
        return console.emit({**document, **extra})
    _show(found, document)
    if output is not None:
        console.say(f"{output}: {len(found)} poses")


def with_noise(model: Model, source: str) -> Model:
    """The model with typical noise where its file says nothing of joints or of the device."""
    from parallel_cal.recordings.simulate import stated_noise

    own, stated = model.noise, stated_noise(model)
    joint = stated.joint if own.joint is None else own.joint
    device = (own.position, own.orientation)
    if model.structure.channels and device == (None, None):
        return replace(model, noise=replace(own, joint=joint))  # measured without a pose device
    if own.joint is None or device == (None, None):
        # Of a device that states one of both, the other is taken for not measured.
        console.note(f"{source} states no noise of joints or device: typical instruments are taken")
    position, orientation = (
        (stated.position, stated.orientation) if device == (None, None) else device
    )
    return replace(model, noise=Noise(joint, position, orientation))


def as_file(found: Plan, suffix: str) -> str:
    """The poses as CSV (m, rad), or with everything else as YAML or JSON, by the file's name."""
    if suffix.lower() in (".yaml", ".yml", ".json"):
        import json

        # JSON is YAML.
        return json.dumps(console.plain(found.document()), indent=1) + "\n"
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow([*POSITION, *QUATERNION, *found.model.joints, *found.model.conditions])
    p = found.poses
    writer.writerows(np.hstack([p.position, p.quaternion, p.joints, found.a]).tolist())
    return out.getvalue()


def _show(found: Plan, document: dict[str, Any]) -> None:
    model = found.model
    units = model.mechanism.joint_units
    joints = [f"{name} [{unit}]" for name, unit in zip(model.joints, units, strict=True)]
    header = ("", "x [m]", "y [m]", "z [m]", "quaternion x y z w", *joints)
    console.table(
        header,
        [
            (str(i + 1), *(console.number(v, 1, 5) for v in row["position"]),
             console.vector(np.round(row["quaternion"], 5) + 0.0, 1, 5),
             *(console.number(v, 1, 5) for v in row["joints"]))
            for i, row in enumerate(document["poses"])
        ],
    )  # fmt: skip
    console.say("")
    columns = (document["indices"], document["random"])
    rows = [[words, *(_short(column[key]) for column in columns)] for key, words in NAMES.items()]
    expected = (document["expected"], document["random"]["expected"])
    rows += [
        ["expected position error at unseen poses, rms [um]", *_numbers(expected, "position", 1e6)],
        ["expected orientation error, rms [arcmin]", *_numbers(expected, "orientation", ARCMIN)],
    ]
    console.table(("", "planned", "random"), rows)
    _show_parameters(found, document["expected"]["parameters"])


def _show_parameters(found: Plan, parameters: dict[str, dict[str, Any]], worst: int = 5) -> None:
    """The parameters that will be known worst, in tolerances."""
    sigmas = {k: v["sigma_tolerances"] for k, v in parameters.items()}
    order = sorted(sigmas, key=lambda k: -(np.inf if sigmas[k] is None else sigmas[k]))
    told = [
        f"{describe(name, found.model.mechanism)} ({name}) {_short(sigmas[name])}"
        for name in order[:worst]
    ]
    console.say(f"known worst, sigma in tolerances: {'; '.join(told)}")


def _numbers(columns: tuple[dict[str, Any], ...], kind: str, factor: float) -> list[str]:
    return [console.number(column[f"{kind}_rms"], factor, 2) for column in columns]


def _short(value: float | None) -> str:
    return "-" if value is None else f"{value:.4g}"
