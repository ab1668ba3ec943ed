"""Samples to try a session with: those of a robot that is simulated from the session's model."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from parallel_cal.model.model import Model
from parallel_cal.recordings.simulate import simulate

POSES, REPLICATES = 60, 20  # visited, and of these visited twice
HIDDEN = "backlash"
MAX_OFF = 0.3  # tolerances by which the geometry of the simulated robot is off, 1 sigma


def simulate_example(model: Model, file: Path) -> None:
    """Write the samples of a robot whose geometry is off and which has backlash."""
    rng = np.random.default_rng(0)
    off = MAX_OFF * model.table.tolerance * rng.standard_normal(len(model.values))
    robot = model.with_values(np.where(model.fixed, model.values, model.values + off))
    simulate(robot, POSES, effects=(HIDDEN,), replicates=REPLICATES).dataset().to_json(file)
