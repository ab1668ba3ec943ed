"""Arguments that several commands share, with their help texts."""

from __future__ import annotations

from collections.abc import Callable
from inspect import Signature, signature
from pathlib import Path
from typing import Annotated, Any

import typer

from parallel_cal.identification.options import FitOptions

ModelFile = Annotated[Path, typer.Argument(metavar="MODEL.yaml", help="model file")]
Bags = Annotated[
    list[Path],
    typer.Argument(help="rosbag2 folders or files, or saved samples (.json); each is one session"),
]
Out = Annotated[Path, typer.Option("-o", "--output", help="file to write")]
OptionalOut = Annotated[
    Path | None, typer.Option("-o", "--output", help="model file to write [default: none]")
]
Json = Annotated[bool, typer.Option("--json", help="print one JSON document")]
Data = Annotated[
    list[str] | None,
    typer.Option(
        "--data",
        help="option for reading the recording, KEY=VALUE (measured_pose=/tracker, exclude=3,17)",
    ),
]
EffectName = Annotated[
    str,
    typer.Argument(
        metavar="EFFECT", help="NAME, NAME:ratio=80 or NAME+NAME; 'parallel-cal effects' lists them"
    ),
]
Force = Annotated[
    bool,
    typer.Option("--force", help="write even if validation errors or parameter ranges object"),
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
Method = Annotated[str, typer.Option(help="identification method")]
HoldOut = Annotated[
    float,
    typer.Option(
        min=0.0,
        max=0.5,
        help="share of poses held out in each fold; 0.001: one pose at a time, 0: none",
    ),
]
JointSigma = Annotated[
    float | None, typer.Option(min=0.0, help="noise of the joint readings, 1 sigma (rad or m)")
]
Free = Annotated[
    list[str] | None,
    typer.Option(help="free parameters that match PATTERN; the narrower of --free and --fix wins"),
]
Fix = Annotated[list[str] | None, typer.Option(help="fix parameters that match PATTERN")]
Prior = Annotated[
    bool,
    typer.Option(
        "--prior",
        help="use tolerances as priors of all parameters, not only of weakly determined ones",
    ),
]
Loss = Annotated[
    str, typer.Option(help="linear, or robust to outliers: huber, soft_l1, cauchy, arctan")
]


def patterns(given: list[str] | None) -> tuple[str, ...]:
    """Split `--fix 'chain1.* chain2.Lb'` at spaces and commas."""
    return tuple(word for text in given or [] for word in text.replace(",", " ").split())


def with_options(command: Callable[..., None]) -> Callable[..., None]:
    """Replace a command's argument `options` (FitOptions) by one command-line option per field."""

    def with_all(
        *,
        hold_out: HoldOut = 0.25,
        joint_sigma: JointSigma = None,
        free: Free = None,
        fix: Fix = None,
        prior: Prior = False,
        loss: Loss = "linear",
        **others: Any,
    ) -> None:
        options = FitOptions(
            hold_out=hold_out,
            joint_sigma=joint_sigma,
            free=patterns(free),
            fix=patterns(fix),
            prior=prior or None,
            loss=loss,
        )
        command(**others, options=options)

    *fields, _ = signature(with_all, eval_str=True).parameters.values()
    own = signature(command, eval_str=True).parameters
    shown = [each for p in own.values() for each in (fields if p.name == "options" else [p])]
    with_all.__name__, with_all.__doc__ = command.__name__, command.__doc__
    # Typer reads the signature from this attribute.
    with_all.__signature__ = Signature(shown)  # type: ignore[attr-defined]
    return with_all
