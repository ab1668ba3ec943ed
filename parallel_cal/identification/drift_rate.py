"""How fast a robot drifts: what its own sessions, or those of a fleet, tell about it.

Between two sessions that are the time t apart, each part of the usual drift (`PARTS`) changes by a
normal distribution of `scale (t / span)^growth` times its usual size; `span` is the longest time
between two sessions. The growth is 0 (each session differs: homing, the day's temperature), 1/2 (a
random walk: wear, settling) or 1 (a steady drift). Every growth and scale is equally probable
before, so the weights are their marginal likelihoods.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from parallel_cal.base.errors import FitError
from parallel_cal.model.model import Model

PARTS = ("zeros", "temperature", "lengths", "others")
GROWTHS = (0.0, 0.5, 1.0)
SCALES = np.geomspace(1 / 30, 30, 13)  # usual drifts; `fit --update` has the same ends
STEPS = ("drift", "fleet_drift")  # of the history of a model that state a rate


@dataclass(frozen=True)
class DriftRate:
    """The probability of each growth and scale of each part, `weights` (4, 3, 13), in the order of
    `PARTS`, `GROWTHS` and `SCALES`; the longest time `span` (s) between two of the `sessions` of a
    robot; the number of these, and of `robots`."""

    weights: np.ndarray
    span: float
    sessions: int
    robots: int = 1

    def quantile(self, level: float) -> dict[str, float]:
        """The scale of each part after the time `span`, in usual drifts."""
        sums = np.cumsum(self.weights.sum(axis=1), axis=1)
        found = [float(SCALES[min(int(np.searchsorted(s, level)), len(SCALES) - 1)]) for s in sums]
        return dict(zip(PARTS, found, strict=True))

    def draw(self, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Draw growths and scales (count, 4), one of each part."""
        cells = [
            rng.choice(one.size, count, p=one.ravel() / one.sum(), shuffle=False)
            for one in self.weights
        ]
        growth, scale = np.divmod(np.array(cells).T, len(SCALES))
        return np.array(GROWTHS)[growth], SCALES[scale]

    def document(self) -> dict[str, Any]:
        return {
            "span": self.span,
            "sessions": self.sessions,
            "robots": self.robots,
            "weights": np.round(self.weights, 4).tolist(),
        }

    @classmethod
    def from_document(cls, document: Mapping[str, Any]) -> DriftRate:
        """FitError if it is not the document of a rate."""
        shape = len(PARTS), len(GROWTHS), len(SCALES)
        try:
            weights, span = np.array(document["weights"], float), float(document["span"])
            total = weights.sum(axis=(1, 2), keepdims=True)
            if weights.shape != shape or not (weights.min() >= 0 and total.min() > 0 and span > 0):
                raise ValueError(f"expected weights of the shape {shape} and a span above 0")
            return cls(weights / total, span, int(document["sessions"]), int(document["robots"]))
        except (KeyError, TypeError, ValueError) as error:
            raise FitError(
                f"the drift in the history of a model cannot be read ({error}): estimate it again "
                "with parallel-cal drift"
            ) from None

    @classmethod
    def of_model(cls, model: Model) -> DriftRate | None:
        """The drift that the history of a model states last; None if it states none."""
        for entry in reversed(model.history):
            if entry.get("step") in STEPS:
                return cls.from_document(entry)
        return None
