"""What a model file describes, as one document."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Any

from parallel_cal.model.model import Model
from parallel_cal.model.region import IdentifiedRegion
from parallel_cal.model.shelf import list_plugins

STORED = (".log", ".gcode")  # what a controller printed or is sent, not what it reads


def export_command(model: Model, file: str | Path) -> str:
    """Return the command that writes the model in `file` for the controller from whose files it was
    made; empty if there is none, or none that it can be exported to.

    With --into, an export finds the touches that the model was fitted to; otherwise they are named.
    """
    for entry in model.history:
        name, files = str(entry.get("controller", "")), entry.get("files")
        if name in list_plugins("exporting.targets") and isinstance(files, list) and files:
            own = [word for path in files for word in ("--into", str(path))]
            if Path(str(files[0])).suffix.lower() in STORED:
                own = ["-o", name, *_name_touches(model)]
            return shlex.join(["parallel-cal", "export", str(file), "--to", name, *own])
    return ""


def _name_touches(model: Model) -> list[str]:
    """Return the option with the files of the touches that the last fit used; empty if the model
    has no probe."""
    fits = [step["dataset"] for step in model.history if isinstance(step.get("dataset"), dict)]
    files = fits[-1].get("files", []) if fits else []
    has_probe = any(sensor.name == "probe" for sensor in model.sensors)
    return [word for path in files for word in ("--touches", str(path)) if has_probe]


def summarise_model(model: Model) -> dict[str, Any]:
    """Return a JSON document about a model: its mechanism, class, parts and steps, in SI units."""
    region = IdentifiedRegion.of_model(model)
    steps = []
    for entry in model.history:
        words = " ".join(str(entry[k]) for k in ("step", "effect") if k in entry)
        steps.append(f"{words} (cause {entry['cause']})" if "cause" in entry else words)
    return {
        "mechanism": model.mechanism.name,
        "class": model.machine_class,
        "joints": list(model.joints),
        "parameters": len(model.table),
        "free": int((~model.fixed).sum()),
        "effects": [effect.name for effect in model.effects],
        "sensors": [sensor.name for sensor in model.sensors],
        "tolerances": dict(model.tolerances),
        "steps": steps,
        "region": None if region is None else region.document(),
    }
