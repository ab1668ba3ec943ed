"""One physical effect a file: the file name is the effect's public name."""

from parallel_cal.model.shelf import list_plugins
from parallel_cal.model.shelf import load_effect as load

__all__ = ["load", "names"]


def names() -> list[str]:
    """Return the names of all effects; `load` takes one of these, or a Python path."""
    return list_plugins("effects")
