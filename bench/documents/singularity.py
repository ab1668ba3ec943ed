"""A direct singularity of the Delta (type c of section 6.2.4, figure 6.3), found and drawn.

The nominal mock-up moves along a line towards a corner of its workspace. All poses of the same
joints are found at every point: another one, its platform tilted, comes closer and joins the
parallel one exactly where the distance to a direct singularity vanishes; the inverse problem
stays regular there. Argument: the file to draw (default singularity.html).
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from parallel_cal.base.rotation import rotation_vector
from parallel_cal.kinematics.all_solutions import direct_all
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.kinematics.singularity import distances
from parallel_cal.kinematics.solvers import continuous
from parallel_cal.model.model import new_model

CENTRE, TOWARDS = np.array([0.0, 0.0, 0.2]), np.array([0.3, 0.0, -0.1])


def followed(kinematics: Kinematics, fractions: np.ndarray) -> tuple[Any, Any]:
    """Solutions along the line and their distances to both kinds of singularity."""
    track = continuous.follow_poses(kinematics, CENTRE + fractions[:, None] * TOWARDS)
    return track.solutions, distances(kinematics.model, track.solutions)


def singular_fraction(kinematics: Kinematics) -> float:
    """Where on the line the direct distance vanishes: refined around its least value."""
    low, high = 0.0, 1.0
    for _ in range(8):
        fractions = np.linspace(low, high, 41)
        _, found = followed(kinematics, np.concatenate([np.linspace(0, low, 20)[:-1], fractions]))
        direct = found.direct[19:]
        best = int(np.argmin(direct))
        # The track ends at the singularity: it may lie beyond its last point.
        low, high = fractions[max(best - 1, 0)], fractions[min(best + 1, len(fractions) - 1)]
    return float(fractions[best])


def nearest_other(kinematics: Kinematics, joints: np.ndarray) -> tuple[int, float]:
    """How many real poses these joints have, and the tilt (deg) of the one nearest to level."""
    poses = direct_all(kinematics.model, joints)
    tilts = np.degrees(np.linalg.norm(rotation_vector(poses.rotation), axis=1))
    others = np.sort(tilts[tilts > 1e-3])
    return len(poses), float(others[0]) if len(others) else float("nan")


def draw(rows: np.ndarray, file: Path) -> None:
    import plotly.graph_objects as go
    from plotly.subplots import make_subplots

    figure = make_subplots(rows=2, cols=1, shared_xaxes=True, vertical_spacing=0.06)
    for column, name in ((1, "direct"), (2, "inverse")):
        figure.add_trace(go.Scatter(x=rows[:, 0], y=rows[:, column], name=f"{name} distance"), 1, 1)
    figure.add_trace(
        go.Scatter(
            x=rows[:, 0], y=rows[:, 4], name="tilt of the nearest other", mode="lines+markers"
        ),
        2,
        1,
    )
    figure.update_yaxes(title_text="smallest scaled singular value", row=1, col=1)
    figure.update_yaxes(title_text="tilt [deg]", row=2, col=1)
    figure.update_xaxes(title_text="way from the centre [mm]", row=2, col=1)
    figure.update_layout(title="Delta mock-up approaching a direct singularity", height=700)
    figure.write_html(file, include_plotlyjs=True)


def main() -> None:
    file = Path(sys.argv[1] if len(sys.argv) > 1 else "singularity.html")
    kinematics = Kinematics(new_model("delta54"))
    end = singular_fraction(kinematics)
    # Closer and closer: the two poses part like a square root.
    fractions = end * (
        1 - np.concatenate([np.linspace(1, 0.05, 20), 10.0 ** np.arange(-2, -7, -1)])
    )
    solutions, found = followed(kinematics, fractions)
    way = fractions[: len(solutions)] * np.linalg.norm(TOWARDS) * 1e3
    others = [nearest_other(kinematics, q) for q in solutions.joints]
    rows = np.column_stack([way, found.direct, found.inverse, np.array(others)])
    table = Table("way [mm]", "direct", "inverse", "real poses", "nearest other tilted by [deg]")
    for row in rows:
        table.add_row(
            f"{row[0]:.3f}", *(f"{v:.4f}" for v in row[1:3]), f"{row[3]:.0f}", f"{row[4]:.2f}"
        )
    console = Console()
    console.print(table)
    place = np.round((CENTRE + end * TOWARDS) * 1e3, 3)
    console.print(
        f"singular at {place} mm, joints {np.round(np.degrees(solutions.joints[-1]), 2)} deg"
    )
    draw(rows, file)
    console.print(f"{file}")


if __name__ == "__main__":
    main()
