"""One mechanism a file: the file name is the mechanism's public name."""

from parallel_cal.model.shelf import list_plugins
from parallel_cal.model.shelf import load_mechanism as load

__all__ = ["load", "names"]


def names() -> list[str]:
    """List the mechanisms of this shelf; `load` takes one of them or a Python path."""
    return list_plugins("mechanisms")
