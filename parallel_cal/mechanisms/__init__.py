"""One mechanism a file: the file name is the mechanism's public name."""

from parallel_cal.model.shelf import list_plugins
from parallel_cal.model.shelf import load_mechanism as load

__all__ = ["load", "names"]


def names() -> list[str]:
    """What is on this shelf; `load` takes one of these, or the Python path of your own."""
    return list_plugins("mechanisms")
