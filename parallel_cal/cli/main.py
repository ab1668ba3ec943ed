"""The command line `parallel-cal`: declarations only, work is imported where it is done."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from parallel_cal import __version__
from parallel_cal.base.errors import ParallelCalError
from parallel_cal.reporting import console

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,  # rich would double the start-up time
    pretty_exceptions_enable=False,
    help="Kinematic calibration of parallel robots: compare the model with measurements, see "
    "where it fails, add the missing effect, watch the error fall. All values are SI.",
)

ModelFile = Annotated[Path, typer.Argument(metavar="MODEL.yaml", help="model file")]
Bag = Annotated[Path, typer.Argument(help="rosbag2 folder or file, or saved samples (.json)")]
Bags = Annotated[
    list[Path],
    typer.Argument(help="rosbag2 folders or files, or saved samples (.json); several: sessions"),
]
Out = Annotated[Path, typer.Option("-o", "--output", help="file to write")]
OptionalOut = Annotated[
    Path | None, typer.Option("-o", "--output", help="model file to write; none: only show")
]
Json = Annotated[bool, typer.Option("--json", help="one JSON document on stdout")]
At = Annotated[
    list[str] | None, typer.Option("--at", help="conditions, NAME=VALUE (temperature=25)")
]
Every = Annotated[bool, typer.Option("--all", help="all solutions, not only the home branch")]
Covariance = Annotated[
    bool, typer.Option("--covariance", help="with the uncertainty carried from the fit")
]
Solver = Annotated[
    str, typer.Option(help="newton, closed_form, or a file of solvers/: NAME[:option=value,...]")
]
Input = Annotated[Path | None, typer.Option("--input", help="CSV table of many problems")]
Output = Annotated[Path | None, typer.Option("--output", help="CSV table of the answers")]
Data = Annotated[
    list[str] | None,
    typer.Option(
        "--data", help="how to read the recording, KEY=VALUE (measured_pose=/tracker, exclude=3,17)"
    ),
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
Prior = Annotated[bool, typer.Option("--prior", help="use tolerances as prior knowledge")]
Loss = Annotated[
    str, typer.Option(help="linear, or robust to bad samples: huber, soft_l1, cauchy, arctan")
]
Refit = Annotated[
    list[str] | None,
    typer.Option(help="identify parameters like PATTERN alone, keep the rest with its covariance"),
]
Force = Annotated[bool, typer.Option("--force", help="write in spite of the held-out errors")]
EffectName = Annotated[
    str, typer.Argument(metavar="EFFECT", help="NAME or NAME:ratio=80, see 'parallel-cal effects'")
]


def _version(wanted: bool) -> None:
    if wanted:
        console.say(f"parallel-cal {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="show the version")
    ] = False,
) -> None: ...


# ------------------------------------------------------------------------------- models


@app.command()
def new(
    mechanism: Annotated[str, typer.Argument(help="see 'parallel-cal mechanisms'")],
    output: Out,
    option: Annotated[
        list[str] | None, typer.Option(metavar="KEY=VALUE", help="option of the mechanism")
    ] = None,
    sensor: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME: {KEY: VALUE}", help="measuring set-up, 'probe: {height: 0.3}'"),
    ] = None,
    as_json: Json = False,
) -> None:
    """Write a model file with a mechanism's nominal values."""
    from parallel_cal.cli import models

    models.new(mechanism, output, option or [], sensor or [], as_json)


@app.command()
def mechanisms(as_json: Json = False) -> None:
    """List the mechanisms: joints, coordinates, parameters."""
    from parallel_cal.cli import models

    models.mechanisms(as_json)


@app.command()
def effects(as_json: Json = False) -> None:
    """List the physical effects: what they are, what they need, what they resemble."""
    from parallel_cal.cli import models

    models.effects(as_json)


@app.command()
def sensors(as_json: Json = False) -> None:
    """List the measuring set-ups beside the pose device: what they are, their options."""
    from parallel_cal.cli import models

    models.sensors(as_json)


# ------------------------------------------------------------------------------- kinematics


@app.command(name="fk", hidden=True)
@app.command()
def direct(
    model: ModelFile,
    joints: Annotated[str | None, typer.Option(metavar="A B C", help="joints (rad or m)")] = None,
    at: At = None,
    every: Every = False,
    solver: Solver = "newton",
    covariance: Covariance = False,
    table: Input = None,
    output: Output = None,
    as_json: Json = False,
) -> None:
    """Pose for given joints (forward kinematics)."""
    from parallel_cal.cli import kinematics

    values = _numbers(joints, "--joints")
    _one_of(values, table, "--joints", output, every or covariance)
    kinematics.direct(model, values, at or [], every, solver, covariance, table, output, as_json)


@app.command(name="ik", hidden=True)
@app.command()
def inverse(
    model: ModelFile,
    position: Annotated[str | None, typer.Option(metavar="X Y Z", help="position (m)")] = None,
    orientation: Annotated[
        str | None, typer.Option(metavar="QX QY QZ QW", help="orientation (quaternion)")
    ] = None,
    at: At = None,
    every: Every = False,
    solver: Solver = "newton",
    covariance: Covariance = False,
    table: Input = None,
    output: Output = None,
    as_json: Json = False,
) -> None:
    """Joints for a given pose (inverse kinematics)."""
    from parallel_cal.cli import kinematics

    values = _numbers(position, "--position", 3)
    quaternion = _numbers(orientation, "--orientation", 4)
    _one_of(values or quaternion, table, "--position", output, every or covariance)
    kinematics.inverse(
        model, values, quaternion, at or [], every, solver, covariance, table, output, as_json
    )


# ------------------------------------------------------------------------------- recordings


@app.command(name="look", hidden=True)
@app.command()
def info(bag: Bag, data: Data = None, as_json: Json = False) -> None:
    """Show what a recording holds: topics, samples, what was dropped and why, noise."""
    from parallel_cal.cli import recordings

    recordings.info(bag, data or [], as_json)


@app.command(name="import-csv")
def import_csv(
    table: Annotated[Path, typer.Argument(metavar="TABLE.csv", help="one sample a line")],
    output: Annotated[Path, typer.Option("-o", "--output", help="samples to write (.json)")],
    columns: Annotated[Path, typer.Option(help="column map: which column is what (YAML)")],
    as_json: Json = False,
) -> None:
    """Make samples of a CSV table, for every command that takes a recording."""
    from parallel_cal.cli import importing

    importing.csv(table, columns, output, as_json)


@app.command()
def simulate(
    model: ModelFile,
    output: Out,
    effect: Annotated[
        list[str] | None, typer.Option(metavar="NAME[:PARAM=VALUE,...]", help="hidden effect")
    ] = None,
    poses: Annotated[int, typer.Option(min=1, help="different poses")] = 74,
    seed: Annotated[int, typer.Option(min=0, help="of poses and noise")] = 0,
    replicates: Annotated[int, typer.Option(min=0, help="poses that are visited again")] = 0,
    noise_off: Annotated[bool, typer.Option("--noise-off", help="perfect instruments")] = False,
    storage: Annotated[str, typer.Option(help="mcap or sqlite3")] = "mcap",
    as_json: Json = False,
) -> None:
    """Record a robot that does not exist: the model, some hidden effects, noise."""
    from parallel_cal.cli import recordings

    if replicates > poses:
        raise typer.BadParameter(f"{replicates} replicates of {poses} poses")
    recordings.simulate(
        model, output, effect or [], poses, seed, replicates, noise_off, storage, as_json
    )


@app.command()
def replay(
    bag: Annotated[Path, typer.Argument(help="rosbag2 folder or file")],
    rate: Annotated[float, typer.Option(min=0.001, help="times real time")] = 1.0,
) -> None:
    """Publish a recording on its topics, as the robot and the device did (needs ROS 2)."""
    from parallel_cal.cli import recordings

    recordings.replay(bag, rate)


# ------------------------------------------------------------------------------- calibration


@app.command()
def fit(
    model: ModelFile,
    bags: Bags,
    output: OptionalOut = None,
    method: Method = "implicit",
    hold_out: HoldOut = 0.25,
    joint_sigma: JointSigma = None,
    free: Free = None,
    fix: Fix = None,
    prior: Prior = False,
    loss: Loss = "linear",
    refit: Refit = None,
    data: Data = None,
    as_json: Json = False,
) -> None:
    """Identify the model's free parameters; show errors before, after and at poses left out."""
    from parallel_cal.cli import calibration

    options = _fit_options(method, hold_out, joint_sigma, free, fix, prior) | {"loss": loss}
    calibration.fit(model, bags, output, data or [], as_json, refit=_patterns(refit), **options)


@app.command()
def compare(
    model: ModelFile,
    bags: Bags,
    joint_sigma: JointSigma = None,
    data: Data = None,
    as_json: Json = False,
) -> None:
    """Errors of a model at every sample of a recording, worst first; fits nothing."""
    from parallel_cal.cli import calibration

    calibration.compare(model, bags, joint_sigma, data or [], as_json)


@app.command()
def add(
    model: ModelFile,
    effect: EffectName,
    bags: Bags,
    output: OptionalOut = None,
    force: Force = False,
    method: Method = "implicit",
    hold_out: HoldOut = 0.25,
    joint_sigma: JointSigma = None,
    free: Free = None,
    fix: Fix = None,
    prior: Prior = False,
    loss: Loss = "linear",
    data: Data = None,
    as_json: Json = False,
) -> None:
    """Add an effect and identify anew; refused when the error at poses left out does not fall."""
    from parallel_cal.cli import calibration

    options = _fit_options(method, hold_out, joint_sigma, free, fix, prior) | {"loss": loss}
    calibration.add(model, effect, bags, output, force, data or [], as_json, **options)


@app.command()
def remove(
    model: ModelFile,
    effect: EffectName,
    bags: Bags,
    output: OptionalOut = None,
    force: Force = False,
    method: Method = "implicit",
    hold_out: HoldOut = 0.25,
    joint_sigma: JointSigma = None,
    free: Free = None,
    fix: Fix = None,
    prior: Prior = False,
    loss: Loss = "linear",
    data: Data = None,
    as_json: Json = False,
) -> None:
    """Remove an effect and identify anew; refused when the error at poses left out rises."""
    from parallel_cal.cli import calibration

    options = _fit_options(method, hold_out, joint_sigma, free, fix, prior) | {"loss": loss}
    calibration.remove(model, effect, bags, output, force, data or [], as_json, **options)


@app.command()
def diagnose(
    model: ModelFile,
    bags: Bags,
    effect: Annotated[
        list[str] | None, typer.Option(help="test only this effect (repeat for several)")
    ] = None,
    also: Annotated[
        list[str] | None, typer.Option(help="test your own effect, too: its Python path")
    ] = None,
    hold_out: HoldOut = 0.25,
    joint_sigma: JointSigma = None,
    free: Free = None,
    fix: Fix = None,
    prior: Prior = False,
    loss: Loss = "linear",
    data: Data = None,
    as_json: Json = False,
) -> None:
    """Say which physical effect the model lacks, how sure that is, and what to measure next."""
    from parallel_cal.cli import diagnosing

    options = _fit_options("implicit", hold_out, joint_sigma, free, fix, prior)
    options |= {"loss": loss, "effects": effect or [], "also": also or []}
    diagnosing.diagnose(model, bags, data or [], as_json, **options)


@app.command()
def report(
    model: ModelFile,
    bags: Bags,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="page (.html) or document (.json)")
    ] = None,
    against: Annotated[
        Path | None,
        typer.Option(metavar="OTHER.yaml", help="another model, side by side on the same data"),
    ] = None,
    effect: Annotated[
        list[str] | None, typer.Option(help="test only this effect (repeat for several)")
    ] = None,
    also: Annotated[
        list[str] | None, typer.Option(help="test your own effect, too: its Python path")
    ] = None,
    hold_out: HoldOut = 0.25,
    joint_sigma: JointSigma = None,
    free: Free = None,
    fix: Fix = None,
    prior: Prior = False,
    loss: Loss = "linear",
    data: Data = None,
    as_json: Json = False,
) -> None:
    """Write the diagnosis as one page to read offline: errors, arrows, observations, parameters."""
    from parallel_cal.cli import reporting

    if output is None and not as_json:
        raise typer.BadParameter("give -o R.html (or .json), or --json")
    options = _fit_options("implicit", hold_out, joint_sigma, free, fix, prior)
    options |= {"loss": loss, "effects": effect or [], "also": also or []}
    reporting.report(model, bags, output, against, data or [], as_json, **options)


@app.command(name="short-cut")
def short_cut(
    model: ModelFile,
    bags: Bags,
    output: OptionalOut = None,
    fix: Fix = None,
    joint_sigma: JointSigma = None,
    data: Data = None,
    as_json: Json = False,
) -> None:
    """Identify a Delta without a device, from loops of two of its arms and one of its rods.

    The topic `constraint` names the loop that is tied: 12:21:11 is the second ball of arm 1 tied to
    the first of arm 2 by the first rod of chain 1. Angles do not see the size: --fix what was
    measured, such as chain1.Lb chain1.dLb.
    """
    from parallel_cal.cli import short_cut as command

    options = {"fix": _patterns(fix), "joint_sigma": joint_sigma}
    command.run(model, bags, output, data or [], as_json, **options)


@app.command()
def plan(
    model: ModelFile,
    poses: Annotated[int, typer.Option(min=1, help="how many to measure")],
    criterion: Annotated[
        str, typer.Option(help="prediction, D, A, condition or noise_amplification")
    ] = "prediction",
    method: Annotated[
        str | None, typer.Option(help="exchange or annealing; none: what suits the criterion")
    ] = None,
    pool: Annotated[int, typer.Option(min=1, help="candidates drawn in the workspace")] = 1000,
    symmetric: Annotated[
        bool, typer.Option("--symmetric", help="sets of three, a third of a turn about z apart")
    ] = False,
    free: Free = None,
    fix: Fix = None,
    prior: Prior = False,
    seed: Annotated[int, typer.Option(min=0, help="of the candidates")] = 0,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="poses as .csv, or the whole as .yaml")
    ] = None,
    as_json: Json = False,
) -> None:
    """Choose the poses to measure: what they will tell, beside random ones."""
    from parallel_cal.cli import planning

    planning.plan(
        model, poses, output, as_json, criterion=criterion, method=method, pool=pool,
        symmetric=symmetric, free=_patterns(free), fix=_patterns(fix), prior=prior, seed=seed,
    )  # fmt: skip


# ------------------------------------------------------------------------------- to see it work


@app.command()
def demo(
    bag: Annotated[Path | None, typer.Option(help="another recording")] = None,
    rate: Annotated[float, typer.Option(min=0.001, help="times real time")] = 20.0,
    keep: Annotated[bool, typer.Option("--keep", help="leave the files it makes")] = False,
    as_json: Json = False,
) -> None:
    """Calibrate a virtual robot from beginning to end (needs ROS 2)."""
    from parallel_cal.cli import showing

    showing.demo(bag, rate, keep, as_json)


@app.command()
def bench(
    names: Annotated[list[str] | None, typer.Argument(help="which ones; none: all")] = None,
) -> None:
    """Run the measurements of speed and accuracy in bench/ (needs the repository)."""
    from parallel_cal.cli import showing

    showing.bench(names or [])


# ------------------------------------------------------------------------------- arguments


def _numbers(text: str | None, option: str, n: int | None = None) -> list[float] | None:
    """`0.1 -0.2` or `0.1,-0.2` as numbers; wrong usage where it is not that."""
    if text is None:
        return None
    try:
        values = [float(word) for word in text.replace(",", " ").split()]
    except ValueError:
        raise typer.BadParameter(f"{option}: expected numbers, found '{text}'") from None
    if n is not None and len(values) != n:
        raise typer.BadParameter(f"{option}: expected {n} numbers, found {len(values)}")
    return values


def _one_of(
    values: list[float] | None, table: Path | None, option: str, output: Path | None, more: bool
) -> None:
    if (values is None) == (table is None):
        raise typer.BadParameter(f"give either {option} or --input")
    if table is not None and more:
        raise typer.BadParameter("--all and --covariance are for one problem, not for --input")
    if table is None and output is not None:
        raise typer.BadParameter("--output goes with --input; one problem's answer is printed")


def _fit_options(
    method: str,
    hold_out: float,
    joint_sigma: float | None,
    free: list[str] | None,
    fix: list[str] | None,
    prior: bool,
) -> dict[str, Any]:
    return {
        "method": method,
        "hold_out": hold_out,
        "joint_sigma": joint_sigma,
        "free": _patterns(free),
        "fix": _patterns(fix),
        "prior": prior,
    }


def _patterns(given: list[str] | None) -> tuple[str, ...]:
    return tuple(word for text in given or [] for word in text.replace(",", " ").split())


def gathered(arguments: Sequence[str]) -> list[str]:
    """`--joints 0.1 -0.2` as `--joints=0.1 -0.2`: an option cannot take any number of values."""
    out: list[str] = []
    taking = None
    for argument in arguments:
        if taking is not None and taking(argument):
            out[-1] += ("" if out[-1].endswith("=") else " ") + argument
            continue
        taking = _TAKES.get(argument)
        out.append(argument + "=" if taking else argument)
    return [word[:-1] if word[:-1] in _TAKES else word for word in _split_at(out)]


def _split_at(words: list[str]) -> list[str]:
    """`--at=a=1 b=2` as two options."""
    out: list[str] = []
    for word in words:
        if word.startswith("--at=") and " " in word:
            out += [f"--at={item}" for item in word.removeprefix("--at=").split()]
        else:
            out.append(word)
    return out


def _is_number(word: str) -> bool:
    try:
        return bool([float(part) for part in word.split(",")])
    except ValueError:
        return False


_TAKES = {
    "--joints": _is_number,
    "--position": _is_number,
    "--orientation": _is_number,
    "--at": lambda word: "=" in word and not word.startswith("-"),
}


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point: exit 0 ok, 1 one clear line, 2 wrong usage."""
    given = gathered(sys.argv[1:] if arguments is None else arguments)
    try:
        app(args=given, prog_name="parallel-cal")
    except ParallelCalError as error:
        console.error(str(error))
        sys.exit(1)
    except OSError as error:
        console.error(f"{error.filename or 'file'}: {error.strerror or error}")
        sys.exit(1)
    except KeyboardInterrupt:
        console.note("stopped")
        sys.exit(130)


if __name__ == "__main__":
    main()
