"""Virtual robots off their nominal dimensions, and joint readings about their home."""

import numpy as np

from parallel_cal.model.model import new_model
from parallel_cal.virtual import robot as vr
from parallel_cal.virtual import stewart as vt


def hexapod(seed=3):
    """A Stewart platform off by half its tolerances."""
    model = new_model("stewart42")
    draw = np.random.default_rng(seed).standard_normal(len(model.values))
    return vt.Stewart(model.table.mapping(model.values + 0.5 * model.table.tolerance * draw))


def joints_near_home(mechanism, twin, n, seed):
    """Readings (n, joints) at poses within 60 mm of home, tilted where the robot can be."""
    rng = np.random.default_rng([seed, 9])
    r = twin.home + rng.uniform(-0.06, 0.06, (n, 3))
    if mechanism == "delta54":
        return twin.inverse(r)[0]
    return twin.inverse(r, vr.turn(rng.uniform(-0.25, 0.25, (n, 3))))[0]
