"""Clear errors for arguments of the wrong kind, such as a path in place of its contents."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import fields
from functools import cache, wraps
from inspect import Parameter, signature
from numbers import Integral, Real
from os import PathLike
from typing import Any, ParamSpec, TypeVar

from parallel_cal.base.documents import make_plain, to_plain
from parallel_cal.base.errors import DatasetError, ModelError, ParallelCalError

P = ParamSpec("P")
Returned = TypeVar("Returned")
Check = Callable[[Any], bool]


def _is_array(value: Any) -> bool:
    import numpy as np  # here, because the command line shows its help without numpy

    try:
        np.asarray(value, dtype=float)
    except (TypeError, ValueError):
        return False
    return value is not None


# What the name of a type in an annotation accepts, how a message calls it, and several of it. Every
# other name is that of a class.
KINDS: dict[str, tuple[Check, str, str]] = {
    "Any": (lambda value: True, "anything", "values"),
    "None": (lambda value: value is None, "None", "None"),
    "str": (lambda value: isinstance(value, str), "a string", "strings"),
    "bool": (lambda value: isinstance(value, bool), "True or False", "flags"),
    "int": (
        lambda value: isinstance(value, Integral) and not isinstance(value, bool),
        "a whole number",
        "whole numbers",
    ),
    "float": (
        lambda value: isinstance(value, Real) and not isinstance(value, bool),
        "a number",
        "numbers",
    ),
    "Path": (
        lambda value: isinstance(value, (str, PathLike)),
        "the path of a file or folder",
        "paths",
    ),
    "Progress": (callable, "a function (stage, fraction)", "functions"),
    "Runner": (callable, "a function that runs tasks", "functions"),
    "ArrayLike": (_is_array, "an array of numbers", "arrays of numbers"),
}
ALIASES = {"str | Path": "Path", "MachineClass": "str", "np.ndarray": "ArrayLike"}
GENERIC = re.compile(r"(\w+)\[(.*)\]")  # such as Sequence[str]
OTHER_GENERICS = {"Mapping": "a dictionary", "Callable": "a function"}


def describe_argument(name: str, value: Any) -> str:
    """Describe an argument by its name, value and type: `model is 'robot.yaml' (str)`."""
    return f"{name} is {value!r:.60} ({type(value).__name__})"


def require_model(value: Any, name: str = "model") -> None:
    """Raise ModelError unless an argument is a model: a path or the result of a fit is none."""
    if hasattr(value, "mechanism"):
        return
    if hasattr(getattr(value, "model", None), "mechanism"):
        cure = f"pass the model of this {type(value).__name__}, its attribute `model`"
    else:
        cure = "expected a Model, as parallel_cal.read_model(path) or new_model(name) returns it"
    raise ModelError(f"{describe_argument(name, value)}; {cure}")


def require_dataset(value: Any, name: str = "dataset") -> None:
    """Raise DatasetError unless an argument is a dataset: a path or a recording is none."""
    if not hasattr(value, "joint_names"):
        raise DatasetError(
            f"{describe_argument(name, value)}; expected a Dataset, as "
            "parallel_cal.load_dataset(path) returns it"
        )


def require(name: str, value: Any, kind: str, error: type[ParallelCalError]) -> None:
    """Raise an error unless an argument is of a kind.

    Parameters
    ----------
    name : str
        The name of the argument.
    value : object
    kind : str
        The text of an annotation, such as `float | None`, `Sequence[str]` or `bool | Prior`. It is
        read as text, so that no module is imported for a type.
    error : class
        The error to raise. A model or a dataset has an error of its own, which states the cure.
    """
    kinds = _split_union(kind)
    if any(_is_of(value, part) for part in kinds):
        return
    if "Model" in kinds:
        return require_model(value, name)
    if "Dataset" in kinds:
        return require_dataset(value, name)
    one_string = isinstance(value, str) and any("[str]" in part for part in kinds)
    expected = " or ".join(dict.fromkeys(_name_kind(part) for part in kinds))
    cure = f"a list: ['{value}']" if one_string else expected
    raise error(f"{describe_argument(name, value)}; expected {cure}")


def require_fields(options: Any, error: type[ParallelCalError]) -> None:
    """Raise `error` for a field of a dataclass whose value is not of the annotated kind.

    NumPy's scalars and arrays in the fields become numbers and lists of Python.
    """
    for field in fields(options):
        require(field.name, getattr(options, field.name), str(field.type), error)
    make_plain(options)


def check_arguments(
    error: type[ParallelCalError],
) -> Callable[[Callable[P, Returned]], Callable[P, Returned]]:
    """Decorate a public function: an argument that is not of the annotated kind raises `error`.

    Options by name (`**changes`) are checked by the class of the options.
    """

    def decorate(function: Callable[P, Returned]) -> Callable[P, Returned]:
        form = signature(function)
        kinds = {
            name: parameter.annotation
            for name, parameter in form.parameters.items()
            if parameter.annotation is not Parameter.empty
            and parameter.kind is not Parameter.VAR_KEYWORD
        }

        @wraps(function)
        def checked(*args: P.args, **kwargs: P.kwargs) -> Returned:
            # Without those that are missing, for which the call below raises Python's TypeError.
            for name, value in form.bind_partial(*args, **kwargs).arguments.items():
                if name in kinds and value is not form.parameters[name].default:
                    require(name, value, kinds[name], error)
            return function(*args, **kwargs)

        return checked

    return decorate


@cache
def _split_union(kind: str) -> tuple[str, ...]:
    for text, other in ALIASES.items():
        kind = kind.replace(text, other)
    return tuple(kind.split(" | "))


def _is_of(value: Any, kind: str) -> bool:
    """Whether a value is of one kind, which is no union. A NumPy scalar is the number it holds."""
    if getattr(value, "shape", None) == ():
        value = to_plain(value)
    if kind in KINDS:
        return KINDS[kind][0](value)
    if not (generic := GENERIC.fullmatch(kind)):
        return any(one.__name__ == kind for one in type(value).__mro__)
    name, entries = generic.group(1), generic.group(2).removesuffix(", ...")
    if name == "Callable":
        return callable(value)
    if name == "Mapping":
        of_keys, of_values = entries.split(", ")
        return isinstance(value, Mapping) and all(
            _is_of(k, of_keys) and _is_of(v, of_values) for k, v in value.items()
        )
    if isinstance(value, (str, Mapping)) or not isinstance(value, Iterable):
        return False
    # An iterator is consumed by looking at its entries.
    return not isinstance(value, Collection) or all(_is_of(each, entries) for each in value)


def _name_kind(kind: str) -> str:
    """Name a kind in words: `a list of strings`."""
    if kind in KINDS:
        return KINDS[kind][1]
    if not (generic := GENERIC.fullmatch(kind)):
        return f"{'an' if kind[0] in 'AEIOU' else 'a'} {kind}"
    if generic.group(1) in OTHER_GENERICS:
        return OTHER_GENERICS[generic.group(1)]
    entries = generic.group(2).removesuffix(", ...")
    return f"a list of {KINDS[entries][2] if entries in KINDS else f'{entries} objects'}"
