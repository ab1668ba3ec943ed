"""Convert results to JSON documents, and NumPy's numbers to those of Python."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any

JSON_SCALARS = (str, int, bool, type(None))


def to_plain(value: Any) -> Any:
    """Return a value with Python's numbers and lists in place of NumPy's scalars and arrays, also
    inside lists, tuples and mappings: NumPy 2 writes its own as `np.float64(1.0)`."""
    if hasattr(value, "tolist"):
        value = _to_python(value)
    if isinstance(value, Mapping):
        return {to_plain(key): to_plain(item) for key, item in value.items()}
    if type(value) in (list, tuple):
        return type(value)(map(to_plain, value))
    return value


def make_plain(instance: Any, *names: str) -> None:
    """Replace fields of a dataclass by what `to_plain` makes of them, for its `__post_init__`; all
    fields if no names are given."""
    for name in names or (field.name for field in fields(instance)):
        object.__setattr__(instance, name, to_plain(getattr(instance, name)))


def to_json_value(value: Any) -> Any:
    """Convert a value to plain JSON data.

    NaN and infinity become null, arrays and tuples become lists. A dataclass becomes its
    `document()`, or its fields by name if it has none.
    """
    kind = type(value)
    if kind is float:
        return value if math.isfinite(value) else None
    if kind in JSON_SCALARS:
        return value
    if hasattr(value, "document"):
        return to_json_value(value.document())
    if is_dataclass(value):
        return {field.name: to_json_value(getattr(value, field.name)) for field in fields(value)}
    if hasattr(value, "tolist"):
        return to_json_value(_to_python(value))
    if isinstance(value, Mapping):
        return {str(key): to_json_value(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        # A list may hold ten thousands of numbers: a call for each would take most of the time.
        return [v if type(v) is float and math.isfinite(v) else to_json_value(v) for v in value]
    return value


def _to_python(value: Any) -> Any:
    plain = value.tolist()
    return float(value) if type(plain) is type(value) else plain  # a numpy.longdouble stays itself
