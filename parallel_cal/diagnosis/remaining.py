"""Ask which recorded condition the residuals still depend on.

Noise does not know under which load, at which temperature or from which direction a pose was
reached. If the residuals depend on such a condition, part of them is motion of the robot, even if
no effect of the catalogue describes it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from parallel_cal.causes.unknown_laws import smooth
from parallel_cal.diagnosis.noise_shape import NoiseShape
from parallel_cal.diagnosis.scoring import deflate, score, score_beside
from parallel_cal.diagnosis.thresholds import CERTAINTY_LEVEL
from parallel_cal.model.effect import parse_part
from parallel_cal.posterior.scene import Scene

CONDITIONS = ("payload", "temperature", "direction", "travel", "time")
# Of an error of a joint that is any smooth function of its own reading: its length in standard
# deviations of the readings, and the number of functions.
OWN_LENGTH, OWN_CENTRES = 0.7, 8
SLOW_CONDITIONS = ("temperature", "time")


@dataclass(frozen=True)
class RemainingCondition:
    """A recorded condition that the residuals depend on, and the p-value of that."""

    name: str
    p_value: float

    @property
    def description(self) -> str:
        return f"what remains depends on {self.name} (p = {self.p_value:.1g})"


def find_remaining_condition(scene: Scene, shape: NoiseShape) -> RemainingCondition | None:
    """Find the recorded condition that the residuals depend on most clearly; None if on none.

    Every effect of a drive, a gear, an arm or a rod acts like an error of joint readings. So the
    residuals are regressed on such errors, which depend on the condition c by itself, times the
    joint's reading q and its square, and times the direction of approach; what the geometry can
    imitate is removed. The F test needs no figure of the noise. Slow conditions are judged by the
    number of independent samples, because the noise may drift.

    A condition that is correlated with the readings, such as the direction of joints that are
    mostly reached from below where their readings are large, is judged by what errors of the
    readings alone leave, if the residuals depend on these.
    """
    recorded = [] if scene.dataset.mode == "continuous" else list(_iterate_features(scene))
    if not recorded:
        return None
    joints = scene.measured_jacobian[:, :, : len(scene.model.joints)]
    q = scene.x.T[: joints.shape[2]]
    # A joint that stood at few places has fewer functions.
    own = [smooth(one, OWN_LENGTH, OWN_CENTRES)[:, None] for one in q]
    each = [_make_errors(joints[:, :, [i]], one) for i, one in enumerate(own)]
    readings, log_p = score(scene, np.hstack(each)), dict[str, float]()
    for name, features in recorded:
        found = score(scene, _make_errors(joints, features))
        if readings.p_value < CERTAINTY_LEVEL:
            found = score_beside(scene, found, readings)
        inflation = shape.inflation if name.split(".")[0] in SLOW_CONDITIONS else 1.0
        log_p[name] = deflate(found, scene.dof, inflation)
    name = min(log_p, key=lambda one: log_p[one])
    p_value = min(1.0, float(np.exp(log_p[name])) * len(log_p))
    return RemainingCondition(name, p_value) if p_value < CERTAINTY_LEVEL else None


def _make_errors(joints: np.ndarray, features: np.ndarray) -> np.ndarray:
    """The residuals (n, nq k) that errors of joints make which are their features (N, nq, k)."""
    columns = joints[:, :, :, None] * features[:, None]
    return np.asarray(columns.reshape(joints.shape[0] * joints.shape[1], -1))


def _iterate_features(scene: Scene) -> Iterator[tuple[str, np.ndarray]]:
    """What joint errors may depend on under each recorded condition: (N, nq, k) by joint."""
    joints, known = scene.model.joints, scene.dataset.conditions
    q = _standardise(scene.x[:, : len(joints)])

    def values(name: str) -> np.ndarray | None:
        """A condition (N, nq); None if it was not recorded, or never changed."""
        names = [name] * len(joints) if name in known else [f"{name}.{one}" for one in joints]
        if not all(one in known for one in names):
            return None
        found = np.column_stack([known[one] for one in names])
        return found if np.isfinite(found).all() and np.ptp(found, axis=0).any() else None

    direction = values("direction")
    for name in (*CONDITIONS, *filter(parse_part, known)):
        if (c := values(name)) is None:
            continue
        c = _standardise(c)
        features = [c, c * q, c * q**2]
        if direction is not None and name != "direction":
            features.append(c * direction)
        yield name, np.stack(features, axis=2)


def _standardise(values: np.ndarray) -> np.ndarray:
    return np.asarray((values - values.mean(axis=0)) / np.maximum(values.std(axis=0), 1e-12))
