"""One mechanism a file: the file name is the mechanism's public name."""

from parallel_cal.model.shelf import load_mechanism as load
from parallel_cal.model.shelf import shelf_names

__all__ = ["load", "names"]


def names() -> list[str]:
    """What is on this shelf; `load` takes one of these, or the Python path of your own."""
    return shelf_names("mechanisms")
