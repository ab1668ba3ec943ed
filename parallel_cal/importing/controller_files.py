"""Read the samples that a controller stored, and the model with which it moves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from inspect import signature
from pathlib import Path
from typing import Any

from parallel_cal.base.errors import DatasetError
from parallel_cal.model.machine_class import DEFAULT_CLASS
from parallel_cal.model.model import Model
from parallel_cal.model.shelf import list_plugins, load_module, wrap_plugin_function
from parallel_cal.recordings.dataset import Dataset

SHELF = "importing.importers"
NO_SAMPLES = (
    "the files of {} hold no samples. Touches of the bed: write X, Y and Z (mm) of each into a "
    "table, `import touches TABLE.csv CONFIGURATION`. Poses that a device measured: `import table` "
    "or `import-csv`"
)


@dataclass(frozen=True)
class ConfiguredRobot:
    """A machine as its controller is configured, and what the configuration does not state.

    `formula` is the Delta (importing/deltas.py) as which the controller computes it; None if it is
    another machine.
    """

    model: Model
    remarks: tuple[str, ...] = ()
    formula: Any = None


def samples(kind: str, paths: Sequence[Path], **options: Any) -> Dataset:
    """Read the samples in a controller's files; DatasetError names file, line and field."""
    read = getattr(load_module(SHELF, kind, DatasetError), "samples", None)
    if read is None:
        raise DatasetError(NO_SAMPLES.format(kind))
    takes = [str(p.replace(annotation=p.empty)) for p in [*signature(read).parameters.values()][1:]]
    try:
        signature(read).bind(paths, **options)
    except TypeError as error:
        raise DatasetError(f"{kind}: {error}; its options: {', '.join(takes) or 'none'}") from None
    return wrap_plugin_function(kind, read)(paths, **options)  # type: ignore[no-any-return]


def configured(paths: Sequence[Path]) -> ConfiguredRobot:
    """Return the model of a configured machine.

    The file's suffix identifies the controller. An importer that has `recognizes` asks the file's
    text, too, and comes before those that have not. The model has the `MACHINE_CLASS` of the
    importer, and its history names controller and files.
    """
    modules = {name: load_module(SHELF, name) for name in list_plugins(SHELF)}
    kinds = {n: m.CONFIGURATION for n, m in modules.items() if hasattr(m, "CONFIGURATION")}
    for name in sorted(kinds, key=lambda name: not hasattr(modules[name], "recognizes")):
        recognizes = getattr(modules[name], "recognizes", lambda path: True)
        if paths[0].suffix in kinds[name] and recognizes(paths[0]):
            found: ConfiguredRobot = modules[name].configured(paths)
            machine_class = getattr(modules[name], "MACHINE_CLASS", DEFAULT_CLASS)
            origin = {"step": "new", "controller": name, "files": [str(path) for path in paths]}
            model = replace(found.model, machine_class=machine_class, history=(origin,))
            return replace(found, model=model)
    endings = {n: " or ".join(end or "no suffix" for end in ends) for n, ends in kinds.items()}
    known = "; ".join(f"{ending} ({name})" for name, ending in endings.items())
    raise DatasetError(
        f"{paths[0]}: not a configuration that can be read; expected {known}; or .urdf, .xml "
        "(MJCF) or .sdf"
    )
