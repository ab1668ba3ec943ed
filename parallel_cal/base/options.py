"""Options that a caller gives by name."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, replace
from typing import Any, TypeVar

from parallel_cal.base.errors import ParallelCalError, format_suggestion

Options = TypeVar("Options")


def option(help: str, *, min: float | None = None, max: float | None = None) -> dict[str, Any]:
    """Return the metadata of a dataclass field that the command line offers as an option."""
    return {"help": help, "min": min, "max": max}


def with_changes(
    options: Options, changes: Mapping[str, Any], error: type[ParallelCalError]
) -> Options:
    """Return the options (a dataclass) with some fields changed.

    Raises
    ------
    ParallelCalError
        The given kind of it, for a name that is no option.
    """
    known = [field.name for field in fields(options)]  # type: ignore[arg-type]
    for name in changes:
        if name not in known:
            raise error(
                f"unknown option {name}{format_suggestion(name, known)}; known: {', '.join(known)}"
            )
    return replace(options, **changes)  # type: ignore[type-var]
