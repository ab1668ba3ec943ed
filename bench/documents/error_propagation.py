"""Error propagation: serial SCARA against parallel Delta (section 3.6, figures 3.21-3.23).

Both robots carry a 50 mm rod over a plane in the middle of their workspace. Each parameter is
off by up to 0.05 mm or 0.1 degrees. Milling (figure 3.21): joints from the nominal model, the
true robot takes them somewhere else. Measuring (figure 3.23): the true tip touches a point,
the nominal model says where that is. Thesis (figure 3.22, one draw, milling): mean about
0.5 mm for the SCARA, 0.2 mm for the Delta, both varying by about 0.3 mm over the plane. Here,
100 draws of each: 0.44 mm (0.23 to 0.72) and 0.17 mm (0.09 to 0.27), varying by 0.35 and 0.24 mm;
the thesis does not give the size of the plane, 0.18 m is ours.

    python -m bench.documents.error_propagation [-o error_propagation.html] [--robots 100] [--json]
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.model import Model, new_model
from parallel_cal.model.shelf import load_mechanism

LENGTH, ANGLE = 0.05e-3, np.radians(0.1)  # eq. 3.29: equally distributed between plus and minus
ROD = 0.05  # m (figure 3.20)


@dataclass(frozen=True)
class Robot:
    """A mechanism of the comparison and the rod's tip in {P} (m)."""

    name: str
    mechanism: str
    tip: tuple[float, float, float]

    def nominal(self) -> Model:
        return new_model(load_mechanism(self.mechanism))

    def true(self, rng: np.random.Generator) -> Model:
        """A robot within the tolerance field."""
        model = self.nominal()
        field = np.array([LENGTH if p.unit == "m" else ANGLE for p in model.table])
        return model.with_values(model.values + field * rng.uniform(-1, 1, len(field)))

    def plane(self, side: float, n: int) -> np.ndarray:
        """n x n points of the rod's tip (m) in the xy-plane in the middle of the workspace."""
        model = self.nominal()
        workspace, home = model.mechanism.workspace, model.mechanism.home.joints
        rod = Kinematics(model).direct(home).rotation @ self.tip
        middle = (np.array(workspace.low) + np.array(workspace.high)) / 2
        steps = np.linspace(-side / 2, side / 2, n)
        x, y = np.meshgrid(steps, steps, indexing="ij")
        return middle + [0, 0, rod[2]] + np.stack([x, y, 0 * x], -1).reshape(-1, 3)


# 0.20 + 0.16 = 0.12 + 0.24 m (eq. 3.28). The rod hangs from the SCARA, whose y in {P} is up,
# and stands on the Delta's platform, away from the base.
ROBOTS = (
    Robot("SCARA, model 16", "scara16", (0.0, -ROD, 0.0)),
    Robot("Delta, model 54", "delta54", (0.0, 0.0, ROD)),
)


def tip_of(kinematics: Kinematics, joints: np.ndarray, tip: tuple[float, ...]) -> np.ndarray:
    """Where the rod's tip is (m) for joints (N, nq)."""
    s = kinematics.direct(joints)
    return np.where(s.ok[:, None], s.position + s.rotation @ np.array(tip), np.nan)


def joints_for(kinematics: Kinematics, points: np.ndarray, tip: tuple[float, ...]) -> np.ndarray:
    """Joints that bring the tip to points (N, 3); the orientation follows, so: iterate."""
    target = points.copy()
    for _ in range(20):
        s = kinematics.inverse(target)
        miss = points - (s.position + s.rotation @ np.array(tip))
        target = target + miss
        if np.abs(miss).max() < 1e-13:
            break
    return np.where(s.ok[:, None], s.joints, np.nan)


def milling(robot: Robot, true: Model, points: np.ndarray) -> np.ndarray:
    """Figure 3.21: error vectors (m) of the true tip at commanded points."""
    joints = joints_for(Kinematics(robot.nominal()), points, robot.tip)
    return tip_of(Kinematics(true), joints, robot.tip) - points


def measuring(robot: Robot, true: Model, points: np.ndarray) -> np.ndarray:
    """Figure 3.23: error vectors (m) of what the nominal model says about touched points."""
    joints = joints_for(Kinematics(true), points, robot.tip)
    return tip_of(Kinematics(robot.nominal()), joints, robot.tip) - points


TASKS = {"milling": milling, "measuring": measuring}


def study(
    robots: int = 100, side: float = 0.18, n: int = 11, seed: int = 0
) -> list[dict[str, Any]]:
    """For each robot and task the error (mm) over the plane, over many draws of the tolerances."""
    return [_row(robot, task, robots, side, n, seed) for robot in ROBOTS for task in TASKS]


def _row(robot: Robot, task: str, robots: int, side: float, n: int, seed: int) -> dict[str, Any]:
    rng, points = np.random.default_rng(seed), robot.plane(side, n)
    errors = np.array([TASKS[task](robot, robot.true(rng), points) for _ in range(robots)])
    size = 1e3 * np.linalg.norm(errors, axis=2)
    # Points out of reach are NaN and left out.
    means = np.nanmean(size, axis=1)
    spans = np.nanmax(size, axis=1) - np.nanmin(size, axis=1)
    typical = int(np.argmin(np.abs(means - np.median(means))))
    return {
        "robot": robot.name,
        "task": task,
        "mean_mm": float(means.mean()),
        "low_mm": float(np.quantile(means, 0.05)),
        "high_mm": float(np.quantile(means, 0.95)),
        "variation_mm": float(spans.mean()),
        "typical": size[typical].reshape(n, n).tolist(),
        "x_mm": (1e3 * np.unique(points[:, 0].round(9))).tolist(),
        "y_mm": (1e3 * np.unique(points[:, 1].round(9))).tolist(),
    }


def picture(rows: list[dict[str, Any]]) -> Any:
    """Figure 3.22: error over the plane, for the draw whose mean is the median of all draws."""
    from plotly.graph_objects import Surface
    from plotly.subplots import make_subplots

    titles = [f"{row['robot']}, {row['task']}: mean {row['mean_mm']:.2f} mm" for row in rows]
    figure = make_subplots(
        rows=2, cols=2, subplot_titles=titles, specs=[[{"type": "surface"}] * 2] * 2
    )
    top = max(np.nanmax(row["typical"]) for row in rows)
    for k, row in enumerate(rows):
        z = np.array(row["typical"]).T
        surface = Surface(x=row["x_mm"], y=row["y_mm"], z=z, cmin=0, cmax=top, showscale=k == 0)
        figure.add_trace(surface, row=k // 2 + 1, col=k % 2 + 1)
    axes = {"xaxis_title": "x (mm)", "yaxis_title": "y (mm)", "zaxis_title": "error (mm)"}
    camera = {"eye": {"x": 1.7, "y": 1.7, "z": 1.1}}
    figure.update_scenes(zaxis_range=[0, 1.05 * top], camera=camera, **axes)
    figure.update_layout(
        title="Error of the rod's tip over a plane (thesis, figure 3.22)", height=900
    )
    return figure


def write_picture(rows: list[dict[str, Any]], path: Path) -> list[Path]:
    """The picture as HTML, and as PNG where plotly's kaleido is installed."""
    figure, written = picture(rows), [path]
    figure.write_html(path, include_plotlyjs=True)
    try:
        figure.write_image(path.with_suffix(".png"), scale=2)
        written.append(path.with_suffix(".png"))
    except (ImportError, ValueError, RuntimeError):  # no kaleido, or no browser for it
        pass
    return written


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("-o", "--output", type=Path, default=Path("error_propagation.html"))
    options.add_argument("--robots", type=int, default=100)
    options.add_argument("--side", type=float, default=0.18, help="of the plane (m)")
    options.add_argument("--json", action="store_true")
    chosen = options.parse_args()
    rows = study(chosen.robots, chosen.side)
    if chosen.json:
        print(json.dumps(rows))
        return
    print(f"{'robot':>16} {'task':>10} {'mean mm':>8} {'5..95 %':>12} {'variation mm':>13}")
    form = (
        "{robot:>16} {task:>10} {mean_mm:>8.2f} {low_mm:>5.2f}..{high_mm:.2f} {variation_mm:>13.2f}"
    )
    for row in rows:
        print(form.format(**row))
    for path in write_picture(rows, chosen.output):
        print(path)


if __name__ == "__main__":
    main()
