"""Recognise objects with equal attributes, so that what follows from them is derived once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np


class ByContent:
    """An object that is equal to others of its class whose attributes are equal.

    Attributes may be replaced, but not changed in place. An attribute that cannot be hashed makes
    the object different from all others.
    """

    @cached_property
    def content(self) -> object:
        """The object that stands for the attributes: one for all that are equal."""
        cls: Any = type(self)
        own = {
            name: value
            for name, value in vars(self).items()
            if not isinstance(getattr(cls, name, None), cached_property)
        }
        try:
            return _stand_for(cls, _freeze(own))
        except (TypeError, NotImplementedError):  # of an expression of CasADi
            return object()

    def __setattr__(self, name: str, value: Any) -> None:
        super().__setattr__(name, value)
        vars(self).pop("content", None)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, ByContent) and self.content is other.content

    def __hash__(self) -> int:
        return hash(self.content)

    def __getstate__(self) -> dict[str, Any]:
        # In another process, other objects stand for the attributes.
        return {name: value for name, value in vars(self).items() if name != "content"}


@lru_cache(maxsize=1024)
def _stand_for(cls: type, attributes: Any) -> object:
    return object()


def _freeze(value: Any) -> Any:
    if isinstance(value, Mapping):
        return tuple((name, _freeze(part)) for name, part in value.items())
    if is_dataclass(value) and not isinstance(value, type):
        parts = (_freeze(getattr(value, part.name)) for part in fields(value))
        return type(value), *parts
    if isinstance(value, np.ndarray):
        return value.shape, value.dtype.str, value.tobytes()
    if isinstance(value, Sequence) and not isinstance(value, (str, bytes)):
        return type(value), *map(_freeze, value)
    return value
