"""From typed results to documents."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any

PLAIN = (str, int, bool, type(None))


def plain(value: Any) -> Any:
    """A value as JSON has it: NaN and infinity become null, arrays and tuples lists, a dataclass
    its `document()`, or where it has none its fields by name."""
    kind = type(value)
    if kind is float:
        return value if math.isfinite(value) else None
    if kind in PLAIN:
        return value
    if hasattr(value, "document"):
        return plain(value.document())
    if is_dataclass(value):
        return {field.name: plain(getattr(value, field.name)) for field in fields(value)}
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        # Numbers by the ten thousand: a call for each would cost more than all the rest.
        return [v if type(v) is float and math.isfinite(v) else plain(v) for v in value]
    return value
