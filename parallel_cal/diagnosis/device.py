"""Robot or device? What an error of the measuring device could imitate of a robot's effects.

Residuals tell what is missing, not on which side of the measurement. What decides is how much each
side may plausibly do: a tolerance bounds an effect of the robot, and the device's certificate (the
tolerances of its effects) an error of the device.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from parallel_cal.diagnosis.catalogue import Candidate, new_numbers
from parallel_cal.diagnosis.scene import Scene, columns
from parallel_cal.diagnosis.thresholds import APART


def imitated(scene: Scene, chosen: Sequence[Candidate], ranked: Sequence[Candidate]) -> list[str]:
    """Names of the robot's effects among `chosen` that the device could as well have made.

    With all that the device may do in place of the effect, misfit and price (see `cost`) rise by
    less than five sigmas. What the device does in the course of time is told apart by other means:
    shuffled conditions, swaps.
    """
    device = [
        c
        for c in ranked
        if c.effect.of_device and not c.effect.needs and c.testable and c.scene is scene
    ]
    own = [c for c in chosen if not c.effect.of_device and c.scene is scene]
    if not device or not own:
        return []
    known = {c.name: _columns(scene, c) for c in {c.name: c for c in (*chosen, *device)}.values()}

    def price(*candidates: Candidate) -> float:
        names = dict.fromkeys(c.name for c in candidates)
        return cost(scene, np.hstack([known[name] for name in names]))

    limit = price(*chosen) + APART**2 * max(scene.chi2_per_dof, 1.0)
    without = {one.name: price(*(c for c in chosen if c is not one), *device) for one in own}
    return [name for name, instead in without.items() if instead < limit]


def cost(scene: Scene, B: np.ndarray) -> float:
    """min over e of |r - B e|^2 + |e|^2: misfit of the residual r (n,) by columns B (n, k) in
    tolerances, off the geometry, and what numbers e cost that stray as far."""
    B = scene.off_geometry(B)
    along = B.T @ scene.residual
    return float(
        scene.residual @ scene.residual
        - along @ np.linalg.solve(np.eye(B.shape[1]) + B.T @ B, along)
    )


def _columns(scene: Scene, one: Candidate) -> np.ndarray:
    extended = scene.model.with_effect(one.name, one.settings)
    return columns(extended, scene, new_numbers(scene.model, extended))
