"""Measuring set-ups, one a file; the file's name is the set-up's name."""

from parallel_cal.model.shelf import load_sensor as load
from parallel_cal.model.shelf import shelf_names

__all__ = ["load", "names"]


def names() -> list[str]:
    """What is on this shelf; `load` takes one of these, or the Python path of your own."""
    return shelf_names("sensors")
