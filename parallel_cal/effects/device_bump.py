"""A device or base that was bumped: from one moment on, all poses are shifted."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from parallel_cal.effects._frames import shift_and_turn, undo_shift_and_turn
from parallel_cal.model.effect import Effect, Seen
from parallel_cal.model.mechanism import Mechanism
from parallel_cal.model.parameters import Named, Parameter

MOMENTS = 20  # moments to try, with equally many samples between them


class DeviceBump(Effect):
    """From `time` (s) on r_shown = r + v + w x r, R_shown = exp(w) R; before it, no change.

    v (m) and w (rad) are about axes of {B}. `time` is on the clock of the samples: known from the
    logbook, or found by `scan`.
    """

    needs = ("time",)
    fixed = ("time",)
    of_device = True
    physics = "A stand, tripod or target that was bumped stays where it was pushed."
    remedy = "fasten the stand, and repeat the measurements from before the bump"
    source = (
        "tens of um to 1 mm, when a stand is touched or a target is put back on its magnetic nest"
    )
    lookalikes = ("base_drift", "zero_shift")
    separated_by = "the first poses, measured again at the end"

    def parameters(self, mechanism: Mechanism) -> list[Parameter]:
        time = Parameter("time", "s", 0.0, 10e3, low=0.0)  # within one day
        return [time, *shift_and_turn(mechanism, ("m", 50e-6, 2e-3), ("rad", 0.2e-3, 10e-3))]

    def ideal(self, seen: Seen, e: Named, at: Named, mechanism: Mechanism) -> Seen:
        return undo_shift_and_turn(seen, e, at.time >= e.time)

    def scan(
        self, mechanism: Mechanism, recorded: Mapping[str, Any]
    ) -> Iterator[Mapping[str, float]]:
        """Return moments between two samples, spread over the session."""
        times = np.unique(recorded["time"])
        if len(times) < 2:
            return iter(())
        between = (times[1:] + times[:-1]) / 2
        chosen = np.linspace(0, len(between) - 1, MOMENTS + 2)[1:-1].round().astype(int)
        return ({"time": float(between[k])} for k in np.unique(chosen))
