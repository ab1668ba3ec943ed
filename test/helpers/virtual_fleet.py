"""A workshop's Delta robots: each its own, one design, what all have and what went wrong with one.

Like `parallel_cal.virtual`, this file shares nothing with the rest of the package.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from virtual_day import dwell_samples

from parallel_cal.virtual.joint_effects import OvalDisc
from parallel_cal.virtual.machines import MACHINES
from parallel_cal.virtual.robot import TABLE_5_12, Backlash, Delta, Effect

DAY = 86400.0
SPREAD = MACHINES["delta"].spread  # 1 sigma by the dimension's name less the chain's
FINE = (
    SPREAD
    | {"Lb": 2e-5, "La_x": 2e-5, "La_y": 5e-5}
    | dict.fromkeys(("theta", "alpha", "dalpha", "dbeta"), 3e-4)
    | dict.fromkeys(("dC_x", "dC_y", "dC_z", "dLb"), 5e-6)
)  # ground and jigged, bolted on by hand
JIG = {"chain2.Lb": 0.5e-3}  # a gauge that is off: the rods of all robots' second chain
PLAY = 4e-4  # rad, of all robots' gears
LONG = {"chain1.La_x": 2.0e-3}  # a robot with an arm of another make
OVAL = OvalDisc((0.0, 3e-3, 0.0), (0.0, 0.4, 0.0))  # a robot with a bent encoder disc
CREEP = {"chain3.D_z": 8e-6 / DAY}  # m/s: a robot whose motor sinks


@dataclass(frozen=True)
class Member:
    """A robot of the fleet: its dimensions, what is hidden in it, and what grows by the second."""

    name: str
    dimensions: Mapping[str, float]
    effects: tuple[Effect, ...]
    grows: Mapping[str, float]

    def measured(
        self, recording: int, time: float, n_poses: int = 40, n_replicates: int = 8
    ) -> dict[str, NDArray[Any]]:
        """What a session yields, `time` s after the first."""
        now = {k: v + time * self.grows.get(k, 0.0) for k, v in self.dimensions.items()}
        seed = int(self.name.removeprefix("robot")) * 100 + recording
        return dwell_samples(
            Delta(now), n_poses, n_replicates, seed, self.effects, pose_seed=recording
        )


def drawn(
    n: int,
    seed: int = 0,
    play: float = PLAY,
    faults: bool = True,
    spread: Mapping[str, float] = SPREAD,
) -> list[Member]:
    """n robots from one workshop; robot 1 has an arm of another make, robot 2 a bent disc,
    robot 3 a motor that sinks."""
    members = []
    for k in range(n):
        rng = np.random.default_rng([seed, k, 17])
        size = {name: value + JIG.get(name, 0.0) for name, value in TABLE_5_12.items()}
        size = {
            name: value + spread.get(name.split(".")[1], 0.0) * rng.standard_normal()
            for name, value in size.items()
        }
        width = play * (1 + 0.2 * rng.standard_normal(3))
        effects: tuple[Effect, ...] = (Backlash(tuple(width)),) if play else ()
        if faults and k == 1:
            size = {name: value + LONG.get(name, 0.0) for name, value in size.items()}
        if faults and k == 2:
            effects = (*effects, OVAL)
        members.append(Member(f"robot{k:03d}", size, effects, CREEP if faults and k == 3 else {}))
    return members
