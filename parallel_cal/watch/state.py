"""The file in which a watch continues from day to day."""

from __future__ import annotations

import json
from dataclasses import fields, replace
from itertools import count
from pathlib import Path

from parallel_cal.base.documents import to_json_value
from parallel_cal.base.errors import DatasetError
from parallel_cal.base.files import MEGABYTE, read_text, write_atomically
from parallel_cal.model.file.modelfile import model_hash
from parallel_cal.model.model import Model
from parallel_cal.watch.visit import Visit
from parallel_cal.watch.watch import Point, Watch

STATE_VERSION = 1
MAX_STATE_MB = 256


def write_state(watch: Watch, path: Path) -> Path | None:
    """Replace the state file in one step. That of another model is kept beside it: its name is
    returned; else None."""
    kept = None
    if path.exists() and read_state(path, watch.model) is None:
        names = (path.with_name(f"{path.stem}.{k}{path.suffix}") for k in count(1))
        kept = path.rename(next(name for name in names if not name.exists()))
    document = {
        "parallel_cal_watch": STATE_VERSION,
        "model": model_hash(watch.model),
        "false_alarm_days": watch.false_alarm_days,
        "trend": [to_json_value(point) for point in watch.trend],
        "visits": [to_json_value(visit.document()) for visit in watch.visits],
    }
    write_atomically(path, json.dumps(document) + "\n")
    return kept


def read_state(path: Path, model: Model) -> Watch | None:
    """Read a state file; None if it is of another model.

    Raises
    ------
    DatasetError
        If the file is damaged or of another version.
    """
    try:
        document = json.loads(read_text(path, MAX_STATE_MB * MEGABYTE))
        version = document["parallel_cal_watch"]
        if version != STATE_VERSION:
            raise DatasetError(
                f"{path} has version {version}, expected {STATE_VERSION}. Remove it to start anew"
            )
        if document["model"] != model_hash(model):
            return None
        return Watch(
            model,
            float(document["false_alarm_days"]),
            tuple(Visit.from_document(one) for one in document["visits"]),
            tuple(
                Point(**{f.name: one[f.name] for f in fields(Point)}) for one in document["trend"]
            ),
        )
    except (KeyError, TypeError, ValueError, RecursionError) as error:
        raise DatasetError(
            f"{path} is not the state of a watch ({type(error).__name__}: {error}). Remove it to "
            "start anew"
        ) from None


def continue_watch(path: Path, model: Model, false_alarm_days: float) -> tuple[Watch, bool]:
    """Continue the watch of a file, or start one; and whether the file was of another model."""
    before = read_state(path, model) if path.exists() else None
    if before is None:
        return Watch(model, false_alarm_days), path.exists()
    return replace(before, false_alarm_days=false_alarm_days), False
