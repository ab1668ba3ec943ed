"""Options that a caller gives by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import fields, replace
from inspect import signature
from typing import Any, TypeVar

from parallel_cal.base.errors import ParallelCalError, format_suggestion

Options = TypeVar("Options")


def option(help: str, *, min: float | None = None, max: float | None = None) -> dict[str, Any]:
    """Return the metadata of a dataclass field that the command line offers as an option."""
    return {"help": help, "min": min, "max": max}


def with_changes(
    options: Options | None,
    kind: type[Options],
    changes: Mapping[str, Any],
    error: type[ParallelCalError],
) -> Options:
    """Return the options (a dataclass of this kind, by default without arguments) with some fields
    changed.

    Raises
    ------
    ParallelCalError
        Of the class `error`, for an unknown option.
    """
    known = [field.name for field in fields(kind)]  # type: ignore[arg-type]
    for name in changes:
        if name not in known:
            raise error(
                f"unknown option {name}{format_suggestion(name, known)}; known: {', '.join(known)}"
            )
    return replace(kind() if options is None else options, **changes)  # type: ignore[type-var]


def split_options(
    text: str, kind: str, error: type[ParallelCalError]
) -> tuple[str, dict[str, str]]:
    """Split `NAME[:key=value,...]` into the name and the values by key.

    Raises
    ------
    ParallelCalError
        Of the class `error`, for an option without a key or without `=`. The message calls the
        text a `kind`, such as "effect".
    """
    name, _, options = text.partition(":")
    given: dict[str, str] = {}
    for item in filter(None, options.split(",")):
        key, equals, value = (part.strip() for part in item.partition("="))
        if not (key and equals):
            raise error(f"{kind} '{text}': expected NAME:key=value,..., found '{item}'")
        given[key] = value
    return name.strip(), given


def convert_options(
    given: Mapping[str, str], function: Callable[..., Any], name: str, error: type[ParallelCalError]
) -> dict[str, Any]:
    """Convert texts to keyword arguments of a function, with the types of its defaults.

    Raises
    ------
    ParallelCalError
        Of the class `error`, for an unknown option or a value of another type. The message calls
        the function `name`.
    """
    defaults = {p.name: p.default for p in signature(function).parameters.values()}
    known = {k: v for k, v in defaults.items() if isinstance(v, (bool, int, float, str))}
    options: dict[str, Any] = {}
    for key, value in given.items():
        try:
            if isinstance(known[key], bool):
                options[key] = bool(("false", "true").index(value.lower()))
            else:
                options[key] = type(known[key])(value)
        except (KeyError, ValueError):
            words = ", ".join(f"{k}={v}" for k, v in known.items())
            expected = f"expected one of {words}" if words else f"{name} has none"
            raise error(f"option '{key}={value}': {expected}") from None
    return options
