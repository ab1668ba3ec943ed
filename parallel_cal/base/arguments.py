"""Clear errors for arguments of the wrong kind, such as a path in place of its contents."""

from __future__ import annotations

from numbers import Integral, Real
from os import PathLike
from typing import Any

from parallel_cal.base.errors import DatasetError, ModelError, ParallelCalError


def describe_argument(name: str, value: Any) -> str:
    """Describe an argument by its name, value and type: `model is 'robot.yaml' (str)`."""
    return f"{name} is {value!r:.60} ({type(value).__name__})"


def require_model(value: Any) -> None:
    """Raise ModelError unless an argument is a model: a path or the result of a fit is none."""
    if hasattr(value, "mechanism"):
        return
    if hasattr(getattr(value, "model", None), "mechanism"):
        cure = f"pass the model of this {type(value).__name__}, its attribute `model`"
    else:
        cure = "expected a Model, as parallel_cal.read_model(path) or new_model(name) returns it"
    raise ModelError(f"{describe_argument('model', value)}; {cure}")


def require_dataset(value: Any) -> None:
    """Raise DatasetError unless an argument is a dataset: a path or a recording is none."""
    if not hasattr(value, "joint_names"):
        raise DatasetError(
            f"{describe_argument('dataset', value)}; expected a Dataset, as "
            "parallel_cal.load_dataset(path) returns it"
        )


def require_names(name: str, value: Any, error: type[ParallelCalError]) -> None:
    """Raise `error` for one string in place of a list, whose letters would count as entries."""
    if isinstance(value, str):
        raise error(f"{describe_argument(name, value)}; expected a list: ['{value}']")


def require_path(name: str, value: Any, error: type[ParallelCalError]) -> None:
    """Raise `error` unless an argument can be the path of a file."""
    if not isinstance(value, (str, PathLike)):
        raise error(f"{describe_argument(name, value)}; expected the path of a file or folder")


def require_number(name: str, value: Any, error: type[ParallelCalError]) -> None:
    """Raise `error` unless an argument is a number."""
    if not isinstance(value, Real) or isinstance(value, bool):
        raise error(f"{describe_argument(name, value)}; expected a number")


def require_count(name: str, value: Any, error: type[ParallelCalError]) -> None:
    """Raise `error` unless an argument is a whole number."""
    if not isinstance(value, Integral) or isinstance(value, bool):
        raise error(f"{describe_argument(name, value)}; expected a whole number")


def require_text(name: str, value: Any, error: type[ParallelCalError]) -> None:
    """Raise `error` unless an argument is a string."""
    if not isinstance(value, str):
        raise error(f"{describe_argument(name, value)}; expected a string")
