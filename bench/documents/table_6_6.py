"""Table 6.6 again: what each solution of model 54 costs and how far it is off, beside the thesis.

Errors are means over poses near the centre, as norms; times are for one solve in a batch on
CasADi's virtual machine, given as ratios to model 24's closed form, as the thesis' machine was
a 68040. The thesis does not say which poses it took, and used another set of parameters: the
tilt that model 24 leaves out is 1070" there and 1500" for table 5.18. So the errors are given
twice, once for a robot whose parallelogram errors are shrunk until its tilt is the thesis'.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np
import virtual_day as vd
from rich.console import Console
from rich.table import Table

from bench.speed.timing import seconds_each
from parallel_cal.base.compiled import Batch
from parallel_cal.base.rotation import rotation_vector
from parallel_cal.kinematics.kinematics import Kinematics, Solutions
from parallel_cal.kinematics.solvers.homotopy import direct_all
from parallel_cal.model.model import Model, new_model
from parallel_cal.thesis.solvers.cascaded import PERFECT, direct_function, inverse_function
from parallel_cal.thesis.solvers.fixed_newton import newton_steps
from parallel_cal.virtual import robot as vr

N = 1000
CUBE = 0.04  # m: near the centre, where a Jacobian of the centre serves
PRINTED = (0.65, 0.53)  # s: model 24's direct and inverse problem in the thesis
ARCSECONDS = 180 / np.pi * 3600
TILT = 1070  # arcseconds that model 24 leaves out in the thesis
# The cascade's error falls with the tilt's square, the others' with where the robot is.
CAPTION = """cascade 0.40 um from the centre to a cube of 0.16 m; rough 112 um at the centre,
279 um over that cube; five fixed steps 0.002, 0.1 and 11 um within 10, 20 and 40 mm"""


@dataclass(frozen=True)
class Row:
    """A line of table 6.6: thesis' seconds (direct, inverse) and errors (um, arcseconds)."""

    name: str
    seconds: tuple[float | None, float | None]
    errors: str
    direct: ca.Function
    inverse: ca.Function | None = None


def rows(model: Model) -> list[Row]:
    """Ours for each line of the table, the ratio's denominator first."""
    s, s24 = model.structure, as_model_24(model).structure

    def newton(problem: str, steps: int, update: bool, start: str = "mechanism") -> ca.Function:
        return newton_steps(s, problem, steps, update, start)

    return [
        Row(
            "Delta 24, closed form",
            PRINTED,
            "483, 1070",
            newton_steps(s24, "direct", 0),
            newton_steps(s24, "inverse", 0),
        ),
        Row("rough cascade (6.33)", (1.1, 1.1), "483, 2.9", *cascade(s, 0)),
        Row("cascade, 1.5 steps", (2.0, 1.9), "0.1, 1.3", *cascade(s, 3)),
        Row("cascade, 2.5 steps", (None, None), "-", *cascade(s, 5)),
        Row("fixed Jacobian, 2 steps", (None, None), "-", newton("direct", 2, False)),
        Row("  5 steps, from centre", (2.7, None), "0.02, 0.3", newton("direct", 5, False, "home")),
        Row("  all steps, from model 24", (3.4, None), "0, 0", newton("direct", 6, False)),
        Row(
            "Newton, 3 Jacobians",
            (None, 7.6),
            "0, 0",
            newton("direct", 3, True),
            newton("inverse", 3, True),
        ),
    ]


def cascade(structure: object, half_steps: int) -> tuple[ca.Function, ca.Function]:
    return direct_function(structure, half_steps), inverse_function(structure, half_steps)


def as_model_24(model: Model) -> Model:
    """The same robot with its parallelograms taken for perfect."""
    names = new_model("delta24").table.names
    return new_model("delta24", {name: model.value(name) for name in names})


@dataclass(frozen=True)
class Robot:
    """A model 54, exact poses of it, and both problems' given rows."""

    model: Model
    truth: Solutions
    joints: np.ndarray
    poses: np.ndarray


def robot(model: Model) -> Robot:
    kinematics = Kinematics(model)
    truth = kinematics.direct(kinematics.inverse(vd.targets(N, 1, CUBE)).joints)
    home = np.array([*model.mechanism.home.position, *np.eye(3).ravel()])
    joints = np.hstack([truth.joints, np.tile(home, (N, 1))])
    poses = np.hstack([truth.joints, truth.position, np.tile(np.eye(3).ravel(), (N, 1))])
    return Robot(model, truth, joints, poses)


def milder(model: Model) -> Model:
    """The same robot with its parallelogram errors shrunk to the thesis' tilt."""
    tilts = np.linalg.norm(rotation_vector(robot(model).truth.rotation), axis=1)
    names = {p.name for p in model.mechanism.parameters if p.group == PERFECT}
    small = np.array([name in names for name in model.table.names])
    shrunk = np.where(small, TILT / (tilts.mean() * ARCSECONDS), 1.0)
    return model.with_values(model.values * shrunk)


def error(row: Row, robot: Robot) -> str:
    """Mean error of the direct problem as um and arcseconds."""
    owner, truth, n = owner_of(row, robot.model), robot.truth, len(robot.model.joints)
    (x,) = Batch(row.direct)(robot.joints, np.empty((N, 0)), owner.values)
    R = x[:, n + 3 :].reshape(-1, 3, 3)
    apart = np.linalg.norm(x[:, n : n + 3] - truth.position, axis=1)
    turned = np.linalg.norm(rotation_vector(R @ np.swapaxes(truth.rotation, 1, 2)), axis=1)
    return f"{short(apart.mean() * 1e6)}, {short(turned.mean() * ARCSECONDS)}"


def short(value: float) -> str:
    """Two figures, and rounding errors as zero, as the thesis prints them."""
    return "0" if value < 1e-6 else f"{value:.0f}" if value >= 10 else f"{value:.2g}"


def seconds(model: Model, function: ca.Function, given: np.ndarray) -> float:
    values = model.values[: function.numel_in(2)]
    batch, conditions = Batch(function), np.empty((len(given), 0))
    return seconds_each(lambda: batch(given, conditions, values), least=5) / len(given)


def owner_of(row: Row, model: Model) -> Model:
    return as_model_24(model) if "24, closed" in row.name else model


def main() -> None:
    model = new_model("delta54", vr.TABLE_5_18)
    ours, mild = robot(model), robot(milder(model))
    table = Table(
        "model 54, table 5.18",
        "us",
        "ratio",
        "thesis",
        "um, arcsec",
        'at 1070"',
        "thesis",
        "inverse us",
        "ratio",
        "thesis",
        caption=CAPTION,
    )
    base: list[float] = []
    for row in rows(model):
        owner = owner_of(row, model)
        each = [seconds(owner, row.direct, ours.joints)]
        each += [seconds(owner, row.inverse, ours.poses)] if row.inverse else []
        base = base or each
        cells = [timed(*times) for times in zip(each, base, row.seconds, PRINTED, strict=False)]
        cells += [["-"] * 3] * (2 - len(cells))
        errors = (error(row, ours), error(row, mild), row.errors)
        table.add_row(row.name, *cells[0], *errors, *cells[1])
    every = seconds_each(lambda: direct_all(model, ours.truth.joints[0]), least=5)
    ratio, printed = f"{every / base[0]:.0f}", f"{14000 / PRINTED[0]:.0f}"
    zeros = ["0, 0"] * 3
    table.add_row("all 40 poses", f"{every * 1e6:.0f}", ratio, printed, *zeros, *["-"] * 3)
    Console(width=130).print(table)


def timed(t: float, base: float, printed: float | None, printed_base: float) -> list[str]:
    """Microseconds, ratio to model 24, and the thesis' ratio."""
    thesis = f"{printed / printed_base:.1f}" if printed else "-"
    return [f"{t * 1e6:.1f}", f"{t / base:.1f}", thesis]


if __name__ == "__main__":
    main()
