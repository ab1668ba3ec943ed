"""Error against the number of measured poses: figure 5.17 for random, grid and optimal sets.

The virtual mock-up (table 5.18) is measured with the thesis' noise at poses chosen with the
nominal model; the identified model predicts 300 poses it has not seen. The thesis fitted its
74 real points and judged there; ours is judged everywhere in the same cube.

    python -m bench.documents.number_of_poses [--draws 20] [--folder FOLDER]
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import virtual_day as vd
from datasets import as_dataset
from rich.console import Console
from rich.table import Table

from parallel_cal.base.errors import FitError
from parallel_cal.base.threads import single_threaded
from parallel_cal.identification.methods.implicit import estimate
from parallel_cal.identification.observations import observe
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.model import Model, Noise, new_model
from parallel_cal.planning.plan import plan
from parallel_cal.virtual import robot as vr

SETS = ("random", "grid", "optimal (D)", "optimal (prediction)")
NOISE = vr.THESIS_NOISE
POSITION_ONLY = np.array([True, True, True, False, False, False])


@dataclass(frozen=True)
class Case:
    """A model, what is measured, the least number that identifies it, and numbers of poses."""

    name: str
    model: Model
    measured: np.ndarray
    least: int
    numbers: tuple[int, ...]


def cases() -> list[Case]:
    nominal = dict(vr.TABLE_5_12)
    small = new_model("delta24")
    own = {name: nominal[name] for name in small.table.names}
    only = Noise(NOISE.joint, NOISE.position)
    full = Noise(NOISE.joint, NOISE.position, NOISE.orientation)
    return [
        Case(
            "model 24, position measured",
            replace(new_model("delta24", own), noise=only),
            POSITION_ONLY,
            8,
            (8, 9, 10, 12, 16, 24, 32, 40, 48, 56, 64, 74),
        ),
        Case(
            "model 54, pose measured",
            replace(new_model("delta54", nominal), noise=full),
            # 7 poses give 42 equations, but only 7 for the 8 of a chain's mean rod (G1): 8 it is
            np.ones(6, dtype=bool),
            8,
            (7, 8, 9, 10, 12, 16, 24, 32, 42, 56, 74, 84),
        ),
    ]


def readings(case: Case, kind: str, n: int, draw: int) -> np.ndarray:
    """Joints (n, 3) of a set of poses; the planned ones do not depend on the draw."""
    if kind.startswith("optimal"):
        criterion = "D" if "(D)" in kind else "prediction"
        return plan(case.model, n, criterion=criterion).poses.joints
    rng = np.random.default_rng([draw, n])
    if kind == "random":
        targets = case.model.mechanism.sample(n, rng)
    else:
        targets = vd.targets(n, draw)  # an even lattice: a grid of any number of points
    return Kinematics(case.model).inverse(targets).joints


def error(case: Case, q: np.ndarray, seed: int, unseen: tuple[np.ndarray, np.ndarray]) -> float:
    """Mean position error (m) at unseen joints of the model identified from readings q."""
    r, R = vr.MOCK_UP.forward(q)
    dq, dr, w = NOISE.draw(np.random.default_rng([seed, 7]), len(q))
    rows = {"q": q + dq, "r": r + dr, "R": vr.turn(w) @ R, "direction": np.zeros_like(q)}
    rows |= {"time": np.arange(len(q)), "pose_index": np.arange(len(q))}
    data = as_dataset(rows, NOISE, np.tile(case.measured, (len(q), 1)))
    try:
        found = estimate(case.model, observe(case.model, data), ~case.model.fixed)
    except FitError:
        return np.inf
    pose = Kinematics(case.model.with_values(found.values)).direct(unseen[0])
    apart = np.linalg.norm(pose.position - unseen[1], axis=1)
    return float(apart.mean()) if np.isfinite(apart).all() else np.inf


def curve(case: Case, kind: str, draws: int, unseen: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """Errors (numbers, draws): every draw has its own noise, and its own random set."""
    rows = []
    for n in case.numbers:
        try:
            sets = _sets(case, kind, n, draws)
        except FitError:  # no plan of so few poses sees all parameters
            rows.append([np.inf] * draws)
            continue
        rows.append([error(case, q, d, unseen) for d, q in enumerate(sets)])
    return np.array(rows)


def _sets(case: Case, kind: str, n: int, draws: int) -> list[np.ndarray]:
    """Readings of each draw; the planned ones are the same every time."""
    if kind.startswith("optimal"):
        return [readings(case, kind, n, 0)] * draws
    return [readings(case, kind, n, draw) for draw in range(draws)]


def show(case: Case, curves: dict[str, np.ndarray], before: float) -> None:
    table = Table("poses", *SETS, title=f"{case.name}: mean position error at unseen poses, um")
    table.add_row("0", *[f"{before * 1e6:.0f}"] * len(SETS))
    for i, n in enumerate(case.numbers):
        table.add_row(str(n), *[_cell(curves[kind][i]) for kind in SETS])
    console = Console(width=110)
    console.print(table)
    console.print(rule_of_thumb(case, curves))


def _cell(values: np.ndarray) -> str:
    """Median over the draws and the worst decile: failures are infinite, not left out."""
    middle, bad = np.quantile(values, [0.5, 0.9], method="higher") * 1e6
    return f"{middle:.1f} (90 %: {bad:.0f})" if np.isfinite(bad) else f"{middle:.1f} (fails)"


def rule_of_thumb(case: Case, curves: dict[str, np.ndarray]) -> str:
    """Is twice the least number enough? From there on more poses should only average noise."""
    most, twice = case.numbers[-1], 2 * case.least
    first, at = case.numbers.index(case.least), case.numbers.index(twice)
    law = np.sqrt(most / twice)
    words = [
        f"Rule of thumb, twice the least number: {twice} poses against {most}, where averaging "
        f"noise alone would give {law:.2f} times the error:"
    ]
    for kind in SETS:
        few, enough, floor = (np.median(curves[kind][i]) for i in (first, at, -1))
        words.append(f"  {kind}: {enough / floor:.2f} ({case.least} poses: {few / floor:.2f})")
    words.append(f"  {_equal_to_random(case, curves)}")
    return "\n".join(words)


def _equal_to_random(case: Case, curves: dict[str, np.ndarray]) -> str:
    goal = np.median(curves["random"][-1])
    best = np.median(curves["optimal (prediction)"], axis=1)
    enough = [n for n, e in zip(case.numbers, best, strict=True) if e <= goal]
    few = f"{enough[0]} optimal poses" if enough else "no number of optimal poses"
    return f"{few} do what {case.numbers[-1]} random ones do ({goal * 1e6:.1f} um)"


def draw(case: Case, curves: dict[str, np.ndarray], folder: Path) -> None:
    import plotly.graph_objects as go

    figure = go.Figure(
        [
            go.Scatter(
                x=list(case.numbers),
                y=[v * 1e6 if np.isfinite(v) else None for v in np.median(curves[kind], axis=1)],
                error_y={"array": _above(curves[kind]).tolist(), "width": 2, "thickness": 1},
                name=kind,
            )
            for kind in SETS
        ]
    )
    title = f"{case.name}: error against number of poses (figure 5.17); bars: worst decile"
    figure.update_layout(title=title, xaxis_title="poses measured", template="simple_white")
    figure.update_yaxes(title="mean position error at unseen poses [um]", type="log")
    name = case.name.split(",")[0].replace(" ", "_")
    folder.mkdir(parents=True, exist_ok=True)
    figure.write_html(folder / f"number_of_poses_{name}.html", include_plotlyjs=True)


def _above(values: np.ndarray) -> np.ndarray:
    """From the median to the worst decile, um; 0 where fits fail."""
    top, middle = np.quantile(values, 0.9, axis=1, method="higher"), np.median(values, axis=1)
    solved = np.isfinite(top)
    return np.where(solved, np.where(solved, top, 0) - np.where(solved, middle, 0), 0.0) * 1e6


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--draws", type=int, default=20)
    parser.add_argument("--folder", type=Path, help="where to draw the curves (HTML)")
    given = parser.parse_args()
    for case in cases():
        targets = case.model.mechanism.sample(300, np.random.default_rng(99))
        q = Kinematics(case.model).inverse(targets).joints
        unseen = (q, vr.MOCK_UP.forward(q)[0])
        before = np.linalg.norm(targets - unseen[1], axis=1).mean()
        with single_threaded():
            curves = {kind: curve(case, kind, given.draws, unseen) for kind in SETS}
        show(case, curves, float(before))
        if given.folder:
            draw(case, curves, given.folder)


if __name__ == "__main__":
    main()
