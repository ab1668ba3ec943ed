"""Commands for forward and inverse kinematics, for one problem or for a table."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from parallel_cal.base.errors import ParallelCalError
from parallel_cal.base.units import ARCMIN
from parallel_cal.cli.arguments import Json, ModelFile
from parallel_cal.reporting import console
from parallel_cal.reporting.readable import format_fixed, format_fixed_vector, value_unit

if TYPE_CHECKING:
    import numpy as np

    from parallel_cal.cli.tables import Answer
    from parallel_cal.kinematics.answers import Differences
    from parallel_cal.kinematics.kinematics import Solutions
    from parallel_cal.model.model import Model

At = Annotated[
    list[str] | None, typer.Option("--at", help="conditions, NAME=VALUE (temperature=25)")
]
Every = Annotated[
    bool,
    typer.Option("--all", help="show all solutions, not only the home branch; not with --input"),
]
Covariance = Annotated[
    bool,
    typer.Option(
        "--covariance",
        help="also show the model uncertainty of the answer; in a table, 1 sigma in columns such "
        "as sigma.x (m, rad)",
    ),
]


def _describe_solvers(solver: str) -> str:
    if solver == "help":
        from parallel_cal.kinematics.solving import solvers

        console.table(("solver", "purpose"), list(solvers().items()))
        raise typer.Exit
    return solver


Solver = Annotated[
    str,
    typer.Option(
        help="solver, NAME[:option=value,...], instead of newton; 'help' lists the solvers",
        callback=_describe_solvers,
        is_eager=True,
        show_default=False,
    ),
]
Input = Annotated[
    Path | None,
    typer.Option(
        "--input",
        help="CSV table; each row states the joint readings (direct) or the pose (inverse: x y z, "
        "and qx qy qz qw or the rotation vector rx ry rz; coordinates that the robot does not "
        "control may be absent), in SI units or in those of the header (leg1 [mm]); other columns "
        "are kept",
    ),
]
Output = Annotated[
    Path | None,
    typer.Option(
        "--output",
        help="CSV table to write: the given one with a solution in each row, in SI units (m, rad)",
    ),
]


def direct(
    model: ModelFile,
    joints: Annotated[
        str | None, typer.Option(metavar="A B C", help="joint readings (rad or m)")
    ] = None,
    at: At = None,
    every: Every = False,
    solver: Solver = "",
    covariance: Covariance = False,
    table: Input = None,
    output: Output = None,
    as_json: Json = False,
) -> None:
    """Compute the pose for joints (forward kinematics)."""
    q = _numbers(joints, "--joints")
    _check_one_input(q, table, "--joints", output, every)
    import numpy as np

    from parallel_cal.cli.tables import direct_table
    from parallel_cal.kinematics import answers, solving

    robot, conditions = _read_robot_and_conditions(model, at)

    def warn(found: Solutions, conditions: Mapping[str, Any], explained: np.ndarray | None) -> None:
        disagreement = answers.describe_disagreement(found, explained)
        region = _list_region_warnings(found, robot, conditions)
        console.warn(filter(None, [*region, disagreement]))

    if table is not None:
        answer = direct_table(robot, table, conditions, solver, covariance)
        _output_table(answer, output, as_json)
        console.warn(answer.warnings)
        return warn(answer.found, answer.conditions, answer.explained)
    if q is not None and len(q) != len(robot.joints):
        raise ParallelCalError(
            f"--joints: {len(q)} values given, {robot.mechanism.name} has {len(robot.joints)} "
            f"joints: {', '.join(robot.joints)}"
        )
    found = solving.direct(robot, np.array(q), conditions, every, solver)
    known = answers.direct_covariances(robot, found, conditions) if covariance else None
    explained = answers.explained_residuals(robot, found, conditions)
    _print_solutions(found, robot, known, _pose_sigma, as_json, explained)
    warn(found, conditions, explained)


def inverse(
    model: ModelFile,
    position: Annotated[str | None, typer.Option(metavar="X Y Z", help="position (m)")] = None,
    orientation: Annotated[
        str | None, typer.Option(metavar="QX QY QZ QW", help="orientation (quaternion)")
    ] = None,
    at: At = None,
    every: Every = False,
    solver: Solver = "",
    covariance: Covariance = False,
    table: Input = None,
    output: Output = None,
    as_json: Json = False,
) -> None:
    """Compute the joints for a pose (inverse kinematics)."""
    place = _numbers(position, "--position", 3)
    quaternion = _numbers(orientation, "--orientation", 4)
    _check_one_input(place or quaternion, table, "--position", output, every)
    import numpy as np

    from parallel_cal.cli.tables import inverse_table
    from parallel_cal.kinematics import answers, solving

    robot, conditions = _read_robot_and_conditions(model, at)
    if table is not None:
        answer = inverse_table(robot, table, conditions, solver, covariance)
        _output_table(answer, output, as_json)
        console.warn(answer.warnings)
        missed = answer.differences and answer.differences.describe(robot.mechanism)
        return console.warn(
            [*_list_region_warnings(answer.found, robot, answer.conditions), *(missed or ())]
        )
    r = np.array(robot.mechanism.home.position if place is None else place)
    R = None if quaternion is None else answers.parse_rotation(quaternion)
    found = solving.inverse(robot, r, R, conditions, every, solver)
    known = answers.inverse_covariances(robot, found, conditions) if covariance else None
    words = partial(_joint_sigma, robot)
    apart = answers.Differences.of(found, None if place is None else r, R)
    _print_solutions(found, robot, known, words, as_json, differences=apart)
    turned = {coordinate >= 3 for coordinate in robot.mechanism.controlled}
    options = (("--position", place, False), ("--orientation", quaternion, True))
    console.warn(
        [
            *apart.first.describe(robot.mechanism),  # the home branch
            *(
                f"no {option} was given, so that of home was taken"
                for option, value, kind in options
                if value is None and kind in turned
            ),
            *_list_region_warnings(found, robot, conditions),
        ]
    )


def _numbers(text: str | None, option: str, n: int | None = None) -> list[float] | None:
    """Parse `0.1 -0.2` or `0.1,-0.2`; raise BadParameter for anything else."""
    if text is None:
        return None
    try:
        values = [float(word) for word in text.replace(",", " ").split()]
    except ValueError:
        raise typer.BadParameter(f"{option}: expected numbers, found '{text}'") from None
    if n is not None and len(values) != n:
        raise typer.BadParameter(f"{option}: expected {n} numbers, found {len(values)}")
    return values


def _check_one_input(
    values: list[float] | None, table: Path | None, option: str, output: Path | None, every: bool
) -> None:
    if (values is None) == (table is None):
        raise typer.BadParameter(f"give either {option} or --input")
    if table is not None and every:
        raise typer.BadParameter("--all cannot be combined with --input")
    if table is None and output is not None:
        raise typer.BadParameter("--output needs --input; the answer to one problem is printed")


def _read_robot_and_conditions(path: Path, at: list[str] | None) -> tuple[Model, dict[str, float]]:
    from parallel_cal.kinematics.answers import parse_conditions
    from parallel_cal.model.file.modelfile import read_model

    model = read_model(path).robot()
    conditions = parse_conditions(model, at or [])
    unused = [name for name in conditions if name not in model.conditions]
    console.warn(unused and [f"no effect of the model depends on {', '.join(unused)}"])
    return model, conditions


def _list_region_warnings(
    solutions: Solutions, model: Model, conditions: Mapping[str, Any]
) -> list[str]:
    """List poses outside the region in which the model was identified, and conditions beyond those
    in which its laws were tested."""
    from parallel_cal.model.region import IdentifiedRegion, describe_untested_conditions

    rows = model.condition_rows(conditions, len(solutions.status))
    words = [describe_untested_conditions(model, rows)]
    if region := IdentifiedRegion.of_model(model):
        excess = region.compute_excess(solutions.joints, solutions.position)
        words.append(region.describe_excess(excess, "solutions"))
    return [*filter(None, words)]


def _print_solutions(
    solutions: Solutions,
    model: Model,
    covariances: np.ndarray | None,
    words: Callable[[np.ndarray], str],
    as_json: bool,
    explained: np.ndarray | None = None,
    differences: Differences | None = None,
) -> None:
    from parallel_cal.kinematics.answers import to_rows

    rows = to_rows(solutions, covariances, explained, differences)
    if as_json:
        about = {key: getattr(solutions, key) for key in ("count_complex", "complete")}
        known = {key: value for key, value in about.items() if value is not None}
        return console.emit({"solutions": rows, **known})
    name, factor = _joint_unit(model)
    residuals = ("residual [um]",) if explained is None else ("residual [um]", "explained [um]")
    console.table(
        ("status", "position [mm]", "quaternion x y z w", f"joints [{name}]", *residuals),
        [
            (
                r["status"],
                format_fixed_vector(r["position"], 1e3, 4),
                format_fixed_vector(r["quaternion"], 1, 7),
                format_fixed_vector(r["joints"], factor, 5),
                *(
                    format_fixed(r[key], 1e6, 3)
                    for key in ("residual", "explained_residual")
                    if key in r
                ),
            )
            for r in rows
        ],
    )
    if solutions.complete is not None:
        n, usable = solutions.solved.sum(), solutions.ok.sum()
        others = "" if solutions.complete else "; others may exist"
        first = ", home branch first" if n > 1 and solutions.solved[0] else ""
        console.say(
            f"{n} solution{'' if n == 1 else 's'} found{first}; {usable} within limits{others}"
        )
    for covariance in () if covariances is None else covariances[solutions.solved]:
        console.say(f"1 sigma from the fit: {words(covariance.diagonal() ** 0.5)}")


def _pose_sigma(sigma: np.ndarray) -> str:
    turned = format_fixed_vector(sigma[3:], 1 / ARCMIN, 3)
    return f"position {format_fixed_vector(sigma[:3], 1e6, 1)} um, orientation {turned} arcmin"


def _joint_sigma(model: Model, sigma: np.ndarray) -> str:
    name, factor = _joint_unit(model)
    return f"joints {format_fixed_vector(sigma, factor, 5)} {name}"


def _joint_unit(model: Model) -> tuple[str, float]:
    units = set(model.mechanism.joint_units)
    return value_unit(units.pop()) if len(units) == 1 else ("rad|m", 1.0)


def _output_table(answer: Answer, output: Path | None, as_json: bool) -> None:
    from parallel_cal.base.files import write_atomically
    from parallel_cal.cli.tables import counts
    from parallel_cal.kinematics.answers import to_rows

    text, found = answer.text, answer.found
    if output is not None:
        write_atomically(output, text)
    statuses = counts(found)
    summary = ", ".join(f"{n} {status}" for status, n in statuses.items()) or "no rows"
    said = {} if found.message is None else {"message": found.message}
    summary = "; ".join([summary, *said.values()])
    if as_json and output is None:
        rows = to_rows(found, answer.covariances, answer.explained, answer.differences)
        console.emit({"solutions": rows, **said})
    elif as_json:
        console.emit({"output": str(output), "rows": len(found), "statuses": statuses, **said})
    elif output is None:
        console.write(text.rstrip("\n"))
        console.note(summary)
    else:
        console.say(f"{output}: {len(found)} rows, {summary}")
