"""Arguments that several commands share, each declared once with the words of its help."""

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
    typer.Argument(help="rosbag2 folders or files, or saved samples (.json); several: sessions"),
]
Out = Annotated[Path, typer.Option("-o", "--output", help="file to write")]
OptionalOut = Annotated[
    Path | None, typer.Option("-o", "--output", help="model file to write; none: only show")
]
Json = Annotated[bool, typer.Option("--json", help="one JSON document on stdout")]
Data = Annotated[
    list[str] | None,
    typer.Option(
        "--data", help="how to read the recording, KEY=VALUE (measured_pose=/tracker, exclude=3,17)"
    ),
]
EffectName = Annotated[
    str,
    typer.Argument(
        metavar="EFFECT", help="NAME, NAME:ratio=80 or NAME+NAME, see 'parallel-cal effects'"
    ),
]
Force = Annotated[
    bool, typer.Option("--force", help="write in spite of held-out errors and ranges")
]
Tested = Annotated[
    list[str] | None, typer.Option(help="test only this effect (repeat for several)")
]
Also = Annotated[list[str] | None, typer.Option(help="test your own effect, too: its Python path")]
Scheduler = Annotated[
    str | None,
    typer.Option(metavar="tcp://HOST:PORT", help="a Dask cluster's, in place of this machine"),
]
Workers = Annotated[
    int | None, typer.Option(min=1, help="processes on this machine [default: its cores]")
]
Method = Annotated[str, typer.Option(help="identification method")]
HoldOut = Annotated[
    float,
    typer.Option(
        min=0.0, max=0.5, help="share of poses left out in turn; 0.001: each pose alone, 0: none"
    ),
]
JointSigma = Annotated[
    float | None, typer.Option(min=0.0, help="noise of joint readings, 1 sigma (rad or m)")
]
Free = Annotated[
    list[str] | None,
    typer.Option(help="free parameters like PATTERN, too (narrower than --fix wins)"),
]
Fix = Annotated[list[str] | None, typer.Option(help="keep parameters like PATTERN fixed")]
Prior = Annotated[
    bool,
    typer.Option(
        "--prior", help="use tolerances as priors throughout, not only where the data tell less"
    ),
]
Loss = Annotated[
    str, typer.Option(help="linear, or robust to bad samples: huber, soft_l1, cauchy, arctan")
]


def patterns(given: list[str] | None) -> tuple[str, ...]:
    """`--fix 'chain1.* chain2.Lb'`, with spaces or commas, as patterns."""
    return tuple(word for text in given or [] for word in text.replace(",", " ").split())


def with_options(command: Callable[..., None]) -> Callable[..., None]:
    """A command whose argument `options`, a FitOptions, people give as options."""

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

    *these, _ = signature(with_all, eval_str=True).parameters.values()
    own = signature(command, eval_str=True).parameters
    shown = [each for p in own.values() for each in (these if p.name == "options" else [p])]
    with_all.__name__, with_all.__doc__ = command.__name__, command.__doc__
    with_all.__signature__ = Signature(shown)  # type: ignore[attr-defined]  # what typer reads
    return with_all
