"""Five delta printers as their owners know them: a model, touches of the bed, what they hide."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import virtual_printer as vp
import virtual_setups as vs

from parallel_cal.model.model import new_model
from parallel_cal.model.shelf import load_sensor
from parallel_cal.recordings.dataset import Dataset

TOUCH = 5e-6  # m, 1 sigma
LOW = 0.23  # m, the bed under a rotary Delta


@dataclass(frozen=True)
class Kind:
    """What its owner starts from, its joints' noise (m or rad), what may be named, and what hides
    (`ripple` rad at `teeth` a radian of a rotary one's shoulders)."""

    mechanism: str
    joint: float
    names: tuple[str, ...] = ()
    hidden: tuple[tuple[str, float], ...] = ()

    @property
    def sensor(self) -> dict[str, float]:
        return {"height": 0.0 if self.mechanism == "linear_delta" else LOW, "sigma": TOUCH}

    def model(self) -> Any:
        return new_model(self.mechanism, sensors=[load_sensor("probe", **self.sensor)])

    def touches(self, n: int, seed: int, draw: int = 0, noise: float = TOUCH) -> Dataset:
        """n touches of the printer of this seed; another draw touches other places."""
        rng, xy = np.random.default_rng([seed, draw, 33]), vp.places(n, 100 * seed + draw)
        if self.mechanism == "linear_delta":
            q = vp.drawn(seed, **dict(self.hidden)).touched(xy)
        else:
            q = vs.random_delta(seed).inverse(np.column_stack([xy, np.full(n, LOW)]))[0]
            hidden = dict(self.hidden)
            phase = hidden.get("teeth", 0.0) * q + np.array([0.3, 1.9, -1.2])
            q = q - hidden.get("ripple", 0.0) * np.sin(phase)
        q = q + (self.joint if noise else 0.0) * rng.standard_normal(q.shape)
        return Dataset.from_arrays(
            self.model().joints,
            q,
            np.zeros((n, 3)),
            measured=np.zeros(6, dtype=bool),
            joint_sigma=np.full(3, self.joint),
            source="virtual printer",
            conditions={"reading.probe": noise * rng.standard_normal(n)},
        )


PRINTERS = {
    "as built": Kind("linear_delta", 1e-6),
    "domed bed": Kind("linear_delta", 1e-6, (), (("bowl", 0.03),)),
    "long belts": Kind("linear_delta", 1e-6, (), (("pitch", 2e-3),)),
    "bent screws": Kind("linear_delta", 1e-6, ("screw_pitch_error",), (("wobble", 30e-6),)),
    "rotary, bad gears": Kind(
        "delta24", 5e-6, ("gear_transmission_error",), (("ripple", 0.2e-3), ("teeth", 31.0))
    ),
}
