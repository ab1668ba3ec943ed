"""What a model file describes, as one document."""

from __future__ import annotations

from typing import Any

from parallel_cal.model.model import Model
from parallel_cal.model.region import IdentifiedRegion


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
