"""Measuring set-ups, one a file; the file's name is the set-up's name."""

from parallel_cal.model.shelf import list_plugins
from parallel_cal.model.shelf import load_sensor as load

__all__ = ["load", "names"]


def names() -> list[str]:
    """Return the names of all sensors; `load` takes one of these, or a Python path."""
    return list_plugins("sensors")
