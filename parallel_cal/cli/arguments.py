"""Arguments that several commands share, with their help texts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import Field, fields
from functools import wraps
from inspect import Parameter, Signature, signature
from pathlib import Path
from typing import Annotated, Any, get_args

import typer

from parallel_cal.base.errors import ParallelCalError
from parallel_cal.identification.options import FitOptions

ModelFile = Annotated[Path, typer.Argument(metavar="MODEL.yaml", help="model file")]
Bags = Annotated[
    list[Path],
    typer.Argument(help="recordings: rosbag2 folders or files, or saved samples (.json)"),
]
Out = Annotated[Path, typer.Option("-o", "--output", help="file to write")]
OptionalOut = Annotated[
    Path | None,
    typer.Option("-o", "--output", help="model file to write; without it, none is written"),
]
Json = Annotated[bool, typer.Option("--json", help="print one JSON document")]
Details = Annotated[
    bool,
    typer.Option(
        "--details", help="print all warnings in full, and remarks and figures for experts, too"
    ),
]
Parameters = Annotated[
    bool, typer.Option("--parameters", help="print the identified parameters, too")
]
Data = Annotated[
    list[str] | None,
    typer.Option(
        "--data",
        help="option for reading the recording, KEY=VALUE (exclude=3,17; "
        "max_samples=10000; for a bag: measured_pose=/tracker)",
    ),
]
EffectName = Annotated[
    str,
    typer.Argument(
        metavar="EFFECT", help="NAME, NAME:ratio=80 or NAME+NAME; 'parallel-cal effects' lists them"
    ),
]
AddedEffects = Annotated[
    list[str] | None,
    typer.Option(
        "--effect",
        metavar="NAME[:PARAM=VALUE,...]",
        help="add this effect to the model before the fit (repeat for several); use it if the "
        "geometry runs away because a large effect is missing",
    ),
]
EffectsInModel = Annotated[
    str,
    typer.Argument(
        metavar="EFFECT", help="name of an effect in the model; join several names with +"
    ),
]
IMPLAUSIBLE = (
    "if the joint readings are implausible, or if the values of an effect are physically "
    "impossible together"
)
ForceFit = Annotated[
    bool,
    typer.Option(
        "--force",
        help="write the model even if it is refused. It is refused if the validation error does "
        f"not fall, {IMPLAUSIBLE}",
    ),
]
ForceAdd = Annotated[
    bool,
    typer.Option(
        "--force",
        help="write the model even if it is refused. It is refused if the validation error does "
        "not fall, if the measuring device may cause the error that the effect explains, "
        f"{IMPLAUSIBLE}",
    ),
]
ForceRemove = Annotated[
    bool,
    typer.Option(
        "--force",
        help="write the model even if it is refused. It is refused if the validation error rises "
        f"by 1 % or more, {IMPLAUSIBLE}",
    ),
]
Tested = Annotated[
    list[str] | None, typer.Option(help="test only this effect (repeat for several)")
]
Also = Annotated[
    list[str] | None, typer.Option(help="also test your own effect, given by its Python path")
]
Scheduler = Annotated[
    str | None,
    typer.Option(
        metavar="tcp://HOST:PORT", help="address of a Dask cluster [default: use this machine]"
    ),
]
Workers = Annotated[
    int | None, typer.Option(min=1, help="processes on this machine [default: one per core]")
]

# The types that the command line can read, by the annotation of a field. The annotations are
# compared as text: evaluating them would import numpy before the help is shown.
TYPES = {"str": str, "int": int, "float": float, "bool": bool, "Sequence[str]": list[str]}


def type_of(field: Field[Any]) -> Any:
    """Return the type of a field on the command line, which is the first one of a union."""
    return TYPES[str(field.type).partition(" | ")[0]]


def option_of(options: type, name: str) -> Any:
    """Return the command-line option of a field of a dataclass."""
    (field,) = (each for each in fields(options) if each.name == name)
    # A flag needs its name, or Typer adds the opposite, --no-NAME.
    names = [f"--{name.replace('_', '-')}"] if type_of(field) is bool else []
    return typer.Option(*names, **field.metadata)


Free = Annotated[list[str] | None, option_of(FitOptions, "free")]
Fix = Annotated[list[str] | None, option_of(FitOptions, "fix")]
JointSigma = Annotated[float | None, option_of(FitOptions, "joint_sigma")]

# The options of a fit that most commands offer, in the order of the help.
FIT = ("hold_out", "joint_sigma", "free", "fix", "prior", "loss", "usual_only")
Fitting = Annotated[FitOptions, FIT]
FittingOrUpdating = Annotated[FitOptions, (*FIT, "update")]
FittingByMethod = Annotated[FitOptions, ("method", *FIT, "update")]


def patterns(given: list[str] | None) -> tuple[str, ...]:
    """Split `--fix 'chain1.* chain2.Lb'` at spaces and commas."""
    return tuple(word for text in given or [] for word in text.replace(",", " ").split())


def keeping_inputs(command: Callable[..., None]) -> Callable[..., None]:
    """Let a command refuse to write its output over a file that it reads. A model may take the
    place of the one that it began with.

    What is read is measured, or written by hand: nothing else has it.
    """
    shown = signature(command, eval_str=True)
    output = shown.parameters.get("output")
    if output is None:
        return command
    replaced = {"output", "model"} if output.annotation == OptionalOut else {"output"}

    @wraps(command)
    def run(**given: Any) -> None:
        target = given.get("output")
        read = [one for name, one in given.items() if name not in replaced]
        files = [one for each in read for one in (each if isinstance(each, list) else [each])]
        there = [one for one in files if isinstance(one, Path) and one.exists()]
        file = target if isinstance(target, Path) and target.is_file() else None
        if file is not None and any(file.samefile(one) for one in there):
            raise ParallelCalError(
                f"{file}: this command reads this file, and -o would write over it: give another "
                "name (nothing was written)"
            )
        command(**given)

    run.__signature__ = shown  # type: ignore[attr-defined]
    return run


def with_options(command: Callable[..., None]) -> Callable[..., None]:
    """Replace a command's argument `options`, a dataclass, by one command-line option per field.

    The argument's type names the fields: `Annotated[FitOptions, ("free", "fix")]`. A type without
    names offers all fields that have a help text.
    """
    own = signature(command, eval_str=True).parameters
    kind, names = get_args(own["options"].annotation) or (own["options"].annotation, None)
    known = {field.name: field for field in fields(kind) if field.metadata}
    offered = [known[name] for name in names or known]

    def with_all(**given: Any) -> None:
        values = {field.name: _field_value(field, given.pop(field.name)) for field in offered}
        command(**given, options=kind(**values))

    added = []
    for field in offered:
        default = {bool: False, list[str]: None}.get(type_of(field), field.default)
        # The type exists at run time only.
        hint = Annotated[type_of(field), option_of(kind, field.name)]  # type: ignore[valid-type]
        added.append(
            Parameter(field.name, Parameter.KEYWORD_ONLY, default=default, annotation=hint)
        )
    shown = [each for p in own.values() for each in (added if p.name == "options" else [p])]
    with_all.__name__, with_all.__doc__ = command.__name__, command.__doc__
    # Typer reads the signature from this attribute.
    with_all.__signature__ = Signature(shown)  # type: ignore[attr-defined]
    return with_all


def _field_value(field: Field[Any], given: Any) -> Any:
    """Convert an argument; a flag or a list that was not given leaves the field's default."""
    if type_of(field) == list[str]:
        return patterns(given) or field.default
    return field.default if given is False else given
