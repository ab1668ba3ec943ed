"""A model as files for somebody else, by the name of a target."""

from __future__ import annotations

from inspect import signature
from pathlib import Path
from typing import Any

from parallel_cal.base.errors import ModelError
from parallel_cal.base.files import write_atomically
from parallel_cal.model.model import Model
from parallel_cal.model.shelf import load_module, own

SHELF = "exporting.targets"


def export(model: Model, target: str, folder: str | Path) -> list[Path]:
    """Write what `target` (`NAME[:option=value,...]`, a file on the shelf or at a Python path)
    makes of the robot alone, without the measuring device's errors; ModelError where it cannot.

    A target is a module with a function `files(model, option=default, ...) -> {name: text}`.
    """
    name, _, given = target.partition(":")
    module = load_module(SHELF, name)
    if not hasattr(module, "files"):
        raise ModelError(f"{name} is no target: it has no files(model)")
    made = own(name, module.files)(model.robot(), **_options(module.files, given))
    Path(folder).mkdir(parents=True, exist_ok=True)
    paths = [Path(folder) / file for file in made]
    for path, text in zip(paths, made.values(), strict=True):
        write_atomically(path, text)
    return paths


def _options(files: Any, given: str) -> dict[str, Any]:
    """`name=delta,poses=100` as keyword arguments, of the types of the function's defaults."""
    defaults = {k: p.default for k, p in list(signature(files).parameters.items())[1:]}
    options = {}
    for item in filter(None, given.split(",")):
        key, _, value = (part.strip() for part in item.partition("="))
        try:
            options[key] = type(defaults[key])(value)
        except (KeyError, ValueError):
            words = ", ".join(f"{k}={v}" for k, v in defaults.items()) or "none"
            raise ModelError(f"option '{item}': expected one of {words}") from None
    return options
