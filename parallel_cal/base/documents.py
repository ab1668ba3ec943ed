"""From typed results to documents."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any

JSON_SCALARS = (str, int, bool, type(None))


def to_json_value(value: Any) -> Any:
    """A value as JSON has it: NaN and infinity become null, arrays and tuples lists, a dataclass
    its `document()`, or where it has none its fields by name."""
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
        return to_json_value(value.tolist())
    if isinstance(value, Mapping):
        return {str(key): to_json_value(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        # Numbers by the ten thousand: a call for each would cost more than all the rest.
        return [v if type(v) is float and math.isfinite(v) else to_json_value(v) for v in value]
    return value
