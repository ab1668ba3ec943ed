"""What the identification says of the model: parameters, blind spots, another model, origin."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

from parallel_cal.identification.prediction_errors import ERRORS
from parallel_cal.reporting import figures, spaces
from parallel_cal.reporting.markup import Cell, Document, Plot, facts, items, paragraph, table
from parallel_cal.reporting.readable import large, number, unit_of, with_unit


def parameters(document: Document, plot: Plot) -> str:
    """How far every free parameter moved, with its sigma."""
    moving = [p for p in document["parameters"].values() if not p["fixed"]]
    far = sum(abs(p["moved_tolerances"]) > figures.FAR for p in moving)
    note = (
        f"{len(moving)} free parameters; {far or 'none'} moved further than {figures.FAR:g} "
        "tolerances from nominal. Grey bars are not identified."
    )
    return paragraph(note, "note") + plot(figures.parameter_bars(document["parameters"]))


def combinations(document: Document) -> str:
    """Unidentifiable and weak combinations in words; the strongest correlations."""
    found = document["combinations"]
    pairs = [
        f"{' and '.join(row['parameters'])}: {row['value']:.4f}" for row in document["correlated"]
    ]
    lists = {
        "Not seen at all": [row["text"] for row in found["unidentifiable"]],
        "Known worse than the tolerances": [row["text"] for row in found["weak"]],
        "Hardly told apart (correlation)": pairs,
    }
    told = [f"<h3>{title}</h3>{items(texts)}" for title, texts in lists.items() if texts]
    all_seen = paragraph("The data see every combination of the free parameters well.", "none")
    return "".join(told) or all_seen


def against(document: Document, plot: Plot) -> str:
    """Two models side by side: errors, arrows, the parameters in which they differ."""
    found, residuals = document["against"], document["residuals"]
    names = ("this model", "the other")
    columns = {name: s["errors"] for name, s in zip(names, found["sides"], strict=True)}
    if any(v is not None for v in found["sides"][0]["noise"].values()):
        columns["noise alone"] = found["sides"][0]["noise"]
    pictures = "".join(
        _side(name, side, residuals, plot) for name, side in zip(names, found["sides"], strict=True)
    )
    rows = [_difference(row) for row in found["parameters"]]
    header = ("parameter", *names, "unit", "difference [tolerances]")
    return (
        paragraph("Both models as they stand, nothing fitted, on the same samples.", "note")
        + _errors(columns, document["provenance"]["joint_units"])
        + f'<div class="pair">{pictures}</div>'
        + (table(header, rows, "sortable") if rows else paragraph("All numbers are equal.", "none"))
    )


def _errors(columns: Mapping[str, Mapping[str, Any]], units: Mapping[str, str]) -> str:
    """Mean and rms of what was measured, one column each."""
    known = [
        (kind, key)
        for kind in ERRORS
        for key in (f"{kind}_mean", f"{kind}_rms")
        if any(c.get(key) is not None for c in columns.values())
    ]
    rows = [
        [
            key.replace("_", " error, "),
            *(with_unit(c.get(key), unit_of(kind, units)) for c in columns.values()),
        ]
        for kind, key in known
    ]
    return table(("", *columns), rows)


def _side(name: str, side: Mapping[str, Any], residuals: Mapping[str, Any], plot: Plot) -> str:
    effects = " + ".join(side["effects"]) or "no effects"
    about = f"{side['mechanism']}, {effects}, sha256 {side['model_sha256'][:12]}"
    drawn = spaces.side(side, residuals)
    scale, picture = ("", "") if drawn is None else (f", arrows × {drawn[1]:g}", plot(drawn[0]))
    caption = f"<figcaption><b>{escape(name)}</b> {escape(about + scale)}</figcaption>"
    return f"<figure>{caption}{picture}</figure>"


def _difference(row: Mapping[str, Any]) -> Sequence[Cell | str]:
    unit, factor = large(row["unit"])
    apart = row["difference_tolerances"]
    values = [number(v, factor, 6) for v in row["values"]]
    return [row["name"], *values, unit, Cell(number(apart), key=apart)]


def provenance(document: Document) -> str:
    """Hashes, versions, where noise figures come from, options; warnings."""
    p, found = document["provenance"], document["diagnosis"]
    data, chi2 = p["dataset"], found["chi2_per_dof"]
    noise = [f"{kind} from {source}" for kind, source in p["noise_from"].items()]
    low, high = chi2["band"]
    band = f"; {number(low)} to {number(high)} where the model is complete" if high else ""
    rows = {
        "Model": f"{p['mechanism']}, effects: {', '.join(p['effects']) or 'none'}",
        "Model, sha256": p["model_sha256"],
        "Data": f"{data['source']}, {data['samples']} samples, {p['dropped']} readings dropped",
        "Data, sha256": data["sha256"] or "none: not read from a recording",
        "Noise": f"{'; '.join(noise)}; judged by: {found['noise']['source']}",
        "chi2/dof": f"{number(chi2['baseline'])} now, {number(chi2['best'])} at best{band}",
        "Options": ", ".join(f"{key}={value}" for key, value in p["options"].items()),
        "parallel_cal": p["version"],
    }
    warned = items(dict.fromkeys(found["warnings"]))
    return facts(rows) + (f"<h3>Warnings</h3>{warned}" if warned else "")
